"""`safe_envs.engine.qp.second_order`: uncertain constraints on one input.

Where a constraint is met is an interval; a ray ends at the largest number, and an empty interval
begins there.
"""

from __future__ import annotations

from math import copysign, sqrt

import numpy as np

SLACK_BISECTIONS = 64
"""As many as halve an interval of doubles down to neighbours."""


def least_violating_of_several(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    priority: np.ndarray,
    v: float,
    left: float,
    right: float,
) -> float:
    """Return the minimiser of the sum of squared slacks nearest to v.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
        priority: positive weights, shape (k,).
        v: proposed input.
        left: no constraint alone is violated least before it.
        right: none is after it.
    """
    first = end_of_least_slacks(a, b, q, priority, left, right, True)
    if v <= first:
        return first
    return min(v, end_of_least_slacks(a, b, q, priority, left, right, False))


def end_of_least_slacks(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    priority: np.ndarray,
    lo: float,
    hi: float,
    first: bool,
) -> float:
    """Return the first or the last minimiser of the sum of squared slacks, by bisection.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
        priority: positive weights, shape (k,).
        lo: where to begin.
        hi: where to end.
        first: whether it is the first.
    """
    for _ in range(SLACK_BISECTIONS):
        middle = 0.5 * (lo + hi)
        rate = 0.0
        for i in range(len(b)):
            form = max(q[i, 0] + middle * (2.0 * q[i, 1] + middle * q[i, 2]), 0.0)
            spread = sqrt(form)
            slope = a[i, 0] - ((q[i, 1] + q[i, 2] * middle) / spread if spread > 0.0 else 0.0)
            rate += priority[i] * min(a[i, 0] * middle + b[i] - spread, 0.0) * slope
        beyond = rate > 0.0 or (first and rate == 0.0)
        if middle == (hi if beyond else lo):
            break
        if beyond:
            hi = middle
        else:
            lo = middle
    return 0.5 * (lo + hi)


ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""
ENDLESS = 1.7976931348623157e308
"""In place of infinity."""


def work_of_second_order(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_second_order`.

    Args:
        k: number of constraints.
        m: number of inputs, 1.
    """
    return 2 * k * m


def project_second_order(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    margin: np.ndarray,
    active: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Project the input of one state.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms of (1, u), q_0, q_1 and q_2 each, shape (k, 3).
        v: proposed input, shape (1,).
        low: lower bound, shape (1,).
        high: upper bound, shape (1,).
        w: without a say, shape (1,).
        priority: positive weights of the squared slacks, shape (k,).
        u: receives the input, shape (1,).
        margin: receives the margins a u + b - sqrt(q_0 + 2 q_1 u + q_2 u^2), shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_second_order`.

    Returns:
        Whether all constraints can be met.
    """
    k = len(b)
    proposed, lowest, highest = v[0], low[0], high[0]
    at = lowest if proposed < lowest else highest if proposed > highest else proposed
    u[0] = at
    missed = False
    for i in range(k):
        margin[i] = uncertain_margin(a[i, 0], b[i], q[i, 0], q[i, 1], q[i, 2], at)
        active[i] = 0.0
        missed = missed or margin[i] < 0.0
    if not missed:
        return True
    lo, hi = lowest, highest
    for i in range(k):
        start, end = uncertain_interval(i, a, b, q)
        work[i], work[k + i] = start, end
        lo, hi = max(lo, start), min(hi, end)
    if k > 1 and lo - hi <= ROUNDING * min(abs(lo), abs(hi)):
        at = max(min(max(proposed, lo), hi), lowest)
    else:
        left, right = ENDLESS, -ENDLESS
        for i in range(k):
            nearest = least_violating_of_one(
                i, work[i], work[k + i], a, b, q, proposed, lowest, highest
            )
            left, right = min(left, nearest), max(right, nearest)
        at = left
        if k > 1:
            at = least_violating_of_several(a, b, q, priority, proposed, left, right)
    u[0] = at
    feasible = True
    for i in range(k):
        margin[i] = uncertain_margin(a[i, 0], b[i], q[i, 0], q[i, 1], q[i, 2], at)
        allowed = uncertain_tolerance(a[i, 0], b[i], q[i, 0], q[i, 1], q[i, 2], at)
        # An end may be rounded by more than the margin that is nothing but rounding.
        binds = margin[i] <= allowed or at == work[i] or at == work[k + i]
        active[i] = 1.0 if binds else 0.0
        feasible = feasible and margin[i] >= -allowed
    return feasible


def uncertain_margin(a: float, b: float, q0: float, q1: float, q2: float, u: float) -> float:
    """Return a u + b - sqrt(q_0 + 2 q_1 u + q_2 u^2).

    Args:
        a: coefficient.
        b: offset.
        q0: the form's constant.
        q1: half its linear term.
        q2: its quadratic term.
        u: the input.
    """
    form = q0 + u * (2.0 * q1 + u * q2)
    return a * u + b - sqrt(0.0 if form < 0.0 else form)


def uncertain_tolerance(a: float, b: float, q0: float, q1: float, q2: float, u: float) -> float:
    """Return the tolerance of the linear part, and that of the rounding of the form in its root.

    Args:
        a: coefficient.
        b: offset.
        q0: the form's constant.
        q1: half its linear term.
        q2: its quadratic term.
        u: the input.
    """
    linear, square = 2.0 * q1 * u, q2 * u * u
    form = max(q0 + linear + square, 0.0)
    error = ROUNDING * (abs(q0) + abs(linear) + square)
    return ROUNDING * abs(b) + ROUNDING * abs(a * u) + sqrt(form + error) - sqrt(form)


def in_unit_of_row(
    i: int, a: np.ndarray, b: np.ndarray, q: np.ndarray
) -> tuple[float, float, float, float, float]:
    """Return constraint i over its largest coefficient: a, b, q_0, q_1 and q_2.

    Then products of four neither overflow nor vanish.

    Args:
        i: the constraint.
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
    """
    unit = max(max(abs(a[i, 0]), abs(b[i])), max(sqrt(abs(q[i, 0])), sqrt(abs(q[i, 2]))))
    if unit == 0.0:
        unit = 1.0
    q0, q1, q2 = q[i, 0] / unit / unit, q[i, 1] / unit / unit, q[i, 2] / unit / unit
    return a[i, 0] / unit, b[i] / unit, q0, q1, q2


def uncertain_interval(
    i: int, a_of: np.ndarray, b_of: np.ndarray, q: np.ndarray
) -> tuple[float, float]:
    """Return where constraint i is met.

    Args:
        i: the constraint.
        a_of: coefficients, shape (k, 1).
        b_of: offsets, shape (k,).
        q: forms, shape (k, 3).
    """
    a, b, q0, q1, q2 = in_unit_of_row(i, a_of, b_of, q)
    if q2 == 0.0:
        least = sqrt(max(q0, 0.0)) - b
        if a == 0.0:
            return (ENDLESS, ENDLESS) if least > 0.0 else (-ENDLESS, ENDLESS)
        return (least / a, ENDLESS) if a > 0.0 else (-ENDLESS, least / a)
    leading, middle, last = a * a - q2, a * b - q1, b * b - q0
    # (a b - q_1)^2 - leading last, without the products that cancel.
    discriminant = a * a * q0 - 2.0 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1)
    root = sqrt(max(discriminant, 0.0))
    if leading == 0.0:
        if middle * a <= 0.0:
            return ENDLESS, ENDLESS
        end = -last / (2.0 * middle)
        return (end, ENDLESS) if a > 0.0 else (-ENDLESS, end)
    t = -(middle + copysign(root, middle))
    first = t / leading if t != 0.0 else 0.0
    second = last / t if t != 0.0 else 0.0
    if leading > 0.0:
        return (max(first, second), ENDLESS) if a > 0.0 else (-ENDLESS, min(first, second))
    if discriminant < 0.0 or b - a * middle / leading < 0.0:
        return ENDLESS, ENDLESS
    return min(first, second), max(first, second)


def least_violating_of_one(  # noqa: PLR0913
    i: int,
    start: float,
    end: float,
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    v: float,
    low: float,
    high: float,
) -> float:
    """Return the input nearest to v of those at which constraint i is violated least.

    Args:
        i: the constraint.
        start: where it begins to be met.
        end: where it ends to be met.
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
        v: proposed input.
        low: lower bound.
        high: upper bound.
    """
    if start >= ENDLESS:
        slope, _, q0, q1, q2 = in_unit_of_row(i, a, b, q)
        at = uncertain_maximiser(slope, q0, q1, q2, v, low, high)
    else:
        at = max(min(v, end), start)
    return low if at < low else high if at > high else at


def uncertain_maximiser(
    a: float, q0: float, q1: float, q2: float, v: float, low: float, high: float
) -> float:
    """Return where the left-hand side of a constraint is largest.

    With w = u + q_1/q_2 and s the least sqrt(q/q_2), a = sqrt(q_2) w/sqrt(w^2 + s^2) there, or it
    is at an end.

    Args:
        a: coefficient.
        q0: the form's constant.
        q1: half its linear term.
        q2: its quadratic term.
        v: proposed input.
        low: lower bound.
        high: upper bound.
    """
    end = high if a > 0.0 else low
    if not q2 > 0.0:
        return v if a == 0.0 else end
    t = a / sqrt(q2)
    if t * t < 1.0:
        spread = sqrt(max(q0 - q1 * q1 / q2, 0.0) / q2)
        return -q1 / q2 + t * spread / sqrt(1.0 - t * t)
    if t * t == 1.0 and q0 * q2 <= q1 * q1:
        # From the kink on nothing changes any more.
        return max(v, -q1 / q2) if a > 0.0 else min(v, -q1 / q2)
    return end


def work_of_majorant(m: int) -> int:
    """Return the length of the scratch array of `majorant_plane`: the corners of the bounds.

    Args:
        m: number of inputs.
    """
    return 2**m


def majorant_plane(
    q: np.ndarray, low: np.ndarray, high: np.ndarray, slopes: np.ndarray, work: np.ndarray
) -> float:
    """Find a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within input bounds.

    Args:
        q: symmetric Q, shape (1 + m, 1 + m).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        slopes: receives c, shape (m,).
        work: scratch of `work_of_majorant`.

    Returns:
        c_0.
    """
    m = len(low)
    corners = 1 << m
    for c in range(corners):
        square = 0.0
        for i in range(m + 1):
            for j in range(m + 1):
                product = entry_of_corner(c, i, low, high) * entry_of_corner(c, j, low, high)
                square += q[i, j] * product
        work[c] = sqrt(0.0 if square < 0.0 else square)
    for j in range(m):
        rise = 0.0
        for c in range(corners):
            rise += work[c] if c >> j & 1 else -work[c]
        # An input that is held, its two bounds being equal, has no slope, whatever the rounding of
        # its two faces.
        width = high[j] - low[j]
        slopes[j] = rise / (0.5 * corners * width) if width > 0.0 else 0.0
    above = 0.0
    for c in range(corners):
        plane = 0.0
        for j in range(m):
            plane += slopes[j] * entry_of_corner(c, j + 1, low, high)
        gap = work[c] - plane
        above = gap if c == 0 or gap > above else above
    return above


def entry_of_corner(c: int, i: int, low: np.ndarray, high: np.ndarray) -> float:
    """Return entry i of [1, u] at corner c of the input bounds.

    Args:
        c: the corner, whose bit j says whether input j is at its upper bound.
        i: the entry.
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
    """
    if i == 0:
        return 1.0
    return high[i - 1] if c >> (i - 1) & 1 else low[i - 1]
