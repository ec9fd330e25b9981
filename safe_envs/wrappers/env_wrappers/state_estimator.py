"""A state estimator over a measured scalar env."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.episode import Episode
from safe_envs.envs.info import Info
from safe_envs.wrappers.env_wrappers.estimator_layer import EstimatorLayer
from safe_envs.wrappers.env_wrappers.state_layer import only_checks_between, state_layer
from safe_envs.wrappers.estimation import Estimator


class StateEstimatorWrapper(
    EstimatorLayer,
    gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    gym.utils.RecordConstructorArgs,
):
    """Estimates the state of an env with the option `measurement`, for policies and filters.

    Filters above it decide at the estimate. `info` gains the keys of `safe_envs.envs.info`; cost
    and violations remain those of the true state. A state that is set or given at a reset is not
    told to the estimator: its first belief is the start distribution of the problem.

    Args:
        env: one of this project's envs with a `measurement`, possibly wrapped.
        estimator: "kf", "ekf" or "ukf", with settings like "ekf:process_noise=.1"; or an
            `Estimator`.
        observe: "estimate" for the features of the env without a sensor, at the estimate, so that
            policies of the true state act on the estimate; "measurement" for what is measured.
        knowledge: "model" (what the designer believes) or "plant" (the true system).

    Raises:
        ConfigurationError: an argument is unknown, or the env is not measured.
        SystemDefinitionError: the measurement does not determine the state.
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        estimator: Estimator | str = "ekf",
        observe: str = "estimate",
        knowledge: str = "model",
    ) -> None:
        inner = state_layer(env, (SafeEnv,), vector=False, wrapper="StateEstimator")
        self.attach(inner, estimator, observe, knowledge)
        gym.utils.RecordConstructorArgs.__init__(
            self, estimator=self.estimator.text, observe=observe, knowledge=knowledge
        )
        gym.Wrapper.__init__(self, env)
        if self._sees_estimate:
            self.observation_space = self._box
        self._directly = only_checks_between(env, inner)

    @property
    def episode(self) -> Episode:
        """Counters of the episode."""
        return self._measured_env.episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; see `SafeEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.tracker.begin(self._measured_env.measured)
        return self._seen(observation), {**info, **self._report()}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Hold an action for one control period, and take in the sample at its end."""
        return self._followed(self.env.step(action))

    def step_physical(self, u: Sequence[float]) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Step with a physical input inside its bounds, as a filter returns it."""
        if self._directly:
            return self._followed(self._measured_env.step_physical(u))
        return self.step(self.normalized_action(u))

    def _followed(self, found: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        observation, reward, terminated, truncated, info = found
        self.tracker.advance(self._measured_env.executed, self._measured_env.measured)
        info.update(self._report())
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        if not self._sees_estimate:
            return observation
        return self.features_at_estimate(self.episode.steps * self.problem.dt)

    def _report(self) -> Info:
        each = self.estimated([np.array([c]) for c in self._measured_env.components])
        return {key: value[0] if value.ndim > 1 else value[0].item() for key, value in each.items()}
