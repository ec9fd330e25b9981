"""Whether an episode violates, or only touches h = 0 to rounding."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.problem.problem import SafetyProblem

_EPSILONS = 64 * np.finfo(float).eps
"""What rounding may add up to over an episode, in parts of the terms of h."""


_NEARLY = 1e-6


def may_touch(lowest: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Select the episodes for `touches`, which compiles formulas.

    Args:
        lowest: minimum h of each episode, shape (B,).
        largest: maximum h of each, shape (B,).

    Returns:
        Which episodes are to be looked at, shape (B,).
    """
    return lowest >= -_NEARLY * largest


def touching(
    problem: SafetyProblem,
    violating: np.ndarray,
    lowest: np.ndarray,
    largest: np.ndarray,
    x: np.ndarray,
) -> int:
    """Count the violations that only touch h = 0.

    Args:
        problem: whose barriers they are of.
        violating: which episodes violate, shape (B,).
        lowest: minimum h of each, shape (B,).
        largest: maximum h of each, shape (B,).
        x: the states where the minima were, shape (B, n).
    """
    part = violating & may_touch(lowest, largest)
    return int(touches(problem, lowest[part], x[part]).sum()) if part.any() else 0


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
