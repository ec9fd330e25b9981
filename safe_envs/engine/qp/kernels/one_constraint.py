"""`safe_envs.engine.qp.one_constraint` for one state: one constraint and input bounds.

A constraint that says nothing of the input is met or not whatever the input is, and has no part in
what follows. Where the minimiser under one of the others alone meets them all, it is that under all
of them; elsewhere the QP is left to a solver.
"""

from __future__ import annotations

import numpy as np

SMALL_SQUARE = 1e-200
"""The square of a constraint that is smaller may vanish on the way,"""
LARGE_SQUARE = 1e200
"""and one that is larger may overflow."""
FAR_OFF = 1e3
"""How many widths of the input bounds a proposal may be off: rounding grows with them."""


def project_two_inputs(  # noqa: PLR0913
    a1: float,
    a2: float,
    b: float,
    v1: float,
    v2: float,
    low1: float,
    low2: float,
    high1: float,
    high2: float,
    w1: float,
    w2: float,
) -> tuple[bool, float, float, float, bool]:
    """Project two inputs onto a_1 u_1 + a_2 u_2 + b >= 0.

    Args:
        a1: coefficient of the first input.
        a2: coefficient of the second input.
        b: offset.
        v1: first proposed input.
        v2: second proposed input.
        low1: lower bound of the first input.
        low2: lower bound of the second input.
        high1: upper bound of the first input.
        high2: upper bound of the second input.
        w1: positive weight of the first input.
        w2: positive weight of the second input.

    Returns:
        Whether the QP is solved, the inputs, the margin, and whether the constraint had to act. It
        is not solved where the constraint cannot be met, a proposal is far off, or sizes ask for
        care.
    """
    c1 = low1 if v1 < low1 else high1 if v1 > high1 else v1
    c2 = low2 if v2 < low2 else high2 if v2 > high2 else v2
    margin = a1 * c1 + a2 * c2 + b
    if margin >= 0.0:
        return True, c1, c2, margin, False
    off1, off2 = abs(v1 - c1), abs(v2 - c2)
    if not (off1 <= FAR_OFF * (high1 - low1) and off2 <= FAR_OFF * (high2 - low2)):
        return False, v1, v2, margin, True
    inside = off1 == 0.0 and off2 == 0.0
    if not inside:
        margin = a1 * v1 + a2 * v2 + b
    d1, d2 = a1 / w1, a2 / w2
    slope = a1 * d1 + a2 * d2
    if not SMALL_SQUARE < slope < LARGE_SQUARE:
        return False, v1, v2, margin, True
    step = margin / slope
    u1, u2 = v1 - step * d1, v2 - step * d2
    if not (low1 <= u1 <= high1 and low2 <= u2 <= high2):
        if d1 == 0.0 or d2 == 0.0:
            return False, v1, v2, margin, True
        end1 = high1 if d1 > 0.0 else low1
        end2 = high2 if d2 > 0.0 else low2
        if not inside:
            # The end of the constraint's edge within the bounds that is nearest: the way along the
            # edge leads into the bounds of one input, and then into those of the other.
            if not low1 <= u1 <= high1:
                u1 = low1 if u1 < low1 else high1
                u2 = -(b + a1 * u1) / a2
            if not low2 <= u2 <= high2:
                u2 = low2 if u2 < low2 else high2
                u1 = -(b + a2 * u2) / a1
        # One stops at its bound, and the other goes on alone.
        elif (end1 - v1) / d1 < (end2 - v2) / d2:
            u1, u2 = end1, -(b + a1 * end1) / a2
        else:
            u1, u2 = -(b + a2 * end2) / a1, end2
        if not (low1 <= u1 <= high1 and low2 <= u2 <= high2):
            return False, v1, v2, margin, True
    first, second = a1 * u1, a2 * u2
    margin = first + second + b
    allowed = ROUNDING * abs(b) + ROUNDING * abs(first) + ROUNDING * abs(second)
    return -allowed <= margin <= allowed, u1, u2, margin, True


ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""
WAY_CORRECTIONS = 3
"""How often the rounding of a long way is taken back: each time it shrinks by a factor of 1e16."""


def project_scalar(
    a: float, b: float, v: float, low: float, high: float
) -> tuple[float, float, bool, bool]:
    """Project a single input: to the root of the constraint, or the bound next to it.

    Args:
        a: coefficient of the constraint.
        b: its offset.
        v: proposed input.
        low: lower bound.
        high: upper bound.

    Returns:
        The input, its margin a u + b, whether the constraint had to act, and whether it can be met.
    """
    u = low if v < low else high if v > high else v
    margin = a * u + b
    if not margin < 0.0:
        return u, margin, False, True
    if a == 0.0:
        return u, margin, True, False
    root = -b / a
    u = low if root < low else high if root > high else root
    product = a * u
    margin = product + b
    return u, margin, True, margin >= -ROUNDING * abs(b) - ROUNDING * abs(product)


def work_of_one_constraint(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_one_constraint`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 7 * m


def project_one_constraint(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
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
    """Project the input of one state onto one constraint.

    Args:
        a: the constraint, shape (1, m).
        b: its offset, shape (1,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: without a say, shape (1,).
        u: receives the inputs, shape (m,).
        margin: receives the margin, shape (1,).
        active: receives whether the constraint had to act, 1 or 0, shape (1,).
        work: scratch of `work_of_one_constraint`.

    Returns:
        Whether the constraint can be met.
    """
    if len(v) == 1:
        u[0], margin[0], acts, feasible = project_scalar(a[0, 0], b[0], v[0], low[0], high[0])
    else:
        solved, feasible, acts = False, True, False
        if len(v) == 2:
            solved, u[0], u[1], margin[0], acts = project_two_inputs(
                a[0, 0], a[0, 1], b[0], v[0], v[1], low[0], low[1], high[0], high[1], w[0], w[1]
            )
        if not solved:
            margin[0], acts, feasible = project_onto_row(a, 0, b[0], v, low, high, w, u, work)
    active[0] = 1.0 if acts else 0.0
    return feasible


def project_onto_row(  # noqa: PLR0913
    a: np.ndarray,
    i: int,
    b: float,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> tuple[float, bool, bool]:
    """Project the inputs of one state onto constraint i of several.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        b: its offset.
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        u: receives the inputs, shape (m,).
        work: scratch of `work_of_one_constraint`.

    Returns:
        The margin, whether the constraint had to act, and whether it can be met.
    """
    m = len(v)
    for j in range(m):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]
    margin = row_margin(a, i, b, u)
    if not margin < 0.0:
        return margin, False, True
    follow_multiplier(a, i, b, v, low, high, w, u, work)
    margin = row_margin(a, i, b, u)
    allowed = row_tolerance(a, i, b, u)
    for _ in range(WAY_CORRECTIONS):
        if -allowed <= margin <= allowed:
            break
        slope = 0.0
        for j in range(m):
            slope += a[i, j] * work[j]
        if not slope > 0.0:
            break
        move_free_inputs(margin / slope, low, high, u, work)
        margin = row_margin(a, i, b, u)
        allowed = row_tolerance(a, i, b, u)
    return margin, True, margin >= -allowed


def row_margin(a: np.ndarray, i: int, b: float, u: np.ndarray) -> float:
    """Return a_i . u + b.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        b: its offset.
        u: inputs, shape (m,).
    """
    total = a[i, 0] * u[0]
    for j in range(1, len(u)):
        total += a[i, j] * u[j]
    return total + b


def row_tolerance(a: np.ndarray, i: int, b: float, u: np.ndarray) -> float:
    """Return by how much constraint i may be violated and count as met.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        b: its offset.
        u: inputs, shape (m,).
    """
    # Each term is scaled by itself, so that their sum does not overflow.
    total = ROUNDING * abs(b)
    for j in range(len(u)):
        total += ROUNDING * abs(a[i, j] * u[j])
    return total


def move_free_inputs(
    step: float, low: np.ndarray, high: np.ndarray, u: np.ndarray, ways: np.ndarray
) -> None:
    """Move the inputs that are free back by a step along their ways, up to their bounds.

    Args:
        step: length in multiples of the ways.
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        u: inputs, shape (m,), which are changed.
        ways: the ways, in front of a scratch array; 0 for inputs that are not free.
    """
    for j in range(len(u)):
        if ways[j] != 0.0:
            moved = u[j] - step * ways[j]
            u[j] = low[j] if moved < low[j] else high[j] if moved > high[j] else moved


def follow_multiplier(  # noqa: PLR0913
    a: np.ndarray,
    i: int,
    b: float,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Find the minimiser where the clipped proposal violates constraint i.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        b: its offset.
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        u: the clipped proposal, shape (m,); receives the minimiser.
        work: scratch of seven times m; receives in front the way of each input along a / w, 0 for
            those that are not free.
    """
    m = len(v)
    row, start, far, enter, leave = m, 2 * m, 3 * m, 4 * m, 5 * m
    size = 0.0
    for j in range(m):
        size = max(size, abs(a[i, j]))
    if size == 0.0:
        size = 1.0
    b = b / size  # so that products neither overflow nor vanish
    for j in range(m):
        work[row + j] = a[i, j] / size
        d = work[row + j] / w[j]
        work[j] = d
        work[start + j] = u[j]
        work[far + j] = u[j]
        work[enter + j] = 0.0
        work[leave + j] = 0.0
        if d != 0.0:
            near = low[j] if d > 0.0 else high[j]
            work[far + j] = high[j] if d > 0.0 else low[j]
            work[enter + j] = max((near - v[j]) / d, 0.0)
            work[leave + j] = max((work[far + j] - v[j]) / d, 0.0)
    # The last kink at which the constraint is violated; the first candidate is the start.
    kink, phi = 0.0, value_at_multiplier(0.0, b, m, work)
    if not phi < 0.0:
        phi = -0.0
    for c in range(enter, 6 * m):
        if work[c] > kink:
            value = value_at_multiplier(work[c], b, m, work)
            if value < 0.0:
                kink, phi = work[c], value
    slope = 0.0
    for j in range(m):
        # Where a component is so far off that it enters and leaves at the same multiplier, up to
        # rounding, it is free there.
        e, x = work[enter + j], work[leave + j]
        free = work[start + j] != work[far + j] and (e <= kink < x or e == kink == x)
        u[j] = input_at_multiplier(kink, j, m, work)
        work[6 * m + j] = work[j] if free else 0.0
        slope += work[row + j] * work[6 * m + j]
    rises = slope > 0.0
    for j in range(m):
        work[j] = work[6 * m + j]
        if not rises:
            u[j] = work[far + j]
    if rises:
        move_free_inputs(phi / slope, low, high, u, work)


def value_at_multiplier(multiplier: float, b: float, m: int, work: np.ndarray) -> float:
    """Return the scaled constraint at a multiplier.

    Args:
        multiplier: that of the constraint.
        b: scaled offset.
        m: number of inputs.
        work: scratch of `follow_multiplier`.
    """
    total = work[m] * input_at_multiplier(multiplier, 0, m, work)
    for j in range(1, m):
        total += work[m + j] * input_at_multiplier(multiplier, j, m, work)
    return total + b


def input_at_multiplier(multiplier: float, j: int, m: int, work: np.ndarray) -> float:
    """Return input j at a multiplier.

    Args:
        multiplier: that of the constraint.
        j: the input.
        m: number of inputs.
        work: scratch of `follow_multiplier`.
    """
    enter = work[4 * m + j]
    if multiplier <= enter:
        return work[2 * m + j]
    if multiplier >= work[5 * m + j]:
        return work[3 * m + j]
    return work[2 * m + j] + (multiplier - enter) * work[j]


def work_of_single_active(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_single_active`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 7 * m + 2 * k


def project_single_active(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    margin: np.ndarray,
    active: np.ndarray,
    work: np.ndarray,
) -> tuple[bool, bool]:
    """Project the inputs of one state where at most one constraint binds.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: without a say, shape (k,).
        u: receives the inputs, shape (m,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_single_active`.

    Returns:
        Whether the QP is solved, and whether all constraints can be met. What is received has a
        meaning only where it is solved.
    """
    k, m = len(b), len(v)
    missed, flat = 7 * m, 7 * m + k
    for j in range(m):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]
    feasible, solved = True, True
    for i in range(k):
        margin[i] = row_margin(a, i, b[i], u)
        work[flat + i] = 1.0 if row_says_nothing(a, i, m) else 0.0
        unmet = work[flat + i] > 0.0 and b[i] < 0.0
        active[i] = 1.0 if unmet else 0.0
        work[missed + i] = 1.0 if margin[i] < 0.0 and not unmet else 0.0
        feasible = feasible and not unmet
        solved = solved and work[missed + i] == 0.0
    for i in range(k):
        if not solved and work[missed + i] > 0.0:
            _, _, met = project_onto_row(a, i, b[i], v, low, high, w, u, work)
            if met and other_rows_allow(k, flat, a, b, u, margin, active, work):
                active[i] = 1.0  # whatever the rounding of the way there left of its margin
                solved = True
    return solved, feasible


def row_says_nothing(a: np.ndarray, i: int, m: int) -> bool:
    """Return whether constraint i does not depend on the input.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        m: number of inputs.
    """
    flat = True
    for j in range(m):
        flat = flat and a[i, j] == 0.0
    return flat


def other_rows_allow(
    k: int,
    flat: int,
    a: np.ndarray,
    b: np.ndarray,
    u: np.ndarray,
    margin: np.ndarray,
    active: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Return whether an input meets all constraints that depend on it, and record its margins.

    Args:
        k: number of constraints.
        flat: where the scratch array says which constraints do not depend on the input.
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        u: inputs, shape (m,).
        margin: receives the margins of those that depend on it, shape (k,).
        active: receives which of these bind, 1 or 0, shape (k,).
        work: scratch of `work_of_single_active`.
    """
    allowed = True
    for i in range(k):
        if work[flat + i] == 0.0:
            reached = row_margin(a, i, b[i], u)
            rounding = row_tolerance(a, i, b[i], u)
            margin[i] = reached
            active[i] = 1.0 if reached <= rounding else 0.0
            allowed = allowed and reached >= -rounding
    return allowed
