"""Whether it matters how an episode counts that leaves the workspace."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.problem.problem import SafetyProblem

_MARGIN = 1e-9
"""Of the size of numbers, for their rounding."""


def leaves_safely(problem: SafetyProblem) -> bool:
    """Return whether a state outside the workspace may be in the safe set.

    False is certain: beyond each bound of a state some barrier is not positive, by interval
    arithmetic, or because it is a concave quadratic form, which is positive in an ellipsoid only.

    Args:
        problem: with the barriers and the workspace.
    """
    barriers = [problem.plant.numeric(barrier.expression) for barrier in problem.barriers]
    symbols = [state.symbol for state in problem.states]
    values = interval_function(symbols, barriers)
    everywhere = Interval(np.array(-np.inf), np.array(np.inf))
    extents = [_extents(barrier) for barrier in barriers]
    for i, state in enumerate(problem.states):
        reached = [extent[state.symbol] for extent in extents if state.symbol in extent]
        for bound, beyond, inside in (
            (state.high, Interval(np.array(state.high), np.array(np.inf)), _below),
            (state.low, Interval(np.array(-np.inf), np.array(state.low)), _above),
        ):
            if math.isinf(bound) or any(inside(extent, bound) for extent in reached):
                continue
            found = values([beyond if j == i else everywhere for j in range(len(symbols))])
            # What is not a number is not known.
            if not any(bool(np.all(h.high <= 0.0)) for h in found):
                return True
    return False


def _below(extent: tuple[float, float], bound: float) -> bool:
    return extent[1] < bound


def _above(extent: tuple[float, float], bound: float) -> bool:
    return extent[0] > bound


def _extents(barrier: Any) -> dict[Any, tuple[float, float]]:
    """Return the range of each state in the ellipsoid where a concave quadratic form is positive.

    With c + b'x - x'Qx = h0 - (x - x0)'Q(x - x0), the range of x_i is x0_i -+ sqrt(h0 (1/Q)_ii).

    Args:
        barrier: any expression.

    Returns:
        Nothing where it is no such form, or nowhere positive.
    """
    symbols: list[Any] = sorted(barrier.free_symbols, key=str)
    if not symbols or not barrier.is_polynomial(*symbols):
        return {}
    form = sp.Poly(barrier, *symbols)
    if form.total_degree() != 2:
        return {}
    curvature = -np.array(sp.hessian(barrier, symbols), dtype=float) / 2.0
    if np.linalg.eigvalsh(curvature).min() <= _MARGIN * abs(curvature).max():
        return {}
    at_zero = dict.fromkeys(symbols, 0)
    slope = np.array([float(barrier.diff(s).subs(at_zero)) for s in symbols])
    center = np.linalg.solve(curvature, slope) / 2.0
    top = float(barrier.subs(at_zero)) + float(slope @ center) / 2.0
    if top <= 0.0:
        return {}
    half = np.sqrt(top * np.diag(np.linalg.inv(curvature)))
    half += _MARGIN * (half + abs(center))
    return {
        s: (c - d, c + d) for s, c, d in zip(symbols, center.tolist(), half.tolist(), strict=True)
    }
