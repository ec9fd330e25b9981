"""What a filter for a problem knows: a system, a condition for each barrier, and a goal."""

from __future__ import annotations

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.conditions.spec_text import Conditions, conditions_for
from safe_envs.wrappers.filter_qp.arguments import require_problem, require_word


def known_for_problem(
    problem: SafetyProblem, conditions: Conditions, knowledge: str, objective: str
) -> tuple[ControlAffineSDE, tuple[Condition, ...], CLF | None]:
    """Return the system that a filter knows, its conditions, and its goal if it has one.

    Args:
        problem: that the filter is for.
        conditions: see `SafetyFilter.for_problem`, as for the others.
        knowledge: "model" or "plant".
        objective: "nearest" or "clf".

    Raises:
        SystemDefinitionError: See `SafetyFilter.for_problem`.
        ConfigurationError: See there.
    """
    require_problem(problem)
    require_word("knowledge", knowledge, ("model", "plant"))
    require_word("objective", objective, ("nearest", "clf"))
    if objective == "clf" and problem.clf is None:
        raise ConfigurationError(
            f"objective = 'clf', but {problem.name} has no control Lyapunov function; use 'nearest'"
        )
    each = conditions_for(problem, conditions)
    correcting = [condition.name for condition in each if condition.corrects_model]
    if knowledge == "plant" and 0 < len(correcting) < len(each):
        raise ConfigurationError(
            f"{correcting[0]} corrects the model, and the other barriers' conditions know the"
            " plant; use knowledge='model'"
        )
    known = problem.model if knowledge == "model" or correcting else problem.plant
    return known, each, problem.clf if objective == "clf" else None
