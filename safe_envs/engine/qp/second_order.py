"""Constraints with an uncertainty that depends on the single input; each is met on an interval.

    min 1/2 (u - v)^2   subject to   a_i u + b_i - sqrt(q_i0 + 2 q_i1 u + q_i2 u^2) >= 0,   low <= u
    <= high

The left-hand side c_i is concave, so that the constraints and the input bounds meet in an interval.
Its ends are roots of (a^2 - q_2) u^2 + 2 (a b - q_1) u + b^2 - q_0 with a u + b >= 0. Where it is
empty, a single constraint is violated least at the maximiser of c_1; for several constraints the
sum of squared slacks is convex, and its minimisers are found by bisection of its derivative between
the inputs at which each constraint alone is violated least.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.engine.qp.rounding import ROUNDING, Entries, Floats, added, stack, total

_BISECTIONS = 64
"""As many as halve an interval of doubles down to neighbours."""


@np.errstate(all="ignore")
def project_arrays(
    a: Entries,
    b: Entries,
    q: Sequence[Entries],
    v: np.ndarray,
    low: Any,
    high: Any,
    priority: Floats,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project the input of each of B states.

    Args:
        a: k coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        q: k forms, whose entries are likewise.
        v: proposed inputs, shape (B,).
        low: lower bound, a float or an array (B,).
        high: upper bound, likewise.
        priority: k positive weights of the squared slacks.

    Returns:
        Inputs (B,), margins c_i (k, B), constraints that bind or cannot be met (k, B), and whether
        all constraints can be met (B,).
    """
    size = len(v)
    slope, offset = stack(a, size), stack(b, size)
    form = np.stack([stack([row[j] for row in q], size) for j in range(3)])
    u = np.minimum(np.maximum(v, low), high)
    margin = _margins(slope, offset, form, u)
    active, feasible = np.zeros(margin.shape, dtype=bool), np.ones(size, dtype=bool)
    acting = np.flatnonzero(~(margin >= 0.0).all(axis=0))
    if acting.size:
        slope, offset, form, wish = (
            slope[:, acting],
            offset[:, acting],
            form[:, :, acting],
            v[acting],
        )
        in_unit = _in_units(slope, offset, form)
        starts, ends = _intervals(*in_unit)
        low, high = [np.broadcast_to(end, size)[acting] for end in (low, high)]
        lo, hi = np.maximum(starts.max(axis=0), low), np.minimum(ends.min(axis=0), high)
        met = lo - hi <= ROUNDING * np.minimum(abs(lo), abs(hi))
        found = np.maximum(np.minimum(np.maximum(wish, lo), hi), low)
        apart = np.flatnonzero(~met)
        if apart.size:
            row, interval = (
                tuple(part[..., apart] for part in in_unit),
                (starts[:, apart], ends[:, apart]),
            )
            nearest = _nearest_of_batch(row, interval, wish[apart], low[apart], high[apart])
            lost = slope[:, apart], offset[:, apart], form[:, :, apart]
            found[apart] = (
                nearest[0]
                if len(slope) == 1
                else _least_violating(*lost, nearest, wish[apart], priority)
            )
        u[acting] = found
        margin[:, acting] = reached = _margins(slope, offset, form, found)
        allowed = _tolerances(slope, offset, form, found)
        active[:, acting] = (reached <= allowed) | (found == starts) | (found == ends)
        feasible[acting] = (reached >= -allowed).all(axis=0)
    return u, margin, active, feasible


def _margins(a: np.ndarray, b: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    return a * u + b - np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))


def _tolerances(a: np.ndarray, b: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """`_tolerance` for arrays (k, B), with the same formulas."""
    linear, terms = 2.0 * q[1] * u, q[2] * u * u
    form, terms = (
        np.maximum(q[0] + linear + terms, 0.0),
        ROUNDING * (np.abs(q[0]) + np.abs(linear) + terms),
    )
    return ROUNDING * np.abs(b) + ROUNDING * np.abs(a * u) + np.sqrt(form + terms) - np.sqrt(form)


def _in_units(
    a: np.ndarray, b: np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_in_unit` for arrays (k, B), with the same formulas."""
    unit = np.maximum(
        np.maximum(abs(a), abs(b)), np.maximum(np.sqrt(abs(q[0])), np.sqrt(abs(q[2])))
    )
    unit = np.where(unit == 0.0, 1.0, unit)
    return a / unit, b / unit, q / unit / unit


def _intervals(a: np.ndarray, b: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_interval` for arrays (k, B), with the same formulas."""
    q0, q1, q2 = q
    leading, middle, last = a * a - q2, a * b - q1, b * b - q0
    discriminant = a * a * q0 - 2.0 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    t = -(middle + np.copysign(root, middle))
    first, second = np.where(t == 0.0, 0.0, t / leading), np.where(t == 0.0, 0.0, last / t)
    first, second = np.minimum(first, second), np.maximum(first, second)
    least, linear, rising = np.sqrt(np.maximum(q0, 0.0)) - b, q2 == 0.0, a > 0.0
    level, flat = linear & (a == 0.0), leading == 0.0
    end = np.where(linear, least / a, -last / (2.0 * middle))
    ray = linear | flat
    start = np.select(
        [level, ray & rising, ray, leading < 0.0, rising],
        [-np.inf, end, -np.inf, first, second],
        -np.inf,
    )
    stop = np.select(
        [level, ray & rising, ray, leading < 0.0, rising],
        [np.inf, np.inf, end, second, np.inf],
        first,
    )
    between = (discriminant >= 0.0) & (b - a * middle / leading >= 0.0)
    met = np.select(
        [level, linear, flat, leading < 0.0], [least <= 0.0, True, middle * a > 0.0, between], True
    )
    return np.where(met, start, np.inf), np.where(met, stop, np.inf)


def _nearest_of_batch(
    row: tuple[np.ndarray, ...],
    interval: tuple[np.ndarray, np.ndarray],
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """`_nearest` for arrays (k, B), with the same formulas."""
    start, end = interval
    u = np.where(
        start == np.inf,
        _maximisers(row[0], row[2], v, low, high),
        np.maximum(np.minimum(v, end), start),
    )
    return np.minimum(np.maximum(u, low), high)


def _maximisers(
    a: np.ndarray, q: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """`_maximiser` for arrays (k, B), with the same formulas."""
    q0, q1, q2 = q
    t, kink = a / np.sqrt(q2), -q1 / q2
    inside = kink + t * np.sqrt(np.maximum(q0 - q1 * q1 / q2, 0.0) / q2) / np.sqrt(1.0 - t * t)
    still = np.where(a > 0.0, np.maximum(v, kink), np.minimum(v, kink))
    end, level = np.where(a > 0.0, high, low), (t * t == 1.0) & (q0 * q2 <= q1 * q1)
    return np.select(
        [q2 == 0.0, t * t < 1.0, level], [np.where(a == 0.0, v, end), inside, still], end
    )


def _least_violating(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    nearest: np.ndarray,
    v: np.ndarray,
    priority: Floats,
) -> np.ndarray:
    """Return the minimiser of the sum of squared slacks nearest to v.

    It lies between the nearest ones of each constraint.
    """
    weights = np.asarray(priority)[:, None]

    def derivative(u: np.ndarray) -> np.ndarray:
        spread = np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))
        rate = a - np.where(spread > 0.0, (q[1] + q[2] * u) / spread, 0.0)
        return total(weights * np.minimum(a * u + b - spread, 0.0) * rate)

    ends = []
    for rises in (np.greater_equal, np.greater):
        lo, hi = nearest.min(axis=0), nearest.max(axis=0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (lo + hi)
            beyond = rises(derivative(middle), 0.0)
            lo, hi = np.where(beyond, lo, middle), np.where(beyond, middle, hi)
        ends.append(0.5 * (lo + hi))
    return np.minimum(np.maximum(v, ends[0]), ends[1])


Quadratic = Entries
"""q_0, q_1 and q_2 of a constraint, a positive semidefinite form of (1, u)."""


def project_floats(
    a: Floats,
    b: Floats,
    q: Sequence[Quadratic],
    v: float,
    low: float,
    high: float,
    priority: Floats,
) -> tuple[float, list[float], list[bool], bool]:
    """Project the input of one state; see `second_order_batch`."""
    u = low if v < low else high if v > high else v
    rows = [(a[i], b[i], q[i]) for i in range(len(b))]
    margin = [_margin(*row, u) for row in rows]
    if min(margin) >= 0.0:
        return u, margin, [False] * len(margin), True
    rows_in_unit = [_in_unit(*row) for row in rows]
    intervals = [_interval(*row) for row in rows_in_unit]
    lo, hi = low, high
    for start, end in intervals:
        lo, hi = max(lo, start), min(hi, end)
    feasible = lo - hi <= ROUNDING * min(abs(lo), abs(hi))
    if len(rows) == 1:
        u = _nearest(rows_in_unit[0], intervals[0], v, low, high)
    elif feasible:
        u = max(min(max(v, lo), hi), low)
    else:
        found, margins, binding, met = project_arrays(a, b, q, np.array([v]), low, high, priority)
        return found.item(), margins[:, 0].tolist(), binding[:, 0].tolist(), met.item()
    margin, allowed = [_margin(*row, u) for row in rows], [_tolerance(*row, u) for row in rows]
    # An end may be rounded by more than the margin that is nothing but rounding.
    active = [g <= t or u in ends for g, t, ends in zip(margin, allowed, intervals, strict=True)]
    return (
        u,
        margin,
        active,
        all([g >= -t for g, t in zip(margin, allowed, strict=True)]),  # noqa: C419
    )


def _in_unit(a: float, b: float, q: Quadratic) -> tuple[float, float, Quadratic]:
    """Return a constraint over its largest coefficient.

    Then products of four neither overflow nor vanish.
    """
    unit = max(abs(a), abs(b), math.sqrt(abs(q[0])), math.sqrt(abs(q[2]))) or 1.0
    return a / unit, b / unit, [entry / unit / unit for entry in q]


def _nearest(
    row: tuple[float, float, Quadratic],
    interval: tuple[float, float],
    v: float,
    low: float,
    high: float,
) -> float:
    """Return the input nearest to v of those at which a constraint is violated least."""
    start, end = interval
    u = _maximiser(row[0], row[2], v, low, high) if start == math.inf else max(min(v, end), start)
    return low if u < low else high if u > high else u


def _maximiser(a: float, q: Quadratic, v: float, low: float, high: float) -> float:
    """Return where c is largest.

    With w = u + q_1/q_2 and s the least sqrt(q/q_2), a = sqrt(q_2) w/sqrt(w^2 + s^2) there, or it
    is at an end.
    """
    q0, q1, q2 = q
    end = high if a > 0.0 else low
    if q2 == 0.0:
        return v if a == 0.0 else end
    t = a / math.sqrt(q2)
    if t * t < 1.0:
        return -q1 / q2 + t * math.sqrt(max(q0 - q1 * q1 / q2, 0.0) / q2) / math.sqrt(1.0 - t * t)
    if t * t == 1.0 and q0 * q2 <= q1 * q1:
        # From the kink on nothing changes any more.
        return max(v, -q1 / q2) if a > 0.0 else min(v, -q1 / q2)
    return end


def _margin(a: float, b: float, q: Quadratic, u: float) -> float:
    return a * u + b - math.sqrt(max(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))


def _tolerance(a: float, b: float, q: Quadratic, u: float) -> float:
    """Return the tolerance of the linear part, and that of the rounding of the form in its root."""
    linear, terms = 2.0 * q[1] * u, q[2] * u * u
    form, terms = max(q[0] + linear + terms, 0.0), ROUNDING * (abs(q[0]) + abs(linear) + terms)
    return ROUNDING * abs(b) + ROUNDING * abs(a * u) + math.sqrt(form + terms) - math.sqrt(form)


def _interval(a: float, b: float, q: Quadratic) -> tuple[float, float]:
    """Return where one constraint is met; an empty interval begins at infinity."""
    q0, q1, q2 = q
    empty = (math.inf, math.inf)
    if q2 == 0.0:
        least = math.sqrt(max(q0, 0.0)) - b
        if a == 0.0:
            return empty if least > 0.0 else (-math.inf, math.inf)
        return (least / a, math.inf) if a > 0.0 else (-math.inf, least / a)
    leading, middle, last = a * a - q2, a * b - q1, b * b - q0
    # (a b - q_1)^2 - leading last, without the products that cancel.
    discriminant = a * a * q0 - 2.0 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1)
    root = math.sqrt(max(discriminant, 0.0))
    if leading == 0.0:
        if middle * a <= 0.0:
            return empty
        end = -last / (2.0 * middle)
        return (end, math.inf) if a > 0.0 else (-math.inf, end)
    t = -(middle + math.copysign(root, middle))
    ends = sorted((t / leading, last / t)) if t else [0.0, 0.0]
    if leading > 0.0:
        return (ends[1], math.inf) if a > 0.0 else (-math.inf, ends[0])
    if discriminant < 0.0 or b - a * middle / leading < 0.0:
        return empty
    return ends[0], ends[1]


_TINY = 1e-300
"""A distance that can divide."""


def majorant(
    q: Sequence[Sequence[Any]], low: Sequence[Any], high: Sequence[Any]
) -> tuple[list[Any], Any]:
    """Return a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within input bounds.

    A constraint less the plane is on the safe side.

    Its slopes are the mean differences between the faces of the input bounds, and c_0 is as small
    as the corners allow: the root is convex, so that it is below the plane everywhere if it is at
    the corners.

    Args:
        q: symmetric Q, (1 + m) x (1 + m), floats or arrays (B,).
        low: m lower bounds.
        high: m upper bounds.

    Returns:
        c, m entries, and c_0, of the shape of the entries of Q.
    """
    m = len(low)
    corners = [[high[j] if k >> j & 1 else low[j] for j in range(m)] for k in range(2**m)]
    roots = []
    for corner in corners:
        w = (1.0, *corner)
        square: Any = added([q[i][j] * (w[i] * w[j]) for i in range(m + 1) for j in range(m + 1)])
        roots.append(np.sqrt(np.maximum(square, 0.0)))
    half = 2.0 ** (m - 1)
    slopes = []
    for j in range(m):
        rise, width = (
            added([r if k >> j & 1 else -r for k, r in enumerate(roots)]),
            high[j] - low[j],
        )
        # An input that is held, its two bounds being equal, has no slope, whatever the rounding of
        # its two faces.
        slopes.append(np.where(width > 0.0, rise / (half * np.maximum(width, _TINY)), 0.0))
    above = [
        r - added([c * e for c, e in zip(slopes, corner, strict=True)])
        for r, corner in zip(roots, corners, strict=True)
    ]
    return slopes, np.maximum.reduce(above)
