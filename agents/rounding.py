"""How exactly a barrier is known at a state in floating point: whether an episode violates, or only touches h = 0."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.codegen import compile_function, stacked
from safe_envs.problem import SafetyProblem

_EPSILONS = 64 * np.finfo(float).eps
"""What rounding may add up to over an episode, in parts of the terms of h."""


def touches(problem: SafetyProblem, lowest: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Which of the smallest h <= 0 of episodes cannot be told from 0 in floating point, shape (B,).

    That is so where |h| is at most 64 units of rounding of its terms and of what rounded states make of it.

    Args:
        problem: whose barriers they are of.
        lowest: smallest h of each episode, shape (B,).
        x: the states where they were, shape (B, n).
    """
    plant = problem.plant
    compiled = _sizes(plant.states, tuple(plant.numeric(b.expression) for b in problem.barriers))
    with np.errstate(all="ignore"):
        sizes = stacked(compiled(*np.ascontiguousarray(x.T)), len(x)).max(axis=1)
    return (lowest <= 0.0) & (lowest >= -_EPSILONS * sizes)


@lru_cache(maxsize=64)
def _sizes(states: tuple[sp.Symbol, ...], barriers: tuple[sp.Expr, ...]) -> Any:
    """Compiled sums of the sizes of the terms of each barrier, and of each state times its slope."""
    return compile_function(states, [_size(h, states) for h in barriers], "arrays")


def _size(expression: Any, states: tuple[sp.Symbol, ...]) -> sp.Expr:
    slopes = [(sp.diff(expression, s), s) for s in states]
    parts = [*sp.Add.make_args(expression), *(slope * s for slope, s in slopes if not slope.has(sp.DiracDelta, sp.Derivative, sp.Subs))]
    return sp.Add(*[sp.Abs(part) for part in parts])
