"""Barriers that are minima, as the barriers that each have a constraint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.base import Condition

Pairs = tuple[tuple[Barrier, Condition], ...]
"""Barriers with their conditions."""


def parts_of(pairs: Pairs) -> tuple[tuple[int, ...], Pairs]:
    """Return what has a constraint: the number of its barrier, and the part of it.

    Args:
        pairs: barriers with their conditions.
    """
    found = [(i, part, c) for i, (b, c) in enumerate(pairs) for part in c.parts(b)]
    return tuple(i for i, *_ in found), tuple((part, c) for _, part, c in found)


def with_parts(
    problem: SafetyProblem, conditions: Sequence[Condition]
) -> tuple[SafetyProblem, tuple[Condition, ...]]:
    """Return a problem and its conditions with a barrier for each constraint.

    Args:
        problem: the problem.
        conditions: one for each of its barriers.
    """
    owners, parts = parts_of(tuple(zip(problem.barriers, conditions, strict=True)))
    if len(parts) == len(problem.barriers):
        return problem, tuple(conditions)
    gains = tuple(problem.gains_of(i) for i in owners)
    barriers = tuple(barrier for barrier, _ in parts)
    return replace(problem, barriers=barriers, gains=gains), tuple(c for _, c in parts)
