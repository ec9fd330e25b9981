"""Texts of filters, checked against the problem that they are for."""

from __future__ import annotations

from dataclasses import replace

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import parse_conditions, require_readable, spec_of
from safe_envs.wrappers.conditions.names import unfiltered_in_sum
from safe_envs.wrappers.conditions.parts import parts_of
from safe_envs.wrappers.conditions.text_parts import learned_parts, require_known
from safe_envs.wrappers.env_wrappers import lone_filters


def checked_filter(name: str, problem: SafetyProblem, known: ControlAffineSDE) -> str | None:
    """Return the text of a filter with all parameters; None where it has to be learned first.

    Args:
        name: of the filter, as it was given.
        problem: whose barriers it is for.
        known: the system that it knows.

    Raises:
        ConfigurationError: It names something unknown.
        RelativeDegreeError: A condition does not suit a barrier.
    """
    if name == UNFILTERED:
        return UNFILTERED
    if UNFILTERED in name.split("+"):
        raise unfiltered_in_sum(name)
    require_known(name, UNFILTERED)
    settings = lone_filters.settings_of(name)
    if settings is not None:
        return settings.text
    if learned_parts(name):
        require_readable(name, problem)
        return None
    conditions = parse_conditions(name, problem)
    # What does not suit a barrier is an error before tables are read, which may take long.
    for barrier, condition in parts_of(tuple(zip(problem.barriers, conditions, strict=True)))[1]:
        replace(condition, belief=None, measurement_error=()).constraint(known, barrier)
    return spec_of(conditions)
