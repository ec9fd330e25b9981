"""Which constraints and bounds hold the minimiser, by the dual method of Goldfarb and Idnani.

It begins at the clipped proposal, the minimiser under the input bounds alone, and takes in one
missed constraint or bound after the other; on the way, those are let go whose pressures would
change their sign.

Source: D. Goldfarb, A. Idnani, A numerically stable dual method for solving strictly convex
    quadratic programs, Mathematical Programming 27, 1983.
"""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.one_constraint import row_margin, row_tolerance
from safe_envs.wrappers.qp.kernels.span import span_of_rows, split_along_span

BINDING_STEPS = 10
"""Steps for each constraint and input: many times more than were ever seen."""
NO_WAY = 1e-12
"""Part of a constraint of unit length that rounding leaves."""
BOUNDLESS = 1.7976931348623157e308
"""Length of a step that nothing stops."""


def work_of_binding(k: int, m: int) -> int:
    """Return the length of the scratch array of `find_binding`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 2 * (m * m + 3 * m + k)


def find_binding(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    u: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Find what holds the minimiser.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        u: receives the minimiser, up to rounding, shape (m,).
        rows: receives which constraints hold it, 1 or 0, shape (k,).
        at: receives which bounds do, -1 for a lower and 1 for an upper one, shape (m,).
        work: scratch of `work_of_binding`.

    Returns:
        Whether the method came to an end. It does not where the constraints contradict each other.
    """
    k, m = len(b), len(v)
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, shares = vector_view(work, place, m), vector_view(work, place + m, m)
    step, normal = vector_view(work, place + 2 * m, m), vector_view(work, place + 3 * m, m)
    pressure = vector_view(work, place + 4 * m, k + m)
    rate = vector_view(work, place + 5 * m + k, k + m)
    for i in range(k):
        rows[i] = pressure[i] = 0.0
    for j in range(m):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]
        at[j] = -1.0 if v[j] < low[j] else 1.0 if v[j] > high[j] else 0.0
        pressure[k + j] = abs(v[j] - u[j]) * roots[j]
    new, side = -1, 0.0
    for _ in range(BINDING_STEPS * (k + m)):
        if new < 0:
            new = furthest_outside(a, b, low, high, roots, unit, rows, u)
            if new < 0:
                return True
            pressure[new] = 0.0
            side = normal_of_new(new, normals, low, u, normal)
        count = span_of_rows(normals, rows, at, basis, triangle, order)
        split_along_span(count, normal, at, basis, triangle, shares, step)
        length, first = how_far_pressures_allow(
            count, normals, normal, at, order, shares, pressure, rate
        )
        if new < k:
            missing = -row_margin(a, new, b[new], u) / unit[new]
        else:
            missing = max(low[new - k] - u[new - k], u[new - k] - high[new - k]) * roots[new - k]
        square = 0.0
        for j in range(m):
            square += step[j] * step[j]
        moves = square > NO_WAY * NO_WAY
        whole = max(missing, 0.0) / square if moves else BOUNDLESS
        if first < 0 and not moves:
            return False
        taken = min(length, whole)
        for c in range(k + m):
            pressure[c] = max(pressure[c] - taken * rate[c], 0.0)
        pressure[new] += taken
        if moves:
            for j in range(m):
                u[j] += taken * step[j] / roots[j]
        if whole <= length:
            if new < k:
                rows[new] = 1.0
            else:
                at[new - k] = side
                u[new - k] = low[new - k] if side < 0.0 else high[new - k]
            new = -1
        elif first < k:
            rows[first] = 0.0
        else:
            at[first - k] = 0.0
    return False


def normal_of_new(
    new: int, normals: np.ndarray, low: np.ndarray, u: np.ndarray, normal: np.ndarray
) -> float:
    """Write the normal of a missed constraint or bound.

    Args:
        new: the constraint, or k plus the input.
        normals: constraints of unit length, shape (k, m).
        low: lower bounds, shape (m,).
        u: inputs, shape (m,).
        normal: receives it, shape (m,).

    Returns:
        -1 for a lower bound, 1 for an upper one, 0 for a constraint.
    """
    k = len(normals)
    for j in range(len(u)):
        normal[j] = normals[new, j] if new < k else 0.0
    if new < k:
        return 0.0
    side = -1.0 if u[new - k] < low[new - k] else 1.0
    normal[new - k] = -side
    return side


def furthest_outside(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    u: np.ndarray,
) -> int:
    """Return the constraint, or k plus the input whose bound, is violated most; -1 if none is.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        unit: lengths of the constraints, 0 for those without a say, shape (k,).
        rows: positive for those that hold the input and are not asked, shape (k,).
        u: inputs, shape (m,).
    """
    k, found, most = len(b), -1, 0.0
    for i in range(k):
        if unit[i] > 0.0 and rows[i] == 0.0:
            margin = row_margin(a, i, b[i], u)
            if margin < -row_tolerance(a, i, b[i], u) and -margin / unit[i] > most:
                found, most = i, -margin / unit[i]
    for j in range(len(u)):
        outside = max(low[j] - u[j], u[j] - high[j]) * roots[j]
        if outside > most:
            found, most = k + j, outside
    return found


def how_far_pressures_allow(
    count: int,
    normals: np.ndarray,
    normal: np.ndarray,
    at: np.ndarray,
    order: np.ndarray,
    shares: np.ndarray,
    pressure: np.ndarray,
    rate: np.ndarray,
) -> tuple[float, int]:
    """Return how far a new constraint may press until a pressure vanishes, and which does.

    Args:
        count: number of constraints that hold the input.
        normals: constraints of unit length, shape (k, m).
        normal: the new one, shape (m,).
        at: which bounds hold the input, shape (m,).
        order: numbers of the constraints that hold it.
        shares: theirs of the new one.
        pressure: of constraints and bounds, shape (k + m,).
        rate: receives by how much each falls, shape (k + m,).

    Returns:
        The length, and the constraint, or k plus the input, or -1.
    """
    k, m = len(normals), len(at)
    for i in range(k):
        rate[i] = 0.0
    for c in range(count):
        rate[int(order[c])] = shares[c]
    for j in range(m):
        push = 0.0
        if at[j] != 0.0:
            push = -normal[j]
            for c in range(count):
                push += shares[c] * normals[int(order[c]), j]
            push *= at[j]
        rate[k + j] = push
    length, first = BOUNDLESS, -1
    for c in range(k + m):
        if rate[c] > NO_WAY and (first < 0 or pressure[c] < length * rate[c]):
            length, first = pressure[c] / rate[c], c
    return length, first
