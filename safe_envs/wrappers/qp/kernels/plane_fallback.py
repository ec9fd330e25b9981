"""`safe_envs.wrappers.qp.bounded_least_squares` for two inputs of one state.

The scratch array is that of `plane_slack`, but for these blocks, of k entries each:

    4        margins
    6        how far a step may go until a constraint without a part meets its zero
    16       1 where a constraint takes part, else 0

and behind them k + 2 entries, 1 where letting go a constraint or an input led nowhere, and 2
entries, 1 where an input is held at its bound.
"""

from __future__ import annotations

import numpy as np

from safe_envs.wrappers.qp.kernels.plane_edges import unbounded_step_in_plane

FALLBACK_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""
NO_FORCE = 1e-12
"""Part of the forces on an input that is rounding."""
BEYOND_STEP = 2.0
"""Length of a step that meets nothing; it ends at 1."""


def bounded_least_squares_in_plane(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> None:
    """Minimise the sum of squared slacks by the method of Stark and Parker (1995).

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs to begin with, shape (2,), inside the input bounds; receives the minimiser.
        work: scratch, of which blocks 1 to 3 are read.
    """
    missed, barred, held = 16 * k, 17 * k, 18 * k + 2
    squares_of_slacks(k, u[0], u[1], work)
    for i in range(k):
        work[missed + i] = 1.0 if work[4 * k + i] < 0.0 else 0.0
    for c in range(k + 4):
        work[barred + c] = 0.0
    freed = -1
    for _ in range(FALLBACK_STEPS * (k + 2)):
        length = step_to_next_stop(k, low, high, u, work)
        if length < 1.0:
            if length > 0.0:
                for c in range(k + 2):
                    work[barred + c] = 0.0
            elif freed >= 0 and (work[missed + freed] if freed < k else work[held + freed - k]):
                work[barred + freed] = 1.0
            freed = -1
            continue
        freed = let_go_in_plane(k, high, u, work)
        if freed < 0:
            break
    # The margins are those of a long way; a last step along the same constraints takes back its
    # rounding, or leads astray.
    step1, step2 = free_step_in_plane(k, work)
    last1 = min(max(u[0] + step1, low[0]), high[0])
    last2 = min(max(u[1] + step2, low[1]), high[1])
    if squares_of_slacks(k, last1, last2, work) < squares_of_slacks(k, u[0], u[1], work):
        u[0], u[1] = last1, last2


def squares_of_slacks(k: int, u1: float, u2: float, work: np.ndarray) -> float:
    """Return the sum of squared slacks, and record the margins.

    Args:
        k: number of constraints.
        u1: first input.
        u2: second input.
        work: scratch; block 4 is written.
    """
    total = 0.0
    for i in range(k):
        margin = work[k + i] * u1 + work[2 * k + i] * u2 + work[3 * k + i]
        work[4 * k + i] = margin
        if margin < 0.0:
            total += margin * margin
    return total


def free_step_in_plane(k: int, work: np.ndarray) -> tuple[float, float]:
    """Return the least-squares step of the inputs that are not held.

    Args:
        k: number of constraints.
        work: scratch; blocks 8 to 13 are written.
    """
    for i in range(k):
        takes_part = work[16 * k + i] > 0.0
        for j in range(2):
            free = takes_part and work[18 * k + 2 + j] == 0.0
            work[(8 + j) * k + i] = work[(1 + j) * k + i] if free else 0.0
        work[10 * k + i] = work[4 * k + i] if takes_part else 0.0
    return unbounded_step_in_plane(k, work)


def step_to_next_stop(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> float:
    """Go as far as no input meets its bound and no constraint without a part its zero.

    Those that stop the step are held, or take part, from then on.

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,), which are moved.
        work: scratch of `bounded_least_squares_in_plane`.

    Returns:
        The part of the step that was taken, 1 if nothing stopped it.
    """
    step1, step2 = free_step_in_plane(k, work)
    end1, end2 = high[0] if step1 > 0.0 else low[0], high[1] if step2 > 0.0 else low[1]
    to_end1 = (end1 - u[0]) / step1 if step1 != 0.0 else BEYOND_STEP
    to_end2 = (end2 - u[1]) / step2 if step2 != 0.0 else BEYOND_STEP
    length = min(min(to_end1, to_end2), 1.0)
    for i in range(k):
        change = work[k + i] * step1 + work[2 * k + i] * step2
        to_row = BEYOND_STEP
        if work[16 * k + i] == 0.0 and change < 0.0:
            to_row = max(work[4 * k + i], 0.0) / -change
        work[6 * k + i] = to_row
        length = min(length, to_row)
    stops1, stops2 = to_end1 <= length, to_end2 <= length
    u[0] = end1 if stops1 else min(max(u[0] + length * step1, low[0]), high[0])
    u[1] = end2 if stops2 else min(max(u[1] + length * step2, low[1]), high[1])
    squares_of_slacks(k, u[0], u[1], work)
    if length < 1.0:
        for i in range(k):
            if work[6 * k + i] <= length:
                work[16 * k + i] = 1.0
        if stops1:
            work[18 * k + 2] = 1.0
        if stops2:
            work[18 * k + 3] = 1.0
    return length


def let_go_in_plane(k: int, high: np.ndarray, u: np.ndarray, work: np.ndarray) -> int:
    """Let go the constraint that is met with most room, or an input that is pushed inwards.

    Args:
        k: number of constraints.
        high: upper bounds, shape (2,).
        u: inputs, shape (2,).
        work: scratch of `bounded_least_squares_in_plane`.

    Returns:
        The constraint, or k plus the input, or -1.
    """
    missed, barred, held = 16 * k, 17 * k, 18 * k + 2
    largest = 0.0
    for i in range(k):
        if work[missed + i] > 0.0:
            steepness = max(abs(work[k + i]), abs(work[2 * k + i]))
            largest = max(largest, abs(work[4 * k + i]) * steepness)
    freed, strongest = -1, 0.0
    for i in range(k):
        if work[missed + i] > 0.0 and work[barred + i] == 0.0:
            pull = work[4 * k + i] * max(abs(work[k + i]), abs(work[2 * k + i]))
            if pull > NO_FORCE * largest and pull > strongest:
                freed, strongest = i, pull
    if freed >= 0:
        work[missed + freed] = 0.0
        return freed
    for j in range(2):
        if work[held + j] > 0.0 and work[barred + k + j] == 0.0:
            push, terms = 0.0, 0.0
            for i in range(k):
                if work[missed + i] > 0.0:
                    force = -work[4 * k + i] * work[(1 + j) * k + i]
                    push += force
                    terms += abs(force)
            if u[j] >= high[j]:
                push = -push
            if push > NO_FORCE * terms and push > strongest:
                freed, strongest = k + j, push
    if freed >= 0:
        work[held + freed - k] = 0.0
    return freed
