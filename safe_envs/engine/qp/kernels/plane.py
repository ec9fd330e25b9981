"""`safe_envs.engine.qp.plane` for one state: several constraints on two inputs.

Lines that meet in a point may miss each other by rounding; then the equations of what binds prove
that the constraints can be met.

The scheme is that of `safe_envs.engine.qp.plane`. Of the scratch array the first k entries are
the offsets of the constraints.

The scratch array consists of blocks of k entries, one for each constraint:

    1, 2, 3      x, y, r: the constraint x u_1 + y u_2 + r in units of the steepest
    4, 5         its margin and what rounding may make of it
    6, 7         the smallest and the largest slack that rounding allows
    8 to 11      x, y, margin and rounding of the constraints that take part in a step, else 0
    12, 13       their components across and along the steepest
    14, 15       how a step changes the margins, and a copy of these
    16           1 where a constraint takes part in a step, else 0

The scratch array is that of `plane_slack`.

The scratch array is that of `plane_slack`, but for these blocks, of k entries each:

    4        margins
    6        how far a step may go until a constraint without a part meets its zero
    16       1 where a constraint takes part, else 0

and behind them k + 2 entries, 1 where letting go a constraint or an input led nowhere, and 2
entries, 1 where an input is held at its bound.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.engine.plain_natives import table_view, vector_view
from safe_envs.engine.qp.kernels.interval import least_square_of_misses
from safe_envs.engine.qp.kernels.many import (
    find_binding,
    normals_of_rows,
    prove_binding,
    work_of_binding,
    work_of_proof,
)


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


NEWTON_STEPS = 20
SURELY_MISSED = 100.0
"""That many times its rounding: one that binds may be violated by a few, and has no slack."""
FARTHEST_LINE = 1e150
"""A line further off than this meets no box. How far does not matter, and its square would
overflow."""


def least_violating_in_plane(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Minimise sum_i priority_i max(0, -(a_i . u + b_i))^2 over a box of two inputs.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        priority: positive weights, shape (k,).
        u: inputs to begin with, shape (2,), inside the input bounds; receives the minimiser.
        work: scratch of `work_of_plane`.
    """
    k = len(b)
    x, y, r = k, 2 * k, 3 * k
    start1, start2 = u[0], u[1]
    size = 0.0
    for i in range(k):
        size = max(size, sqrt(priority[i]) * max(abs(a[i, 0]), abs(a[i, 1])))
    if not size > 0.0:
        size = 1.0
    for i in range(k):
        unit = sqrt(priority[i])
        work[x + i] = a[i, 0] * unit / size  # so that squares neither overflow nor vanish
        work[y + i] = a[i, 1] * unit / size
        work[r + i] = min(max(b[i] * unit / size, -FARTHEST_LINE), FARTHEST_LINE)
    for _ in range(NEWTON_STEPS):
        measure_slacks(k, u, work)
        if forces_balance(k, low, high, u, work):
            return
        newton_in_plane(k, low, high, u, work)
    found1, found2 = u[0], u[1]
    u[0], u[1] = start1, start2
    bounded_least_squares_in_plane(k, low, high, u, work)
    missed, missed_by_fit = 0.0, 0.0
    for i in range(k):
        lack = min(work[x + i] * found1 + work[y + i] * found2 + work[r + i], 0.0)
        missed += lack * lack
        lack = min(work[x + i] * u[0] + work[y + i] * u[1] + work[r + i], 0.0)
        missed_by_fit += lack * lack
    if missed <= missed_by_fit:
        u[0], u[1] = found1, found2


def crossing_is_missed(a: np.ndarray, b: np.ndarray, u: np.ndarray, work: np.ndarray) -> bool:
    """Return whether minimisers are the only inputs with their slacks.

    They are if the constraints that they violate cross.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        u: the minimiser, shape (2,).
        work: scratch of `work_of_plane`.
    """
    k = len(b)
    for i in range(k):
        first, second = a[i, 0] * u[0], a[i, 1] * u[1]
        rounding = ROUNDING * (abs(first) + abs(second) + abs(b[i]))
        violated = first + second + b[i] < -SURELY_MISSED * rounding
        work[8 * k + i] = a[i, 0] if violated else 0.0
        work[9 * k + i] = a[i, 1] if violated else 0.0
    frame_of_plane(k, work)
    crossing = False
    for i in range(k):
        crossing = crossing or work[13 * k + i] != 0.0
    return crossing


def measure_slacks(k: int, u: np.ndarray, work: np.ndarray) -> None:
    """Compute the margins, their rounding, and the slacks that it allows.

    Args:
        k: number of constraints.
        u: inputs, shape (2,).
        work: scratch; blocks 4 to 7 are written.
    """
    for i in range(k):
        first, second, r = work[k + i] * u[0], work[2 * k + i] * u[1], work[3 * k + i]
        margin = first + second + r
        error = ROUNDING * (abs(first) + abs(second) + abs(r))
        work[4 * k + i] = margin
        work[5 * k + i] = error
        work[6 * k + i] = max(-margin - error, 0.0)
        work[7 * k + i] = max(-margin + error, 0.0)


def forces_balance(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> bool:
    """Return whether the forces cancel, along both inputs and along each constraint.

    A constraint has no part in the force along itself. A face of the input bounds pushes inwards,
    as strongly as it takes.

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,).
        work: scratch, of which blocks 1 to 7 are read.
    """
    for c in range(-2, k):
        if c < 0:
            d1, d2 = (1.0, 0.0) if c == -2 else (0.0, 1.0)
        else:
            d1, d2 = -work[2 * k + c], work[k + c]
        down, up = 0.0, 0.0
        for i in range(k):
            first, second = d1 * work[k + i], d2 * work[2 * k + i]
            least, most = work[6 * k + i], work[7 * k + i]
            share = first + second
            error = ROUNDING * (abs(first) + abs(second)) * most
            down += min(share * least, share * most) - error
            up += max(share * least, share * most) + error
        held_down, held_up = False, False
        for j in range(2):
            d = d1 if j == 0 else d2
            at_low, at_high = u[j] <= low[j], u[j] >= high[j]
            held_down = held_down or (at_low and d < 0.0) or (at_high and d > 0.0)
            held_up = held_up or (at_low and d > 0.0) or (at_high and d < 0.0)
        if not ((held_down or down <= 0.0) and (held_up or up >= 0.0)):
            return False
    return True


def newton_in_plane(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> None:
    """Go towards the minimiser of the quadratic that the violated constraints define.

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,), which are moved.
        work: scratch of which blocks 1 to 7 are read.
    """
    margin, change, part = 4 * k, 14 * k, 16 * k
    for i in range(k):
        work[part + i] = 1.0 if work[6 * k + i] > 0.0 else 0.0
    goal1, goal2 = u[0], u[1]
    hit = True
    while hit:
        for i in range(k):
            takes_part = work[part + i] > 0.0
            work[8 * k + i] = work[k + i] if takes_part else 0.0
            work[9 * k + i] = work[2 * k + i] if takes_part else 0.0
            work[10 * k + i] = work[margin + i] if takes_part else 0.0
            work[11 * k + i] = work[5 * k + i] if takes_part else 0.0
        goal1, goal2 = least_squares_in_plane(k, low, high, u, work)
        step1, step2 = goal1 - u[0], goal2 - u[1]
        hit = False
        for i in range(k):
            work[change + i] = work[k + i] * step1 + work[2 * k + i] * step2
            # A wall, whose slack may be mere rounding, takes part if the step would go through it.
            if work[7 * k + i] > 0.0 and work[change + i] < 0.0 and work[part + i] == 0.0:
                work[part + i] = 1.0
                hit = True
    for i in range(k):
        work[15 * k + i] = work[margin + i]
    length = least_square_of_misses(k, change, 15 * k, 0.0, 1.0, work)
    if length == 1.0:
        u[0], u[1] = goal1, goal2
    else:
        u[0] = min(max(u[0] + length * (goal1 - u[0]), low[0]), high[0])
        u[1] = min(max(u[1] + length * (goal2 - u[1]), low[1]), high[1])


def least_squares_in_plane(
    k: int, low: np.ndarray, high: np.ndarray, u: np.ndarray, work: np.ndarray
) -> tuple[float, float]:
    """Minimise |x d_1 + y d_2 + r|^2 with u + d within its bounds: inside, or else on an edge.

    Args:
        k: number of constraints.
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        u: inputs, shape (2,).
        work: scratch of which blocks 8 to 11 are read.

    Returns:
        The inputs u + d.
    """
    step1, step2 = unbounded_step_in_plane(k, work)
    goal1, goal2 = u[0] + step1, u[1] + step2
    if low[0] <= goal1 <= high[0] and low[1] <= goal2 <= high[1]:
        return goal1, goal2
    return best_edge_of_plane(k, low, high, u, work)


ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""


def work_of_plane(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_plane`.

    Args:
        k: number of constraints.
        m: number of inputs, 2.
    """
    return max(18 * k + 2 * m, k * m + 2 * k + 2 * m + max(work_of_binding(k, m), work_of_proof(m)))


def project_plane(  # noqa: PLR0913
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
    """Project the inputs of one state.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        priority: positive weights of the squared slacks, shape (k,).
        u: receives the inputs, shape (2,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_plane`.

    Returns:
        Whether all constraints can be met.
    """
    k = len(b)
    clip_to_plane(v, low, high, u)
    missed = False
    for i in range(k):
        margin[i] = a[i, 0] * u[0] + a[i, 1] * u[1] + b[i]
        active[i] = 0.0
        missed = missed or margin[i] < 0.0
    if not missed:
        return True
    for i in range(k):
        work[i] = b[i]
    feasible = nearest_in_plane(a, v, low, high, w, u, work) and met_in_plane(a, b, u, margin)
    if not feasible:
        if not binding_is_proved(a, b, v, low, high, w, u, work):
            for i in range(k):
                work[i] = b[i]
            clip_to_plane(v, low, high, u)
            least_violating_in_plane(a, b, low, high, priority, u, work)
            if not crossing_is_missed(a, b, u, work):
                approach_among_equals(a, b, v, low, high, w, u, work)
        feasible = met_in_plane(a, b, u, margin)
    s1, s2 = reach_in_plane(low, high, w, u, 0.0)
    for i in range(k):
        terms = abs(b[i]) + abs(a[i, 0]) * s1 + abs(a[i, 1]) * s2
        active[i] = 1.0 if margin[i] <= 0.0 or margin[i] <= ROUNDING * terms else 0.0
    return feasible


def binding_is_proved(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Return whether equations prove the nearest inputs that meet all constraints.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        u: receives the inputs, shape (2,), undefined where there are none.
        work: scratch of `work_of_plane`.
    """
    k, m = len(b), len(v)
    normals, place = table_view(work, 0, k, m), k * m
    unit, rows = vector_view(work, place, k), vector_view(work, place + k, k)
    roots, at = vector_view(work, place + 2 * k, m), vector_view(work, place + 2 * k + m, m)
    used = place + 2 * k + 2 * m
    room = vector_view(work, used, len(work) - used)
    normals_of_rows(a, w, normals, unit, roots)
    for i in range(k):
        if not unit[i] > 0.0 and b[i] < 0.0:
            return False
    return find_binding(
        a, b, v, low, high, roots, normals, unit, u, rows, at, room
    ) and prove_binding(a, b, v, low, high, roots, normals, unit, rows, at, u, room)


def met_in_plane(a: np.ndarray, b: np.ndarray, u: np.ndarray, margin: np.ndarray) -> bool:
    """Return whether all constraints are met, and record their margins.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        u: inputs, shape (2,).
        margin: receives the margins, shape (k,).
    """
    met = True
    for i in range(len(b)):
        first, second = a[i, 0] * u[0], a[i, 1] * u[1]
        margin[i] = first + second + b[i]
        allowed = ROUNDING * abs(b[i]) + ROUNDING * abs(first) + ROUNDING * abs(second)
        met = met and margin[i] >= -allowed
    return met


def approach_among_equals(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Move to the nearest of the inputs with the least sum of squared slacks.

    All of these have the same slacks.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        u: inputs with the least sum, shape (2,), which are moved.
        work: scratch of `work_of_plane`.
    """
    least1, least2 = u[0], u[1]
    for i in range(len(b)):
        work[i] = max(b[i], -(a[i, 0] * least1 + a[i, 1] * least2))
    s1, s2 = reach_in_plane(low, high, w, u, 0.0)
    met = nearest_in_plane(a, v, low, high, w, u, work)
    # A step of rounding size would only move an input off the end of its interval.
    if not (met and (abs(u[0] - least1) > ROUNDING * s1 or abs(u[1] - least2) > ROUNDING * s2)):
        u[0], u[1] = least1, least2
