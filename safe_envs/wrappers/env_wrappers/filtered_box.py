"""Action spaces of filtered envs, which know what input an action stands for."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.wrappers.env_wrappers.monitor import MonitorLayer

_POINTS = 9
"""Actions between the ends of a space at which a map is compared with a straight line."""


class FilteredBox(gym.spaces.Box):
    """The action space of a filtered env: that of the env, and the inputs at its ends.

    With it a replay buffer can tell, from the physical `safe_action` of an info alone, which action
    of the space was executed. It equals the env's own space, and has a generator of its own. What
    is pickled with it, such as a .zip of Stable-Baselines3, needs this package to be loaded.

    Attributes:
        at_low: physical input at the lowest action, shape (m,).
        at_high: at the highest; smaller than `at_low` where the map of actions turns around.

    Args:
        space: of the env.
        at_low: see above.
        at_high: see above.
    """

    def __init__(self, space: gym.spaces.Box, at_low: np.ndarray, at_high: np.ndarray) -> None:
        kind: Any = space.dtype
        super().__init__(space.low, space.high, dtype=kind)
        self.at_low = np.array(at_low, dtype=np.float64)
        self.at_high = np.array(at_high, dtype=np.float64)

    @property
    def plain(self) -> gym.spaces.Box:
        """The env's own space."""
        kind: Any = self.dtype
        return gym.spaces.Box(self.low, self.high, dtype=kind)


def filtered_box(space: Any, inner: Any) -> Any:
    """Return the action space of a filtered env, or the env's own where no straight line fits.

    Args:
        space: of one env below the filter.
        inner: layer below the filter that shows the state.
    """
    if not isinstance(inner, MonitorLayer):
        return FilteredBox(space, *np.array(inner.problem.box).T)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    part = np.linspace(0.0, 1.0, _POINTS)[:, None]
    inputs = inner.inputs_of((1.0 - part) * low + part * high)
    off = np.abs(inputs - ((1.0 - part) * inputs[0] + part * inputs[-1]))
    straight = (off <= 1e-9 * np.abs(inputs[-1] - inputs[0])).all()
    return FilteredBox(space, inputs[0], inputs[-1]) if straight else space
