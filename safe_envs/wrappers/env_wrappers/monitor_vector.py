"""Safety of third-party vector envs, in `info`; see `safe_envs.wrappers.env_wrappers.monitor`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from safe_envs.dynamics.codegen import Components, stacked
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.errors import InvalidInputError
from safe_envs.validators import real_array
from safe_envs.wrappers.env_wrappers.autoreset import autoreset_mode
from safe_envs.wrappers.env_wrappers.external_env import FilterSpec
from safe_envs.wrappers.env_wrappers.layers_below import doubt_layers
from safe_envs.wrappers.env_wrappers.monitor import MonitorLayer


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
        """Return what is shown after a step that restarted the envs that ended.

        Their last step goes to `final_info`.
        """
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
