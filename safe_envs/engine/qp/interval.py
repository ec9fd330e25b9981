"""Several constraints on one input, which meet the input bounds in an interval.

    min 1/2 (u - v)^2   subject to   a_i u + b_i >= 0,   low <= u <= high

Where the interval is empty, the sum of squared slacks has a single minimiser within the input
bounds, found from its derivative, which is piecewise linear with a kink at the root of each
constraint. A constraint with a_i = 0 has no say in the input.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.engine.qp.rounding import (
    ROUNDING,
    Entries,
    FloatAnswer,
    Floats,
    stack,
    tolerance,
    tolerances,
    total,
)


def project_floats(a: Floats, b: Floats, v: float, low: float, high: float) -> FloatAnswer | None:
    """Project the input of one state; see `project_arrays`.

    Args:
        a: k coefficients.
        b: k offsets.
        v: proposed input.
        low: lower bound.
        high: upper bound.

    Returns:
        As `dispatch.project_floats`; None where no input meets all constraints.
    """
    u = low if v < low else high if v > high else v
    margin = [ai * u + bi for ai, bi in zip(a, b, strict=True)]
    if min(margin) >= 0.0:
        return [u], margin, [False] * len(margin), True
    lo, hi = low, high
    for ai, bi in zip(a, b, strict=True):
        if ai > 0.0:
            root = -bi / ai
            if root > lo:
                lo = root
        elif ai < 0.0:
            root = -bi / ai
            if root < hi:
                hi = root
        elif bi < 0.0:
            return None
    if not lo <= hi:
        return None
    u = lo if v < lo else hi if v > hi else v
    margin = [ai * u + bi for ai, bi in zip(a, b, strict=True)]
    if min(margin) < 0.0 and any(
        g < -tolerance((ai,), bi, (u,)) for ai, bi, g in zip(a, b, margin, strict=True) if g < 0.0
    ):
        return None
    active = [
        g <= 0.0 or g <= ROUNDING * abs(ai * u) + ROUNDING * abs(bi)
        for ai, bi, g in zip(a, b, margin, strict=True)
    ]
    return [u], margin, active, True


@np.errstate(all="ignore")
def project_arrays(
    a: Entries, b: Entries, v: np.ndarray, low: Any, high: Any, priority: Floats
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project the input of each of B states.

    Args:
        a: k coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        v: proposed inputs, shape (B,).
        low: lower bound, a float or an array (B,).
        high: upper bound, likewise.
        priority: k positive weights of the squared slacks.

    Returns:
        Inputs (B,), margins (k, B), constraints that bind or cannot be met (k, B), and whether all
        constraints can be met (B,).
    """
    size = len(v)
    slope, offset = stack(a, size), stack(b, size)
    u = np.minimum(np.maximum(v, low), high)
    margin = slope * u + offset
    active, feasible = np.zeros(margin.shape, dtype=bool), np.ones(size, dtype=bool)
    acting = np.flatnonzero((margin < 0.0).any(axis=0))
    if acting.size:
        box = [np.broadcast_to(end, size)[acting] for end in (low, high)]
        slope, offset = slope[:, acting], offset[:, acting]
        u[acting], margin[:, acting], active[:, acting], feasible[acting] = _project(
            slope, offset, v[acting], box[0], box[1], priority
        )
    return u, margin, active, feasible


def _project(
    a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, priority: Floats
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what `project_arrays` does, for states that violate a constraint."""
    root = -b / a
    lo = np.maximum(low, np.where(a > 0.0, root, -np.inf).max(axis=0))
    hi = np.minimum(high, np.where(a < 0.0, root, np.inf).min(axis=0))
    # Two constraints that meet in one point may miss each other by the rounding of their roots.
    u = np.minimum(np.maximum(np.minimum(np.maximum(v, lo), hi), low), high)
    margin, allowed = a * u + b, tolerances((a,), b, (u,))
    missed = margin < -allowed
    apart = np.flatnonzero((missed & (a != 0.0)).any(axis=0))
    if apart.size:
        a, b = a[:, apart], b[:, apart]
        u[apart] = found = least_violating(a, b, low[apart], high[apart], priority)
        margin[:, apart] = reached = a * found + b
        allowed[:, apart] = rounding = tolerances((a,), b, (found,))
        missed[:, apart] = reached < -rounding
    return u, margin, margin <= allowed, ~missed.any(axis=0)


def least_violating(
    a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, priority: Floats | np.ndarray
) -> np.ndarray:
    """Minimise sum_i priority_i max(0, -(a_i u + b_i))^2 where no input meets all constraints.

    Args:
        a: coefficients, shape (k, B).
        b: offsets, shape (k, B).
        low: lower bounds, shape (B,).
        high: upper bounds, shape (B,).
        priority: k positive weights.

    Returns:
        The minimisers, shape (B,).
    """
    units = np.sqrt(priority)[:, None]
    size = (units * np.maximum(np.abs(a), np.abs(b))).max(axis=0)
    a, b = a * units / size, b * units / size  # so that squares neither overflow nor vanish
    points = np.concatenate([np.minimum(np.maximum(-b / a, low), high), [low, high]])
    derivative = total(a[:, None] * np.minimum(a[:, None] * points + b[:, None], 0.0))
    # The minimiser lies between the last kink before which the sum falls and the first one after
    # which it rises.
    left = np.where(derivative <= 0.0, points, low).max(axis=0)
    right = np.where(derivative >= 0.0, points, high).min(axis=0)
    missed = a * (0.5 * (left + right)) + b < 0.0
    curvature = total(np.where(missed, a * a, 0.0))
    stationary = -total(np.where(missed, a * b, 0.0)) / curvature
    return np.minimum(np.maximum(np.where(curvature > 0.0, stationary, left), left), right)
