"""The filter of which a verification is, as far as its constraints are formulas of the state."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.safety_filter import SafetyFilter


def filter_of_formulas(
    problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str
) -> SafetyFilter:
    """Return the filter of a problem whose constraints depend on the state alone.

    Args:
        problem: with a barrier for each constraint.
        conditions: one for each barrier.
        knowledge: "model" or "plant".

    Raises:
        ConfigurationError: A condition is learned, or a barrier is a maximum.
    """
    if any(c.is_learned for c in conditions):
        raise ConfigurationError(
            "the condition is learned; for bayesian-scbf:simultaneous=P a bound is estimated"
            " over the posterior"
        )
    found = SafetyFilter.for_problem(problem, tuple(conditions), knowledge)
    for barrier, constraint in zip(problem.barriers, found.constraints, strict=True):
        if constraint.alternatives:
            raise ConfigurationError(
                f"barrier {barrier.name} is a maximum: which of its functions counts depends on the"
                " proposed input, and what is proved is of constraints of the state alone"
            )
    return found
