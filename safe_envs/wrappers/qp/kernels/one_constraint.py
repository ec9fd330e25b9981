"""`safe_envs.wrappers.qp.one_constraint` for one state: one constraint and input bounds."""

from __future__ import annotations

import numpy as np

from safe_envs.wrappers.qp.kernels.two_inputs import project_two_inputs

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""
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
