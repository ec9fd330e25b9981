"""Violations that are no more than rounding."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.problem.problem import SafetyProblem

_EPSILONS = 64 * np.finfo(float).eps
"""What rounding may add up to over an episode, in parts of the terms of h."""


_NEARLY = 1e-6
"""In parts of the largest h: `touches`, which compiles formulas, looks at no violation beyond."""

_SLIGHT = 1e-9
"""What rounding and integration may add up to where a filter rides h = 0, in parts of the largest
h."""


class SlightViolations(NamedTuple):
    """Violations that are no more than rounding.

    Attributes:
        touching: how many only touch h = 0.
        below: how many, these included, go no lower than a billionth of the episode's largest h.
        worst: how low the lowest of them goes.
    """

    touching: int
    below: int
    worst: float

    def joined(self, other: SlightViolations) -> SlightViolations:
        """Return those of both."""
        worst = max(self.worst, other.worst)
        return SlightViolations(self.touching + other.touching, self.below + other.below, worst)


def slight_violations(
    problem: SafetyProblem,
    violating: np.ndarray,
    lowest: np.ndarray,
    largest: np.ndarray,
    x: np.ndarray,
) -> SlightViolations:
    """Return which violations are no more than rounding.

    Args:
        problem: whose barriers they are of.
        violating: which episodes violate, shape (B,).
        lowest: minimum h of each, shape (B,).
        largest: maximum h of each, shape (B,).
        x: the states where the minima were, shape (B, n).

    Returns:
        Their numbers, and the worst of them.
    """
    part = violating & (lowest >= -_NEARLY * largest)
    touching = int(touches(problem, lowest[part], x[part]).sum()) if part.any() else 0
    slight = lowest[violating & (lowest >= -_SLIGHT * largest)]
    return SlightViolations(touching, len(slight), float(-slight.min(initial=0.0)))


def touches(problem: SafetyProblem, lowest: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return which of the minima h <= 0 are 0 to floating-point precision, shape (B,).

    That is so where |h| is at most 64 units of rounding of its terms and of what rounded states
    make of it.

    Args:
        problem: whose barriers they are of.
        lowest: smallest h of each episode, shape (B,).
        x: the states where they were, shape (B, n).
    """
    plant = problem.plant
    compiled, ends = _parts(
        plant.states, tuple(plant.numeric(b.expression) for b in problem.barriers)
    )
    with np.errstate(all="ignore"):
        parts = abs(stacked(compiled(*np.ascontiguousarray(x.T)), len(x)))
    sizes = np.max([parts[:, first:end].sum(axis=1) for first, end in pairwise(ends)], axis=0)
    return (lowest <= 0.0) & (lowest >= -_EPSILONS * sizes)


@lru_cache(maxsize=64)
def _parts(states: tuple[sp.Symbol, ...], barriers: tuple[sp.Expr, ...]) -> tuple[Any, list[int]]:
    """Compile the terms of each barrier, and each state times its slope.

    The list has a 0, and where the terms of each barrier end.
    """
    parts = [
        [*sp.Add.make_args(h), *(s * slope for s in states if not _jumps(slope := sp.diff(h, s)))]
        for h in barriers
    ]
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    return compile_function(states, [part for each in parts for part in each], "arrays"), ends


def _jumps(slope: Any) -> bool:
    return slope.has(sp.DiracDelta, sp.Derivative, sp.Subs)
