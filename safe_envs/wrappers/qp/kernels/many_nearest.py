"""The way to the nearest of the least-violating actions; see `safe_envs.wrappers.qp.active_set`."""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.span import span_of_rows, split_along_span

NEAREST_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""
ALONG_ROW = 1e-13
"""Part of a step along which a constraint changes by rounding only."""
NO_DISTANCE = 1e-13
"""Part of the way to the proposal that is rounding."""


def work_of_many_nearest(m: int) -> int:
    """Return the length of the scratch array of `approach_proposal` for m inputs."""
    return 2 * m * m + 5 * m


def approach_proposal(
    normals: np.ndarray,
    spare: np.ndarray,
    way: np.ndarray,
    ends: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    work: np.ndarray,
) -> None:
    """Go towards the proposal as far as constraints and bounds allow, by a primal method.

    Where no step leads nearer, the rest of the way is a sum of the normals of what holds the step.
    What has the wrong sign in it is let go.

    Args:
        normals: constraints of unit length, shape (k, m).
        spare: by how much each may fall, shape (k,).
        way: to the proposal, shape (m,).
        ends: lowest and highest entries of a step, shape (2, m).
        rows: receives which constraints hold the step, 1 or 0, shape (k,).
        at: receives which bounds do, -1 for a lower and 1 for an upper one, shape (m,).
        work: scratch of `work_of_many_nearest`; receives the step in front.
    """
    k, m = len(spare), len(way)
    step, rest = vector_view(work, 0, m), vector_view(work, m, m)
    move, shares = vector_view(work, 2 * m, m), vector_view(work, 3 * m, m)
    order, basis = vector_view(work, 4 * m, m), table_view(work, 5 * m, m, m)
    triangle = table_view(work, 5 * m + m * m, m, m)
    whole = 0.0
    for i in range(k):
        rows[i] = 0.0
    for j in range(m):
        step[j] = at[j] = 0.0
        whole = max(whole, abs(way[j]))
    for _ in range(NEAREST_STEPS * (k + m)):
        count = span_of_rows(normals, rows, at, basis, triangle, order)
        left, size = 0.0, 0.0
        for j in range(m):
            rest[j] = way[j] - step[j]
        split_along_span(count, rest, at, basis, triangle, shares, move)
        for j in range(m):
            if at[j] == 0.0:
                left = max(left, abs(rest[j]))
                size = max(size, abs(move[j]))
        if size > NO_DISTANCE * left and move_until_stopped(
            normals, spare, ends, size, move, step, rows, at
        ):
            continue
        if not release_pulled(count, normals, rest, NO_DISTANCE * whole, order, shares, rows, at):
            break


def move_until_stopped(
    normals: np.ndarray,
    spare: np.ndarray,
    ends: np.ndarray,
    size: float,
    move: np.ndarray,
    step: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
) -> bool:
    """Make a move, which the first constraint or bound stops that it meets.

    Args:
        normals: constraints of unit length, shape (k, m).
        spare: by how much each may fall from the start, shape (k,).
        ends: lowest and highest entries of a step, shape (2, m).
        size: largest entry of the move.
        move: the move, shape (m,).
        step: the step so far, shape (m,), which is changed.
        rows: which constraints hold the step, shape (k,); receives one that stops it.
        at: which bounds do, shape (m,), likewise.

    Returns:
        Whether something stopped it.
    """
    m = len(step)
    length, stop = 1.0, -1
    for j in range(m):
        if move[j] != 0.0:
            to_end = (ends[1 if move[j] > 0.0 else 0, j] - step[j]) / move[j]
            if to_end < length:
                length, stop = to_end, j
    for i in range(len(spare)):
        change, left = 0.0, 0.0
        for j in range(m):
            change += normals[i, j] * move[j]
            left += normals[i, j] * step[j]
        if rows[i] == 0.0 and change < -ALONG_ROW * size:
            to_row = max(left + spare[i], 0.0) / -change
            if to_row < length:
                length, stop = to_row, m + i
    for j in range(m):
        step[j] = min(max(step[j] + length * move[j], ends[0, j]), ends[1, j])
    if stop >= m:
        rows[stop - m] = 1.0
    elif stop >= 0:
        # One at a time, so that the normals stay independent.
        step[stop] = ends[1 if move[stop] > 0.0 else 0, stop]
        at[stop] = 1.0 if move[stop] > 0.0 else -1.0
    return stop >= 0


def release_pulled(
    count: int,
    normals: np.ndarray,
    rest: np.ndarray,
    nothing: float,
    order: np.ndarray,
    shares: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
) -> bool:
    """Let go what holds the step back from the proposal with the wrong sign, if anything does.

    Args:
        count: number of constraints that hold the step.
        normals: constraints of unit length, shape (k, m).
        rest: the rest of the way, shape (m,).
        nothing: what counts as no pull.
        order: numbers of the constraints that hold the step.
        shares: coefficients of the rest in these.
        rows: which constraints hold the step, shape (k,), which is changed.
        at: which bounds do, shape (m,), likewise.

    Returns:
        Whether something was let go.
    """
    freed, strongest = -1, nothing
    for c in range(count):
        if shares[c] > strongest:
            freed, strongest = int(order[c]), shares[c]
    k = len(rows)
    for j in range(len(at)):
        if at[j] != 0.0:
            push = rest[j]
            for c in range(count):
                push -= shares[c] * normals[int(order[c]), j]
            if -at[j] * push > strongest:
                freed, strongest = k + j, -at[j] * push
    if freed >= k:
        at[freed - k] = 0.0
    elif freed >= 0:
        rows[freed] = 0.0
    return freed >= 0
