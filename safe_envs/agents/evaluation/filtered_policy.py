"""What a bound for the env's own steps is of: a policy under a filter, in a problem."""

from __future__ import annotations

from dataclasses import dataclass

from safe_envs.agents.evaluation.resolved import FilterParts
from safe_envs.problem.problem import SafetyProblem


@dataclass(frozen=True)
class FilteredPolicy:
    """A policy under a filter.

    Attributes:
        problem: what is simulated.
        parts: of the filter; no conditions for the unfiltered env.
        knowledge: of the filter, "model" or "plant".
        policy: its name, "nominal" for the problem's own; "" for an object.
        objective: of the filter, "nearest" or "clf".
        closed_loop: whether a table of its closed loop was asked for.
    """

    problem: SafetyProblem
    parts: FilterParts
    knowledge: str
    policy: str
    objective: str = "nearest"
    closed_loop: bool = False
