"""Safety of third-party envs: `info` as for this project's envs, states and inputs for a filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from safe_envs.arrays import real_array
from safe_envs.dynamics.codegen import Components, Flavour, stacked
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.envs.episode import Episode, Episodes
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.errors import IndependentCopies, InvalidInputError
from safe_envs.rendering.viewer import Viewer
from safe_envs.wrappers.external_env import FilterSpec
from safe_envs.wrappers.layers import autoreset_mode, doubt_layers


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


class SafetyMonitorVector(MonitorLayer, gym.vector.VectorWrapper):
    """`SafetyMonitor` over a whole batch: arrays with the batch in front, and Gymnasium's masks.

    A step that only resets an env (next-step autoreset) counts nothing but its start. With
    same-step autoreset the last step of an episode is in `final_info`.

    Args:
        env: any vector env with a Box action space, SyncVectorEnv and AsyncVectorEnv among them.
        spec: how the states are seen, and what is safe; or FILE.py:NAME of that.

    Attributes:
        problem: the model as a problem.
        executed: the components of the model's inputs of the last step.
        viewer: what the pictures are drawn from; None unless the render mode is "rgb_array".

    Raises:
        ConfigurationError: the spec does not fit the env, or the env does not say how it resets.
    """

    def __init__(self, env: gym.vector.VectorEnv, spec: FilterSpec | str) -> None:
        gym.vector.VectorWrapper.__init__(self, env)
        spec = FilterSpec.load(spec) if isinstance(spec, str) else spec
        doubt_layers(env)
        self.watch(spec, _one_of(env), env.single_action_space, "arrays", self.num_envs)
        self.autoreset_mode = autoreset_mode(env)
        self.executed: Components = ()
        self._x: Components = ()
        self.episodes = Episodes(self.num_envs)

    @property
    def components(self) -> Components:
        """States that the last observations show, an array (num_envs,) for each component."""
        if not self._x:
            raise gym.error.ResetNeeded("the envs have no state yet: call reset() first")
        return self._x

    def physical_action(self, actions: Any) -> Components:
        """Return the components of the model's inputs for actions (num_envs, m), which are clipped.

        Raises:
            InvalidInputError: the actions have another shape or are not finite.
        """
        given = np.asarray(real_array("array of actions", actions), dtype=np.float64)
        if given.shape != self.action_space.shape or not np.isfinite(given).all():
            raise InvalidInputError(
                f"actions of shape {given.shape}: the envs take finite numbers of shape"
                f" {self.action_space.shape}"
            )
        return _columns(self._spec.inputs(np.clip(given, self._low, self._high)))

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or those of a mask; see `SafeVectorEnv.reset`."""
        # Gymnasium's own vector envs take the mask out of the mapping that they are given.
        restarted = np.array(
            (options or {}).get("reset_mask", self.episodes.everywhere), dtype=bool
        )
        observation, info = self.env.reset(
            seed=seed, options=None if options is None else dict(options)
        )
        self.episodes.restart(restarted)
        seen = self._seen(observation, restarted)
        if self.viewer is not None:
            self.viewer.restart(
                np.stack(self._x, axis=-1),
                self.episodes.steps * self.problem.dt,
                np.flatnonzero(restarted).tolist(),
            )
        return observation, {**info, **with_masks(seen, restarted)}

    def step(self, actions: Any) -> VectorStep:
        """Pass on actions, and look at what comes of them."""
        self.executed = self.physical_action(actions)
        observation, reward, terminated, truncated, info = self.env.step(actions)
        ended, episodes = terminated | truncated, self.episodes
        episodes.steps += 1
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            shown = self._of_same_step(observation, ended, info)
            episodes.begun = ended
        else:
            due = episodes.due()
            if due is not None:
                episodes.restart(due)
            episodes.ended = ended
            shown = self._seen(observation, episodes.everywhere)
        if self.viewer is not None:
            self.viewer.advance(
                np.stack(self._x, axis=-1),
                episodes.steps * self.problem.dt,
                np.stack(self.executed, axis=-1),
                np.flatnonzero(episodes.begun).tolist(),
            )
        return (
            observation,
            reward,
            terminated,
            truncated,
            {**info, **with_masks(shown, episodes.everywhere)},
        )

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """Pass on components of the model's inputs; see `step`."""
        return self.step(self.normalized_action(u))

    def render(self) -> Any:
        """Return the envs' pictures, in the mode "rgb_array" next to filter and barrier.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
        """
        pictures: Any = self.env.render()
        return (
            pictures
            if self.viewer is None
            else self.viewer.frames([np.asarray(picture) for picture in pictures])
        )

    def _of_same_step(self, observation: Any, ended: np.ndarray, info: Info) -> Info:
        """Return what is shown after a step that restarted the envs that ended."""
        # Their last step goes to `final_info`.
        if not ended.any():
            return self._seen(observation, self.episodes.everywhere)
        # Observations may be dicts or tuples of arrays.
        space = self.single_observation_space
        each = list(iterate(self.observation_space, observation))
        for i in np.flatnonzero(ended).tolist():
            each[i] = info["final_obs"][i]
        last = concatenate(space, each, create_empty_array(space, self.num_envs))
        info["final_info"] = {
            **info.get("final_info", {}),
            **with_masks(self._seen(last, self.episodes.everywhere), ended),
        }
        self.episodes.last_states = np.stack(self._x, axis=-1)
        self.episodes.restart(ended)
        return self._seen(observation, ended)

    def _seen(self, observation: Any, counted: np.ndarray) -> Info:
        """Read the states; `counted` are the envs whose observations are new."""
        self._x = _columns(self._spec.state(observation, (self.num_envs,)))
        barrier = stacked(self._barriers(*self._x), self.num_envs)
        return self.episodes.count(barrier, barrier.min(axis=1), counted)


def _one_of(env: gym.vector.VectorEnv) -> Any:
    """Return one of the envs of a batch where they are at hand, else the batch itself."""
    envs = getattr(env.unwrapped, "envs", None)
    return envs[0].unwrapped if envs else env.unwrapped


def _columns(table: np.ndarray) -> Components:
    # A copy in any case: what a caller does to the observation must not reach the state.
    return tuple(np.array(table.T, order="C"))
