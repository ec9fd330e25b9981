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

import numpy as np

from safe_envs.wrappers.qp import second_order_batch
from safe_envs.wrappers.qp.rounding import ROUNDING, Entries, Floats

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
        found, margins, binding, met = second_order_batch.project_arrays(
            a, b, q, np.array([v]), low, high, priority
        )
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
