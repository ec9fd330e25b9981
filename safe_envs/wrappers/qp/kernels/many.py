"""`safe_envs.wrappers.qp.dispatch` for one state: several constraints on three and more inputs.

Where one constraint binds at most, its closed form; else the constraints and bounds that the method
of Goldfarb and Idnani finds, if the point of their equations nearest to the proposal proves to be
the minimiser; else, in particular where the constraints cannot be met together, the nearest of the
least-violating actions.
"""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.many_binding import find_binding, work_of_binding
from safe_envs.wrappers.qp.kernels.many_nearest import approach_proposal, work_of_many_nearest
from safe_envs.wrappers.qp.kernels.many_proof import (
    drop_rounding,
    prove_binding,
    settle_on_rows,
    work_of_proof,
)
from safe_envs.wrappers.qp.kernels.many_slack import least_violating_of_many, work_of_many_slack
from safe_envs.wrappers.qp.kernels.one_constraint import row_margin, row_tolerance
from safe_envs.wrappers.qp.kernels.single_active import (
    project_single_active,
    work_of_single_active,
)
from safe_envs.wrappers.qp.kernels.span import normals_of_rows

LOST = 4.0
"""How many tolerances of a constraint the way to the nearest action may cost."""


def work_of_many(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_many`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    rooms = (
        work_of_binding(k, m),
        work_of_proof(m),
        k + 4 * m + max(work_of_many_slack(k, m), work_of_many_nearest(m), work_of_proof(m)),
    )
    return max(work_of_single_active(k, m), k * m + 3 * k + 3 * m + max(rooms))


def project_many(  # noqa: PLR0913
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
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        u: receives the inputs, shape (m,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_many`.

    Returns:
        Whether all constraints can be met.
    """
    k, m = len(b), len(v)
    solved, feasible = project_single_active(
        a, b, v, low, high, w, priority, u, margin, active, work
    )
    if solved:
        return feasible
    normals, place = table_view(work, 0, k, m), k * m
    unit, roots = vector_view(work, place, k), vector_view(work, place + k, m)
    rows, at = vector_view(work, place + k + m, k), vector_view(work, place + 2 * k + m, m)
    used = place + 3 * k + 3 * m
    room = vector_view(work, used, len(work) - used)
    offsets = vector_view(work, place + 2 * k + 2 * m, k)
    normals_of_rows(a, w, normals, unit, roots)
    for i in range(k):
        offsets[i] = b[i]
    if not (
        find_binding(a, b, v, low, high, roots, normals, unit, u, rows, at, room)
        and prove_binding(a, offsets, v, low, high, roots, normals, unit, rows, at, u, room)
    ):
        approach_least_violating(
            a, b, v, low, high, priority, roots, normals, unit, rows, at, offsets, u, room
        )
        drop_rounding(v, low, high, roots, u)
    for i in range(k):
        if unit[i] > 0.0:
            margin[i] = row_margin(a, i, b[i], u)
            allowed = row_tolerance(a, i, b[i], u)
            active[i] = 1.0 if margin[i] <= allowed else 0.0
            feasible = feasible and margin[i] >= -allowed
    return feasible


def approach_least_violating(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    offsets: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Find the nearest of the least-violating inputs; see `safe_envs.wrappers.qp.active_set`.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        rows: receives which constraints hold the inputs, shape (k,).
        at: receives which bounds do, shape (m,).
        offsets: receives the offsets of the constraints less their slacks, shape (k,).
        u: receives the inputs, shape (m,).
        work: scratch of k + 4 m entries, and of each of the three steps.
    """
    k, m = len(b), len(u)
    spare, start = vector_view(work, 0, k), vector_view(work, k, m)
    way, ends = vector_view(work, k + m, m), table_view(work, k + 2 * m, 2, m)
    room = vector_view(work, k + 4 * m, len(work) - k - 4 * m)
    for j in range(m):
        u[j] = min(max(v[j], low[j]), high[j])
    least_violating_of_many(a, b, low, high, priority, u, room)
    for i in range(k):
        reached = row_margin(a, i, b[i], u)
        slack = -reached if reached < -row_tolerance(a, i, b[i], u) else 0.0
        offsets[i] = b[i] + slack
        spare[i] = max(reached + slack, 0.0) / unit[i] if unit[i] > 0.0 else 0.0
    for j in range(m):
        start[j] = u[j]
        ends[0, j], ends[1, j] = (low[j] - u[j]) * roots[j], (high[j] - u[j]) * roots[j]
        way[j] = 0.0
        for i in range(k):
            if a[i, j] != 0.0:
                way[j] = (v[j] - u[j]) * roots[j]
    approach_proposal(normals, spare, way, ends, rows, at, room)
    moves = False
    for j in range(m):
        moves = moves or room[j] != 0.0
        moved = start[j] + room[j] / roots[j]
        u[j] = low[j] if at[j] < 0.0 else high[j] if at[j] > 0.0 else moved
    # Where there is no way to go, constraints that are nearly parallel would only add rounding.
    if moves:
        settle_on_rows(a, offsets, roots, normals, unit, rows, at, u, room)
    astray = False
    for j in range(m):
        u[j] = min(max(u[j], low[j]), high[j])
    # Where constraints or inputs differ by many orders of magnitude, rounding may lead astray: then
    # the least-violating action itself is safer.
    for i in range(k):
        worse = max(-row_margin(a, i, b[i], u), 0.0) - max(-row_margin(a, i, b[i], start), 0.0)
        allowed = row_tolerance(a, i, b[i], u) + row_tolerance(a, i, b[i], start)
        astray = astray or not worse <= LOST * allowed
    if astray:
        for j in range(m):
            u[j] = start[j]
