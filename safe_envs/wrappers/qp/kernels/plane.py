"""`safe_envs.wrappers.qp.plane_batch` for one state: several constraints on two inputs.

Lines that meet in a point may miss each other by rounding; then the equations of what binds prove
that the constraints can be met.
"""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.many_binding import find_binding, work_of_binding
from safe_envs.wrappers.qp.kernels.many_proof import prove_binding, work_of_proof
from safe_envs.wrappers.qp.kernels.plane_nearest import (
    clip_to_plane,
    nearest_in_plane,
    reach_in_plane,
)
from safe_envs.wrappers.qp.kernels.plane_slack import crossing_is_missed, least_violating_in_plane
from safe_envs.wrappers.qp.kernels.span import normals_of_rows

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""


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
