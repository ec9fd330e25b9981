"""`safe_envs.wrappers.qp.min_slack` for one state: the least sum of squared slacks on two inputs.

The scratch array consists of blocks of k entries, one for each constraint:

    1, 2, 3      x, y, r: the constraint x u_1 + y u_2 + r in units of the steepest
    4, 5         its margin and what rounding may make of it
    6, 7         the smallest and the largest slack that rounding allows
    8 to 11      x, y, margin and rounding of the constraints that take part in a step, else 0
    12, 13       their components across and along the steepest
    14, 15       how a step changes the margins, and a copy of these
    16           1 where a constraint takes part in a step, else 0
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.wrappers.qp.kernels.interval import least_square_of_misses
from safe_envs.wrappers.qp.kernels.plane_edges import (
    best_edge_of_plane,
    frame_of_plane,
    unbounded_step_in_plane,
)
from safe_envs.wrappers.qp.kernels.plane_fallback import bounded_least_squares_in_plane

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""
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
