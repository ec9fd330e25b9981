"""Action spaces of filtered envs, which know what input an action stands for."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.env_wrappers.monitor import MonitorLayer

_POINTS = 9
"""Actions between the ends of a space at which a map is compared with a straight line."""


def filtered_box(space: Any, inner: Any) -> Any:
    """Return the action space of a filtered env, which knows the physical inputs at its ends.

    It is a Box like the env's own, with a generator of its own, and has these inputs as `at_low`
    and `at_high`, of shape (m,): the former is the larger where the map of actions turns around.
    With them a replay buffer can tell, from the physical `safe_action` of an info alone, which
    action of the space was executed. A class of its own would be needed to load every file into
    which the space is pickled, such as a .zip of Stable-Baselines3.

    Args:
        space: of one env below the filter; where no straight line fits, it is returned as it is.
        inner: layer below the filter that shows the state.

    Raises:
        ConfigurationError: the space is no Box: a wrapper below changed the actions.
    """
    if not isinstance(space, gym.spaces.Box):
        raise ConfigurationError(
            f"the env below the filter takes actions of {space}, and a filter decides on those of a"
            " Box; put wrappers that change actions around the filter"
        )
    if not isinstance(inner, MonitorLayer):
        return _with_ends(space, *input_bounds(space, inner).T)
    part, inputs = _line(space, inner, _POINTS)
    off = np.abs(inputs - ((1.0 - part) * inputs[0] + part * inputs[-1]))
    straight = (off <= 1e-9 * np.abs(inputs[-1] - inputs[0])).all()
    return _with_ends(space, inputs[0], inputs[-1]) if straight else space


def input_bounds(space: Any, inner: Any) -> np.ndarray:
    """Return the physical inputs at the ends of an action space, shape (m, 2).

    Args:
        space: see `filtered_box`.
        inner: see `filtered_box`.
    """
    if isinstance(inner, MonitorLayer):
        return _line(space, inner, 2)[1].T.copy()
    return np.array(inner.problem.box, dtype=np.float64)


def _line(space: Any, inner: MonitorLayer, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parts (points, 1) of the way between the ends of a space, and the inputs there."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    part = np.linspace(0.0, 1.0, points)[:, None]
    return part, inner.inputs_of((1.0 - part) * low + part * high)


def ends_of(space: gym.Space[Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the inputs at the ends of a space of `filtered_box`; None for other spaces."""
    known = vars(space)
    return (known["at_low"], known["at_high"]) if "at_low" in known else None


def _with_ends(space: gym.spaces.Box, at_low: np.ndarray, at_high: np.ndarray) -> gym.spaces.Box:
    kind: Any = space.dtype
    found: Any = gym.spaces.Box(space.low, space.high, dtype=kind)
    found.at_low, found.at_high = at_low.copy(), at_high.copy()
    return found
