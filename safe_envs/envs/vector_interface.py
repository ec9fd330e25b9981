"""What Gymnasium asks of a batch of envs of a problem besides stepping them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.seeding import EpisodeStreams
from safe_envs.envs.simulation import steps_until
from safe_envs.envs.spaces import BatchActions, action_box, observation_box
from safe_envs.envs.spec import OwnSpec
from safe_envs.errors import ConfigurationError
from safe_envs.independent_copies import IndependentCopies
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.viewer import RENDER_MODES, frames_a_second, open_viewer


class VectorInterface(  # pyright: ignore[reportIncompatibleVariableOverride]
    OwnSpec, IndependentCopies, gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
):
    """Spaces, metadata, spec and seeds of a batch of envs; base of `SafeVectorEnv`.

    Attributes:
        problem: that is simulated.
        autoreset_mode: when ended episodes restart, as of Gymnasium's Sync- and AsyncVectorEnv.
        viewer: what is drawn, and its caption; None without a render mode.

    Args:
        problem: see above.
        num_envs: size of the batch.
        autoreset_mode: when ended episodes restart.
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: "rgb_array" or None.

    Raises:
        ConfigurationError: an argument is out of range.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        num_envs: int,
        autoreset_mode: str | AutoresetMode,
        max_episode_steps: int | None,
        render_mode: str | None,
    ) -> None:
        self.viewer = open_viewer(problem, render_mode, num_envs)
        self.render_mode = render_mode
        self.autoreset_mode = _mode(autoreset_mode)
        self._limit = steps_until(problem, max_episode_steps)
        self.problem, self.num_envs = problem, num_envs
        self.metadata = {
            "render_modes": [*RENDER_MODES[1:]],
            "render_fps": frames_a_second(problem),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = observation_box(problem)
        self.single_action_space = action_box(problem)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._actions = BatchActions(problem, num_envs)
        self._streams = EpisodeStreams(num_envs)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A generator of each env, seeded as Gymnasium does; the env does not draw from it."""
        self._streams.seed([None] * self.num_envs)
        return self._streams.generators()

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seed of each env."""
        self._streams.seed([None] * self.num_envs)
        return tuple(self._streams.seeds)

    @property
    def components(self) -> Components:
        """The exact states: for each state an array (num_envs,), not to be written to."""
        raise NotImplementedError

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw every env, with the trail of its episode and what a filter decided.

        Returns:
            For each env uint8 of shape (height, width, 3); None, with a warning, without a render
            mode.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
            ResetNeeded: there is no state yet.
        """
        if self.viewer is None:
            gym.logger.warn(
                "render() draws nothing without a render mode; make the envs with"
                ' render_mode="rgb_array"'
            )
            return None
        return self.viewer.frames() if self.components else None

    def physical_action(self, actions: Any) -> Components:
        """Scale actions in [-1, 1] to physical inputs; see `BatchActions.physical`."""
        return self._actions.physical(actions)

    def normalized_action(self, physical: Sequence[Any]) -> np.ndarray:
        """Invert `physical_action`: return actions of shape (num_envs, m) in double precision."""
        return self._actions.normalized(physical)


def _mode(given: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError as error:
        allowed = ", ".join(mode.value for mode in AutoresetMode)
        raise ConfigurationError(f"autoreset_mode = {given!r}; allowed: {allowed}") from error
