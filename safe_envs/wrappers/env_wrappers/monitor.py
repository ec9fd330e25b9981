"""Safety of third-party envs: `info` as for this project's envs, states and inputs for a filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.dynamics.codegen import Flavour
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.envs.episode import Episode
from safe_envs.envs.info import Info
from safe_envs.errors import InvalidInputError
from safe_envs.independent_copies import IndependentCopies
from safe_envs.rendering.viewer import Viewer
from safe_envs.validators import real_array
from safe_envs.wrappers.env_wrappers.external_env import FilterSpec
from safe_envs.wrappers.env_wrappers.layers_below import doubt_layers


class MonitorLayer(IndependentCopies):
    """The part of a monitor that does not depend on the number of envs."""

    env: Any

    def watch(
        self, spec: FilterSpec, one: Any, space: Any, flavour: Flavour, count: int = 1
    ) -> None:
        """Prepare to look at an env, or at a batch of them.

        Args:
            spec: how the state is seen, and what is safe.
            one: an env without wrappers, where the attribute `dt` may be found.
            space: action space of one env.
            flavour: "floats" for one env, "arrays" for a batch.
            count: number of envs.

        Raises:
            ConfigurationError: The spec does not fit the env.
        """
        env, made = self.env, self.env.spec
        name = type(env.unwrapped).__name__ if made is None else made.id
        limit = None if made is None else made.max_episode_steps
        self.problem = spec.problem(one, space, name, limit)
        self._spec = spec
        h = [spec.model.numeric(barrier.expression) for barrier in spec.named]
        self._barriers = BarrierFunction(spec.model.states, h, flavour)
        self._low, self._high = space.low.astype(np.float64), space.high.astype(np.float64)
        self._kind = space.dtype
        is_drawn = env.render_mode == "rgb_array"
        self.viewer = Viewer(self.problem, "rgb_array", count) if is_drawn else None

    def inputs_of(self, actions: np.ndarray) -> np.ndarray:
        """Return the model's inputs (B, m) for actions of the env."""
        return self._spec.inputs(actions)

    def normalized_action(self, u: Sequence[Any]) -> np.ndarray:
        """Return the env's action for components of inputs; the inverse of `physical_action`."""
        # Of a batch the components are arrays, and the envs come first in the actions.
        actions = self._spec.actions(np.ascontiguousarray(np.array(u).T))
        return np.clip(actions, self._low, self._high).astype(self._kind)


class SafetyMonitor(
    MonitorLayer, gym.Wrapper[np.ndarray, Any, np.ndarray, Any], gym.utils.RecordConstructorArgs
):
    """Adds cost, violation, barrier, h_min and episode_cost to `info`, by a model's barriers.

    Actions pass unchanged.

    Keys of the same names that the env reports itself are replaced.

    Args:
        env: any env with a Box action space.
        spec: how its state is seen, and what is safe; or FILE.py:NAME of that, with which an env's
            own spec can be written as JSON.

    Attributes:
        problem: the model as a problem.
        executed: the model's input of the last step.
        viewer: what the pictures are drawn from; None unless the render mode is "rgb_array".

    Raises:
        ConfigurationError: the spec does not fit the env.
    """

    def __init__(self, env: gym.Env[Any, Any], spec: FilterSpec | str) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, spec=spec, _disable_deepcopy=True)
        gym.Wrapper.__init__(self, env)
        spec = FilterSpec.load(spec) if isinstance(spec, str) else spec
        doubt_layers(env)
        self.watch(spec, env.unwrapped, env.action_space, "floats")
        self.executed: Sequence[float] = ()
        self._x: tuple[float, ...] | None = None
        self._episode = Episode()

    @property
    def episode(self) -> Episode:
        """Counters of the episode."""
        return self._episode

    @property
    def components(self) -> tuple[float, ...]:
        """The state that the last observation shows, as plain floats."""
        if self._x is None:
            raise gym.error.ResetNeeded("the env has no state yet: call reset() first")
        return self._x

    def physical_action(self, action: Any) -> list[float]:
        """Return the model's input for an action, which is clipped to the action space.

        Raises:
            InvalidInputError: the action has another shape, or does not hold finite real numbers.
        """
        given = np.asarray(real_array("action", action), dtype=np.float64)
        if given.shape != self._low.shape or not np.isfinite(given).all():
            raise InvalidInputError(
                f"action {given.tolist()}: the env takes finite numbers of shape {self._low.shape}"
            )
        return self._spec.inputs(np.clip(given, self._low, self._high)).tolist()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; see `gymnasium.Env.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._episode.restart()
        seen = self._seen(observation)
        if self.viewer is not None:
            self.viewer.restart([self.components], [0.0], [0])
        return observation, {**info, **seen}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Pass on an action, and look at what comes of it."""
        self.executed = self.physical_action(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._episode.steps += 1
        seen = self._seen(observation)
        if self.viewer is not None:
            time = self._episode.steps * self.problem.dt
            self.viewer.advance([self.components], [time], [self.executed])
        return observation, reward, terminated, truncated, {**info, **seen}

    def step_physical(self, u: Sequence[float]) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Pass on an input of the model; see `step`."""
        return self.step(self.normalized_action(u))

    def render(self) -> Any:
        """Return the env's picture, in the mode "rgb_array" next to the filter and the barrier.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
        """
        picture = self.env.render()
        return picture if self.viewer is None else self.viewer.frames([np.asarray(picture)])[0]

    def _seen(self, observation: Any) -> Info:
        self._x = tuple(self._spec.state(observation).tolist())
        barrier = self._barriers(*self._x)
        return self._episode.count(barrier, min(barrier))
