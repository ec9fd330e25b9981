"""A safety filter over a scalar env."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.info import Info, filter_info
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition, spec_of
from safe_envs.wrappers.env_wrappers.external_env import FilterSpec
from safe_envs.wrappers.env_wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.safety_filter import SafetyFilter


class SafetyFilterWrapper(
    gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], gym.utils.RecordConstructorArgs
):
    """Replaces each action of a policy by the nearest one that a condition allows.

    The wrapper takes and passes on actions in [-1, 1]; `info` gains the keys of
    `safe_envs.envs.info`, in physical units.

    Over an env of somebody else the filter is told what it needs by name, as the fields of
    `FilterSpec`; then actions are the env's own, and `info` gains the keys of this project's envs
    too.

    Args:
        env: one of this project's envs, possibly wrapped; or any env with a box of actions.
        condition: a `Condition` for every barrier, one for each, or their text, like "scbf",
            "hocbf:p=2,8" or "hocbf:p=2,8+cbf:alpha=1"; without parameters it takes the env's.
        knowledge: "model" (what the designer believes) or "plant" (the true system).
        objective: "nearest" to the policy's action; or "clf" for the joint program with the env's
            goal, in which the policy has no say: `info["nominal_action"]` is what the goal alone
            asks for.
        priorities: of the barriers where not all can be kept: weights of their squared slacks, ones
            by default.
        **view: for an env of somebody else `model`, `barriers`, `state_fn`, and what else of
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
        condition: Condition | Sequence[Condition] | str,
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
        **view: Any,
    ) -> None:
        if view:
            require_foreign(env.unwrapped, SafeEnv, view, knowledge)
            env = SafetyMonitor(env, FilterSpec.of(view))
        inner = _readable(env)
        text, self.safety_filter = build_filter(
            inner.problem, condition, knowledge, objective, priorities
        )
        # The monitor records the view: an env that is made again from its spec has one already.
        gym.utils.RecordConstructorArgs.__init__(
            self, condition=text, knowledge=knowledge, objective=objective, priorities=priorities
        )
        gym.Wrapper.__init__(self, env)
        self._inner: Any = inner
        if inner.viewer is not None:
            inner.viewer.caption = text
        self._directly = _only_checks_between(env, inner)
        self._tolerance = rounding(inner.problem)
        self._interventions = 0
        self._infeasible = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._interventions = 0
        self._infeasible = 0
        return observation, {**info, **rest_info(self._inner.problem)}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Filter the action and hold it for one control period."""
        proposed = self._inner.physical_action(action)
        decision = self.safety_filter.decide_floats(self._inner.components, proposed)
        executed, nominal, active = decision.action, decision.proposed, True in decision.active
        if self._inner.viewer is not None:
            self._inner.viewer.announce([nominal], [active], [decision.feasible])
        if self._directly:
            observation, reward, terminated, truncated, info = self._inner.step_physical(executed)
        else:
            observation, reward, terminated, truncated, info = self.env.step(
                self._inner.normalized_action(executed)
            )
            if any(
                [  # noqa: C419
                    abs(u - v) > t
                    for u, v, t in zip(executed, self._inner.executed, self._tolerance, strict=True)
                ]
            ):
                raise changed_action(self, executed, self._inner.executed)
        differs = active and executed != nominal
        self._interventions += differs
        self._infeasible += not decision.feasible
        info.update(
            filter_info(
                np.array(nominal),
                np.array(executed),
                differs,
                active,
                decision.feasible,
                max(decision.slack),
                np.array(decision.slack),
                decision.cause if differs else -1,
                self._interventions,
                self._infeasible,
            )
        )
        return observation, reward, terminated, truncated, info


def _readable(env: gym.Env[Any, Any]) -> SafeEnv | SafetyMonitor:
    """The layer of an env from which a filter reads the state."""
    layer = env
    while isinstance(layer, gym.Wrapper) and not isinstance(layer, SafetyMonitor):
        layer = layer.env
    if not isinstance(layer, SafeEnv | SafetyMonitor):
        raise unreadable(layer, vector=False)
    return layer


def unreadable(env: Any, vector: bool) -> ConfigurationError:
    """The error of a filter over an env whose state it cannot read."""
    if isinstance(env, gym.vector.VectorEnv) != vector:
        batched = isinstance(env, gym.vector.VectorEnv)
        kinds = (
            ("SafetyFilterVectorWrapper", "a vector env")
            if batched
            else ("SafetyFilterWrapper", "a single env")
        )
        return ConfigurationError(f"{env} is {kinds[1]}; put {kinds[0]} over it")
    if vector and any(isinstance(each.unwrapped, SafeEnv) for each in getattr(env, "envs", [])):
        return ConfigurationError(
            f"{env} holds envs of this project one by one; make them by gym.make_vec, which is many"
            " times faster too"
        )
    return ConfigurationError(
        f"{env} is not one of this project's envs, so that a filter cannot read its state; give"
        " model, barriers, state_fn: see FilterSpec"
    )


def require_foreign(env: object, ours: type[Any], view: Mapping[str, Any], knowledge: str) -> None:
    """Raise ConfigurationError where a filter is told how to see an env of this project, or to know
    what nobody knows."""
    if isinstance(env, ours):
        raise ConfigurationError(
            f"{', '.join(view)}: only for envs of somebody else; {env} has a model and barriers of"
            " its own"
        )
    if knowledge != "model":
        raise ConfigurationError(
            f"knowledge = {knowledge!r}: of an env of somebody else nothing is known but the model;"
            " use 'model'"
        )


def _only_checks_between(env: gym.Env[Any, Any], inner: SafeEnv | SafetyMonitor) -> bool:
    """Whether no wrapper between the filter and the env could change a step, so that its input need
    not be encoded."""
    while isinstance(env, (OrderEnforcing, PassiveEnvChecker)):
        env = env.env
    return env is inner


def rounding(problem: SafetyProblem) -> list[float]:
    """By how much each input may differ after it went through an env's numbers, float32 at worst."""
    return [1e-6 * (high - low) for low, high in problem.box]


def changed_action(
    wrapper: object, decided: Sequence[Any], executed: Sequence[Any]
) -> ConfigurationError:
    """The error of a wrapper below the filter that changed the action that the filter decided on."""
    return ConfigurationError(
        f"a wrapper below the filter changed the safe action {decided} into {executed}: {wrapper}."
        " Put wrappers that change actions around the filter; several conditions go into one"
        " SafetyFilter"
    )


def build_filter(
    problem: SafetyProblem,
    condition: Condition | Sequence[Condition] | str,
    knowledge: str,
    objective: str,
    priorities: Sequence[float] | None,
) -> tuple[str, SafetyFilter]:
    """Return the filter of one or several conditions for a problem, and the text that names them."""
    safety_filter = SafetyFilter.for_problem(problem, condition, knowledge, objective, priorities)
    return spec_of([condition for _, condition in safety_filter.pairs]), safety_filter


def resting_action(problem: SafetyProblem) -> np.ndarray:
    """The point of the box nearest to 0, reported where no action was executed yet."""
    return np.array([min(max(0.0, low), high) for low, high in problem.box])


def rest_info(problem: SafetyProblem) -> Info:
    """What a filter reports at reset."""
    return filter_info(
        nominal_action=resting_action(problem),
        safe_action=resting_action(problem),
        intervention=False,
        filter_active=False,
        feasible=True,
        slack=0.0,
        slacks=np.zeros(len(problem.barriers)),
        active_barrier=-1,
        episode_interventions=0,
        episode_infeasible=0,
    )
