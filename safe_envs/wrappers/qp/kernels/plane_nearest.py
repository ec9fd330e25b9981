"""The nearest inputs that meet several constraints on two inputs, for one state.

The scheme is that of `safe_envs.wrappers.qp.plane`. Of the scratch array the first k entries are
the offsets of the constraints.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""


def clip_to_plane(v: np.ndarray, low: np.ndarray, high: np.ndarray, u: np.ndarray) -> None:
    """Clip the proposal to the input bounds.

    Args:
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: receives the inputs, shape (2,).
    """
    for j in range(2):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]


def reach_in_plane(
    low: np.ndarray, high: np.ndarray, w: np.ndarray, u: np.ndarray, away: float
) -> tuple[float, float]:
    """Return how far each input can go: to its bound, or as far as u and `away` in the metric.

    Args:
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        u: inputs, shape (2,).
        away: how far more.
    """
    r1, r2 = sqrt(w[0]), sqrt(w[1])
    reach = r1 * abs(u[0]) + r2 * abs(u[1]) + away
    return min(max(-low[0], high[0]), reach / r1), min(max(-low[1], high[1]), reach / r2)


def nearest_in_plane(
    a: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Find the nearest inputs that meet all constraints, one constraint after the other.

    Args:
        a: constraints, shape (k, 2).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        u: receives the inputs, shape (2,), undefined where there are none.
        work: the offsets.

    Returns:
        Whether there are such inputs.
    """
    clip_to_plane(v, low, high, u)
    for i in range(len(a)):
        first, second = a[i, 0] * u[0], a[i, 1] * u[1]
        miss = first + second + work[i]
        if miss < -ROUNDING * (abs(first) + abs(second) + abs(work[i])) and not move_onto_line(
            i, miss, a, v, low, high, w, u, work
        ):
            return False
    return True


def move_onto_line(  # noqa: PLR0913
    i: int,
    miss: float,
    a: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Move to the minimiser on the line of constraint i under those before it.

    Args:
        i: the constraint.
        miss: its margin, below 0.
        a: constraints, shape (k, 2).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        u: inputs that violate it, shape (2,); receives the minimiser.
        work: the offsets.

    Returns:
        Whether the constraints before and the input bounds leave any.
    """
    steepness = abs(a[i, 0]) / sqrt(w[0]) + abs(a[i, 1]) / sqrt(w[1])
    away = -miss / steepness if steepness > 0.0 else -miss
    s1, s2 = reach_in_plane(low, high, w, u, away)
    p = 0 if abs(a[i, 0]) * s1 >= abs(a[i, 1]) * s2 else 1
    f = 1 - p
    if a[i, p] == 0.0:
        return False
    alpha, beta = -work[i] / a[i, p], -a[i, f] / a[i, p]
    aim = v[f] + w[p] * beta * (v[p] - alpha - beta * v[f]) / (w[f] + w[p] * beta * beta)
    lo, hi = low[f], high[f]
    lower, upper, crosses = lo, hi, True
    for c in range(i + 2):
        rp, rf, rb = row_on_plane(c, i, p, a, low, high, work)
        slope, offset = rf + rp * beta, rb + rp * alpha
        if abs(slope) <= ROUNDING * abs(rf):
            crosses = crosses and offset >= -ROUNDING * (abs(rb) + abs(rp * alpha))
        elif slope > 0.0:
            lower = max(lower, -offset / slope)
        elif slope < 0.0:
            upper = min(upper, -offset / slope)
    if not crosses:
        return False
    if lower <= upper:
        free = min(max(aim, lower), upper)
    else:
        aim = min(max(aim, upper), lower)
        free, met = relaxed_on_line(i, p, aim, alpha, beta, a, low, high, work)
        if not met:
            return False
    pivot = alpha + beta * free
    u[p] = low[p] if pivot < low[p] else high[p] if pivot > high[p] else pivot
    u[f] = free
    return True


def row_on_plane(
    c: int, i: int, p: int, a: np.ndarray, low: np.ndarray, high: np.ndarray, work: np.ndarray
) -> tuple[float, float, float]:
    """Return the coefficients of the pivot and the free input, and the offset, of constraint c.

    Args:
        c: the constraint; from i on, the lower and the upper bound of the pivot.
        i: number of constraints.
        p: the pivot.
        a: constraints, shape (k, 2).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        work: the offsets.
    """
    if c < i:
        return a[c, p], a[c, 1 - p], work[c]
    return (1.0, 0.0, -low[p]) if c == i else (-1.0, 0.0, high[p])


def relaxed_on_line(  # noqa: PLR0913
    i: int,
    p: int,
    aim: float,
    alpha: float,
    beta: float,
    a: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    work: np.ndarray,
) -> tuple[float, bool]:
    """Return the free input where constraints leave a line nothing but by rounding.

    Args:
        i: the constraint of the line.
        p: the pivot.
        aim: where the free input should be.
        alpha: the line is u_p = alpha + beta u_f.
        beta: its slope.
        a: constraints, shape (k, 2).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        work: the offsets.

    Returns:
        The free input, and whether all constraints are met there up to rounding.
    """
    lo, hi = low[1 - p], high[1 - p]
    for c in range(i + 2):
        rp, rf, rb = row_on_plane(c, i, p, a, low, high, work)
        slope, offset = rf + rp * beta, rb + rp * alpha
        if abs(slope) > ROUNDING * abs(rf):
            along = (abs(rf) + abs(rp * beta)) * abs(offset / slope)
            end = -(offset + ROUNDING * (abs(rb) + abs(rp * alpha) + along)) / slope
            if slope > 0.0:
                lo = max(lo, end)
            else:
                hi = min(hi, end)
    free = min(max(aim, lo), hi)
    met = lo <= hi
    for c in range(i + 2):
        rp, rf, rb = row_on_plane(c, i, p, a, low, high, work)
        slope, offset = rf + rp * beta, rb + rp * alpha
        terms = abs(rb) + abs(rp * alpha) + (abs(rf) + abs(rp * beta)) * abs(free)
        met = met and slope * free + offset >= -2.0 * ROUNDING * terms
    return free, met
