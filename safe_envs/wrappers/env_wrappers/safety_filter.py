"""A safety filter over a scalar env."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.info import Info, filter_info
from safe_envs.wrappers.env_wrappers.episode_filter import FilterChoice
from safe_envs.wrappers.env_wrappers.filtered_box import filtered_box
from safe_envs.wrappers.env_wrappers.layers import (
    FilterLayer,
    rest_info,
    third_party_spec,
)
from safe_envs.wrappers.env_wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.env_wrappers.state_estimator import StateEstimatorWrapper
from safe_envs.wrappers.env_wrappers.state_layer import only_checks_between, state_layer
from safe_envs.wrappers.estimation import Estimator


class SafetyFilterWrapper(
    FilterLayer,
    gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    gym.utils.RecordConstructorArgs,
):
    """Replaces each action of a policy by the nearest one that a condition allows.

    The wrapper takes and passes on actions in [-1, 1]; `info` gains the keys of
    `safe_envs.envs.info`, in physical units.

    Over a third-party env the fields of `FilterSpec` are given by name. Then actions are the env's
    own, and `info` gains the keys of this project's envs too.

    Args:
        env: one of this project's envs, possibly wrapped; or any env with a Box action space.
        condition: a `Condition` for every barrier, one for each, or their text, like "scbf",
            "hocbf:p=2,8" or "hocbf:p=2,8+cbf:alpha=1"; without parameters it takes the env's. Or
            the promise filter, like "promise:p=0.99".
        knowledge: "model" (what the designer believes) or "plant" (the true system).
        objective: "nearest" to the policy's action; or "clf" for the joint QP with the env's
            goal, in which the policy has no say: `info["nominal_action"]` is what the goal alone
            asks for.
        priorities: of the barriers where not all can be kept: weights of their squared slacks, ones
            by default.
        delay: of the inputs as the filter believes it, in control periods; by default that of the
            env's `delay` and `model_delay`. It predicts so far ahead, see `DelayedFilter`.
        estimator: of the state, over an env with the option `measurement`; see
            `StateEstimatorWrapper`. The observation remains what is measured; for estimates put
            that wrapper below this one.
        observe_promise: append p_k of the promise filter, in [0, 1], to the observation, on which
            what it will allow depends.
        **view: for a third-party env `model`, `barriers`, `state_fn`, and what else of
            `FilterSpec` is needed.

    Raises:
        ConfigurationError: an argument is unknown or missing, or does not fit the env; or, at a
            step, a wrapper between the filter and the env changed the action.
        InvalidInputError: `state_fn` does not make states of observations.
        RelativeDegreeError: the condition does not suit the env's barrier.
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        condition: FilterChoice,
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
        observe_promise: bool = False,
        delay: int | None = None,
        estimator: Estimator | str | None = None,
        **view: Any,
    ) -> None:
        if view:
            env = SafetyMonitor(env, third_party_spec(env.unwrapped, SafeEnv, view, knowledge))
        if estimator is not None:
            env = StateEstimatorWrapper(env, estimator, "measurement", knowledge)
        inner = state_layer(env, (SafeEnv, SafetyMonitor, StateEstimatorWrapper), vector=False)
        text = self.attach(
            inner, condition, knowledge, objective, priorities, observe_promise, delay
        )
        self.watch_states(inner.episode)
        # The monitor records the view: an env that is made again from its spec has one already.
        gym.utils.RecordConstructorArgs.__init__(
            self,
            condition=text,
            knowledge=knowledge,
            objective=objective,
            priorities=priorities,
            observe_promise=observe_promise,
            delay=delay,
        )
        gym.Wrapper.__init__(self, env)
        self.action_space = filtered_box(env.action_space, inner)
        self.know_bounds(env.action_space, objective)
        if observe_promise:
            self.observation_space = self.observation_box(env.observation_space)
        self._directly = only_checks_between(env, inner)
        self._interventions = 0
        self._infeasible = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; see `SafeEnv.reset`.

        With a specification to keep, an episode begins at time 0.

        Raises:
            ConfigurationError: see `SafeEnv.reset`; or a time is given with a specification.
        """
        self.require_whole_episodes(options)
        self.follow()
        observation, info = self.env.reset(seed=seed, options=options)
        self._interventions = 0
        self._infeasible = 0
        self._filter.begin(self._inner.components, instants=self._episodes.steps)
        info = {**info, **rest_info(self._inner.problem), **self._reported()}
        return self.observed(observation), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Filter the action and hold it for one control period."""
        proposed = self._inner.physical_action(action)
        self.follow()
        decision = self._filter.decide_floats(self.known(proposed), proposed)
        executed, nominal, active = decision.action, decision.proposed, True in decision.active
        if self._inner.viewer is not None:
            self._inner.viewer.announce([nominal], [active], [decision.feasible])
        observation, reward, terminated, truncated, info = self.execute(
            self.env, executed, self._directly
        )
        self._filter.advance(self._inner.components, terminated or truncated)
        differs = active and executed != nominal
        self._interventions += differs
        self._infeasible += not decision.feasible
        info.update(
            filter_info(
                nominal_action=np.array(nominal),
                safe_action=np.array(executed),
                intervention=differs,
                filter_active=active,
                feasible=decision.feasible,
                slack=max(decision.slack),
                slacks=np.array(decision.slack),
                active_barrier=decision.cause if differs else -1,
                episode_interventions=self._interventions,
                episode_infeasible=self._infeasible,
            ),
            **self._reported(),
        )
        return self.observed(observation), reward, terminated, truncated, info

    def _reported(self) -> Info:
        found: Info = {key: value.item() for key, value in self._filter.report().items()}
        found |= self.bounds_info()
        if self._beliefs is not None:
            tracker = self._inner.tracker
            found["belief_barrier"] = self._beliefs.barriers(tracker.mean, tracker.covariance)[0]
        return found
