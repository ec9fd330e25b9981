"""A state estimator over a native vector env whose envs are measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import stacked
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.envs.sample import merged
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.wrappers.env_wrappers.estimator_layer import EstimatorLayer
from safe_envs.wrappers.env_wrappers.state_layer import state_layer
from safe_envs.wrappers.estimation import Estimator


class StateEstimatorVectorWrapper(EstimatorLayer, gym.vector.VectorWrapper):
    """`StateEstimatorWrapper` for a batch: same arguments, same info with the batch in front.

    Estimators restart with the episodes of their envs, in every mode of autoreset.

    Attributes:
        last_states: with same-step autoreset, the estimates at the end of the episodes that ended
            last, (num_envs, n); of the other envs anything.
        last_covariance: likewise, components of the covariances.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        estimator: Estimator | str = "ekf",
        observe: str = "estimate",
        knowledge: str = "model",
    ) -> None:
        inner = state_layer(env, (SafeVectorEnv,), vector=True, wrapper="StateEstimator")
        self.attach(inner, estimator, observe, knowledge, env.num_envs)
        gym.vector.VectorWrapper.__init__(self, env)
        if self._sees_estimate:
            self.single_observation_space = self._box
            self.observation_space = batch_space(self._box, env.num_envs)
        self.autoreset_mode = env.metadata["autoreset_mode"]
        self.last_states = np.empty((env.num_envs, 0))
        self.last_covariance: Sequence[Any] = ()

    @property
    def episodes(self) -> Episodes:
        """Counters of the episodes."""
        return self._measured_env.episodes

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or those of a mask; see `SafeVectorEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        present = info["_cost"]
        self.tracker.begin(self._measured_env.measured, present)
        added = self.estimated(self._measured_env.components)
        return self._seen(observation), {**info, **with_masks(added, present)}

    def step(self, actions: Any) -> VectorStep:
        """Hold an action in each env for one control period, and take in the samples."""
        return self._followed(self.env.step(actions))

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """Step with components of physical inputs inside their bounds, as a filter returns them."""
        if self.env is self._measured_env:
            return self._followed(self._measured_env.step_physical(u))
        return self.step(self.normalized_action(u))

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return that of the env, with the beliefs; see `SafeVectorEnv.snapshot`."""
        return {**self._measured_env.snapshot(), **self.tracker.snapshot()}

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: Any = None) -> None:
        """Put each episode where a snapshot has it; see `SafeVectorEnv.restore`."""
        self._measured_env.restore(snapshot, seed)
        self.tracker.restore(snapshot)

    def _followed(self, found: VectorStep) -> VectorStep:
        observation, reward, terminated, truncated, info = found
        world, begun = self._measured_env, self.episodes.begun
        restarts = np.count_nonzero(begun) > 0
        same_step = restarts and self.autoreset_mode == AutoresetMode.SAME_STEP
        sample = world.measured
        if same_step:
            sample = merged(begun, self.episodes.last_sample, sample)
        self.tracker.advance(world.executed, sample)
        if same_step:
            self._tell_last(info, begun)
        if restarts:
            self.tracker.begin(world.measured, begun)
        info.update(with_masks(self.estimated(world.components), info["_cost"]))
        return self._seen(observation), reward, terminated, truncated, info

    def _tell_last(self, info: Info, ended: np.ndarray) -> None:
        """Report the estimates of the last states of episodes that ended."""
        self.last_states = stacked(self.tracker.mean, self.num_envs)
        self.last_covariance = self.tracker.covariance
        last = self.estimated(list(self.episodes.last_states.T))
        info["final_info"].update(with_masks(last, ended))
        if self._sees_estimate:
            seen = self.features_at_estimate(self.episodes.last_steps * self.problem.dt)
            for i in np.flatnonzero(ended).tolist():
                info["final_obs"][i] = seen[i]

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        if not self._sees_estimate:
            return observation
        return self.features_at_estimate(self.episodes.steps * self.problem.dt)
