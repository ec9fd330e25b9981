"""Least squares of two inputs for `plane_slack`, on the whole plane and on the edges of a box.

The scratch array is that of `plane_slack`.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""


def frame_of_plane(k: int, work: np.ndarray) -> tuple[float, float]:
    """Find the steepest constraint, and each one's components across and along it.

    The latter are zero where the constraints are parallel.

    Args:
        k: number of constraints.
        work: scratch, of which blocks 8 and 9 are read, and 12 and 13 written.

    Returns:
        The steepest constraint.
    """
    x, y, across, along = 8 * k, 9 * k, 12 * k, 13 * k
    steepest, size = 0, -1.0
    for i in range(k):
        steepness = max(abs(work[x + i]), abs(work[y + i]))
        if steepness > size:
            steepest, size = i, steepness
    n1, n2 = work[x + steepest], work[y + steepest]
    for i in range(k):
        first, second = work[y + i] * n1, work[x + i] * n2
        part = first - second
        work[across + i] = work[x + i] * n1 + work[y + i] * n2
        crosses = abs(part) > ROUNDING * (abs(first) + abs(second))
        work[along + i] = part if crosses else 0.0
    return n1, n2


def unbounded_step_in_plane(k: int, work: np.ndarray) -> tuple[float, float]:
    """Return the least-squares step, in the frame of the steepest constraint.

    It is across that alone where all are parallel.

    Args:
        k: number of constraints.
        work: scratch of which blocks 8 to 10 are read, and 12 and 13 written.
    """
    n1, n2 = frame_of_plane(k, work)
    r, across, along = 10 * k, 12 * k, 13 * k
    square, product, pull = 0.0, 0.0, 0.0
    for i in range(k):
        square += work[across + i] * work[across + i]
        product += work[across + i] * work[along + i]
        pull += work[across + i] * work[r + i]
    if not square > 0.0:
        square = 1.0
    common = product / square
    first, second = -pull / square, 0.0
    lone, force = 0.0, 0.0
    for i in range(k):
        rest = work[along + i] - common * work[across + i]
        lone += rest * rest
        force += rest * (work[r + i] + first * work[across + i])
    if lone > 0.0:
        second = -force / lone
    first = first - common * second
    return first * n1 - second * n2, first * n2 + second * n1


def best_edge_of_plane(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> tuple[float, float]:
    """Return the point of the four edges whose multiplier has the right sign.

    If several do up to rounding, it is that of the least sum, and the nearest.

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,).
        work: scratch of which blocks 8 to 11 are read.
    """
    best1, best2, found, least_wrong, least_sum = u[0], u[1], False, 0.0, 0.0
    for c in range(4):
        j = c % 2
        nearer_low = u[j] - low[j] <= high[j] - u[j]
        at_low = nearer_low == (c < 2)
        end = low[j] if at_low else high[j]
        along, wrong, missed, counts = point_on_edge(k, j, end, at_low, low, high, u, work)
        better = not found or wrong < least_wrong or (wrong == least_wrong and missed < least_sum)
        if counts and better:
            found, least_wrong, least_sum = True, wrong, missed
            best1, best2 = (end, along) if j == 0 else (along, end)
    return best1, best2


def point_on_edge(
    k: int,
    j: int,
    end: float,
    at_low: bool,
    low: np.ndarray,
    high: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> tuple[float, float, float, bool]:
    """Find the best point of an edge.

    Args:
        k: number of constraints.
        j: the input that is held at its bound.
        end: the bound.
        at_low: whether it is the lower one.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,).
        work: scratch of which blocks 8 to 11 are read.

    Returns:
        The other input, how wrong the sign of the multiplier is, the sum of squares, and whether
        the constraints depend on the input that is held.
    """
    other = 1 - j
    fixed, moving, r, error = (8 + j) * k, (8 + other) * k, 10 * k, 11 * k
    square, pull = 0.0, 0.0
    for i in range(k):
        shift = work[fixed + i] * (end - u[j])
        square += work[moving + i] * work[moving + i]
        pull += work[moving + i] * (work[r + i] + shift)
    moved = u[other] + (-pull / square if square > 0.0 else 0.0)
    along = min(max(moved, low[other]), high[other])
    force, fuzz, steepness, missed = 0.0, 0.0, 0.0, 0.0
    for i in range(k):
        shift = work[fixed + i] * (end - u[j])
        turn = work[moving + i] * (along - u[other])
        margin = work[r + i] + shift + turn
        doubt = work[error + i] + ROUNDING * (abs(shift) + abs(turn))
        force += work[fixed + i] * margin
        fuzz += abs(work[fixed + i]) * doubt
        steepness += work[fixed + i] * work[fixed + i]
        if abs(margin) > doubt:
            missed += margin * margin
    if not steepness > 0.0:
        return along, 0.0, missed, False
    if at_low:
        force = -force
    return along, force / sqrt(steepness) if force > fuzz else 0.0, missed, True
