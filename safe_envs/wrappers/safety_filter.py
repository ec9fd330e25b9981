"""A safety filter over a scalar env."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.envs.compiled_batch import BatchFilter, BatchStepper
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.info import Info, VectorStep, filter_info, with_masks
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.estimation.estimator import Estimator
from safe_envs.filters.qp import FilterDecision
from safe_envs.wrappers.estimator import StateEstimatorVectorWrapper, StateEstimatorWrapper
from safe_envs.wrappers.filter_layers import (
    FilterChoice,
    FilterLayer,
    filtered_box,
    rest_info,
    third_party_spec,
)
from safe_envs.wrappers.layers import only_checks_between, state_layer
from safe_envs.wrappers.monitor import SafetyMonitor, SafetyMonitorVector


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
        filter: a `Condition` for every barrier, one for each, or their text, like "scbf",
            "hocbf:alpha=2,8" or "hocbf:alpha=2,8+cbf:alpha=1"; without parameters it takes the
            env's. Or the promise filter, like "promise:p=0.99".
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
        filter: FilterChoice,  # noqa: A002  (as everywhere)
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
        text = self.attach(inner, filter, knowledge, objective, priorities, observe_promise, delay)
        self.watch_states(inner.episode)
        # The monitor records the view: an env that is made again from its spec has one already.
        gym.utils.RecordConstructorArgs.__init__(
            self,
            filter=text,
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


_TALLIES = ("interventions", "infeasible")


class SafetyFilterVectorWrapper(FilterLayer, gym.vector.VectorWrapper):
    """`SafetyFilterWrapper` for a batch: same arguments, same info with the batch in front.

    A step that only resets an env (next-step autoreset) ignores its action: there the filter
    reports what it reports at reset, and counts nothing.

    Over envs with the engine "compiled" or "auto", made without a render mode, the filter is part
    of their compiled function; "auto" leaves those that have no compiled form to NumPy.

    Raises:
        NotCompilableError: the engine of the env is "compiled", and the filter has no compiled
            form: it has learned terms without one, predicts over a delay, or is the promise filter.
        ConfigurationError: an argument is unknown or missing, or does not fit the env.
        InvalidInputError: `state_fn` does not make states of observations.
        RelativeDegreeError: the condition does not suit the env's barrier.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        filter: FilterChoice,  # noqa: A002  (as everywhere)
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
        observe_promise: bool = False,
        delay: int | None = None,
        estimator: Estimator | str | None = None,
        **view: Any,
    ) -> None:
        if view:
            spec = third_party_spec(env.unwrapped, SafeVectorEnv, view, knowledge)
            env = SafetyMonitorVector(env, spec)
        if estimator is not None:
            env = StateEstimatorVectorWrapper(env, estimator, "measurement", knowledge)
        kinds = (SafeVectorEnv, SafetyMonitorVector, StateEstimatorVectorWrapper)
        inner = state_layer(env, kinds, vector=True)
        self.attach(
            inner, filter, knowledge, objective, priorities, observe_promise, delay, env.num_envs
        )
        self.watch_states(inner.episodes)
        gym.vector.VectorWrapper.__init__(self, env)
        self.single_action_space = filtered_box(env.single_action_space, inner)
        self.know_bounds(env.single_action_space, objective, (self.num_envs,))
        if observe_promise:
            self.single_observation_space = self.observation_box(env.single_observation_space)
            self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._rest = rest_info(inner.problem)
        self.autoreset_mode = env.metadata["autoreset_mode"]
        self._stepper = self._compiled() if env is inner else None
        self._counted = _Counted(self.num_envs) if self._stepper is None else self._stepper

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or those of a mask.

        See `SafeVectorEnv.reset` and `SafetyFilterWrapper.reset`.
        """
        if self._stepper is not None:
            observation, info = self._inner.reset_filtered(self._stepper, seed, options)
            return observation, self._with_bounds(info)
        self.require_whole_episodes(options)
        self.follow()
        observation, info = self.env.reset(seed=seed, options=options)
        present = info["_cost"]
        self._forget(present)
        self._filter.begin(self._inner.components, present, self._episodes.steps)
        at_rest = {
            key: np.full((self.num_envs, *np.shape(value)), value)
            for key, value in self._rest.items()
        }
        at_rest |= self._reported()
        return self.observed(observation), {**info, **with_masks(at_rest, present)}

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return that of the env, and the counts of each episode; see `SafeVectorEnv.snapshot`."""
        counts = {name: self._counted.tallies[:, j].copy() for j, name in enumerate(_TALLIES)}
        return {**self._inner.snapshot(), **counts, **self._filter.snapshot()}

    def restore(
        self, snapshot: Mapping[str, np.ndarray], seed: int | Sequence[int | None] | None = None
    ) -> None:
        """Put each episode where a snapshot has it; see `SafeVectorEnv.restore`."""
        self._inner.restore(snapshot, seed)
        counts = [np.asarray(snapshot[name], dtype=np.int64) for name in _TALLIES]
        self._counted.tallies = np.column_stack(counts)
        self._filter.restore(snapshot)
        self.watch_states(self._episodes)

    def step(self, actions: Any) -> VectorStep:
        """Filter the actions and hold them for one control period."""
        if self._stepper is not None:
            found = self._inner.step_filtered(self._stepper, actions)
            info = self._with_bounds(found[-1])
            if "final_info" in info:
                self._with_bounds(info["final_info"])
            return found
        proposed = self._inner.physical_action(actions)
        self.follow()
        decision = self._filter.decide_arrays(tuple(self.known(proposed)), proposed)
        active = (
            decision.active[0]
            if len(decision.active) == 1
            else np.logical_or.reduce(decision.active)
        )
        if self._inner.viewer is not None:
            self._inner.viewer.announce(
                np.stack(decision.proposed, axis=-1), active, decision.feasible
            )
        observation, reward, terminated, truncated, info = self.execute(
            self.env, decision.action, self.env is self._inner
        )
        self._filter.advance(self._reached(), terminated | truncated)
        added = self._decided(decision, active) | self._reported(reached=True)
        begun = self._inner.episodes.begun
        if np.count_nonzero(begun):
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                last = {key: value.copy() for key, value in added.items()}
                info["final_info"].update(with_masks(last, begun))
                self._observe_last(info, begun)
            self._filter.begin(self._inner.components, begun)
            self._restart(added, begun)
            added |= self._reported()
        info.update(with_masks(added, info["_cost"]))
        return self.observed(observation), reward, terminated, truncated, info

    def _reached(self) -> Sequence[Any]:
        """Return the components of the states that a step led to, of ended episodes too."""
        inner = self._inner
        estimates = isinstance(inner, StateEstimatorVectorWrapper)
        last = (inner if estimates else inner.episodes).last_states.T
        return self._with_last(inner.components, list(last))

    def _with_last(self, now: Sequence[Any], last: Sequence[Any]) -> Sequence[Any]:
        """Return components of now, with others in envs whose episodes ended in this step."""
        begun = self._inner.episodes.begun
        if self.autoreset_mode != AutoresetMode.SAME_STEP or not np.count_nonzero(begun):
            return now
        return tuple([np.where(begun, old, c) for old, c in zip(last, now, strict=True)])

    def _reported(self, reached: bool = False) -> Info:
        """Return what the filter reports, of ended episodes too if they were just reached."""
        found = {**self._filter.report(), **self.bounds_info()}
        if self._beliefs is not None:
            inner = self._inner
            x, p = inner.components, inner.tracker.covariance
            if reached:
                x, p = self._reached(), self._with_last(p, inner.last_covariance)
            found = {**found, "belief_barrier": self._beliefs.barriers(x, p)}
        return found

    def _with_bounds(self, info: Info) -> Info:
        """Add what is always the same to an info of the compiled function."""
        if self._bounds is not None:
            info["input_bounds"] = self._bounds.copy()
            info["_input_bounds"] = info["_cost"].copy()
        return info

    def _observe_last(self, info: Info, ended: np.ndarray) -> None:
        """Append p_k to the last observations of episodes, which their envs have not seen."""
        if self._observes:
            last, levels = info["final_obs"], self._filter.report()["promise"]
            for i in np.flatnonzero(ended).tolist():
                last[i] = np.append(last[i], levels[i]).astype(last[i].dtype)

    def _decided(self, decision: FilterDecision, active: np.ndarray) -> Info:
        """Count, and report what was decided."""
        nominal = decision.proposed
        differs = decision.action[0] != nominal[0]
        for u, v in zip(decision.action[1:], nominal[1:], strict=True):
            differs |= u != v
        differs &= active
        now = np.column_stack([differs, ~decision.feasible])
        self._counted.tallies = tallies = self._counted.tallies + now
        return filter_info(
            nominal_action=_as_columns(nominal),
            safe_action=_as_columns(decision.action),
            intervention=differs,
            filter_active=active,
            feasible=decision.feasible,
            slack=(
                decision.slack[0] if len(decision.slack) == 1 else np.maximum.reduce(decision.slack)
            ),
            slacks=_as_columns(decision.slack),
            active_barrier=np.where(differs, decision.cause, -1),
            episode_interventions=tallies[:, 0].copy(),
            episode_infeasible=tallies[:, 1].copy(),
        )

    def _restart(self, added: Info, envs: np.ndarray) -> None:
        """Put what is reported at reset in place of a decision, for the envs that were reset."""
        self._forget(envs)
        for key, value in self._rest.items():
            # The env itself may hold the array of a single input.
            added[key] = added[key].copy()
            added[key][envs] = value

    def _forget(self, envs: np.ndarray) -> None:
        self._counted.tallies = np.where(envs[:, None], 0, self._counted.tallies)

    def _compiled(self) -> BatchStepper | None:
        """Return what filters and steps in one compiled function, where the env is compiled."""
        if not isinstance(self._inner, SafeVectorEnv):
            return None
        rest = self._rest
        at_rest = [rest[key] for key in ("nominal_action", "safe_action", "slack", "slacks")]
        return self._inner.filtered(
            BatchFilter(
                self._filter.source,
                self._filter.decide_arrays,
                np.hstack(at_rest),
            )
        )


class _Counted:
    """What `BatchStepper` counts."""

    def __init__(self, num_envs: int) -> None:
        self.tallies = np.zeros((num_envs, 2), dtype=np.int64)


def readable(env: gym.vector.VectorEnv) -> SafeVectorEnv | SafetyMonitorVector:
    """Return the layer of a vector env from which a filter reads the states.

    Raises:
        ConfigurationError: there is none.
    """
    return state_layer(env, (SafeVectorEnv, SafetyMonitorVector), vector=True)


def _as_columns(components: Sequence[np.ndarray]) -> np.ndarray:
    """Return components as columns, which the caller may write to."""
    if len(components) == 1:  # where `numpy.stack` takes ten times as long
        return components[0].reshape(-1, 1).copy()
    return np.stack(components, axis=-1)
