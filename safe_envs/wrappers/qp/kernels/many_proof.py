"""What proves that constraints and bounds hold a minimiser."""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.one_constraint import row_margin, row_tolerance
from safe_envs.wrappers.qp.kernels.span import least_step_in_span, span_of_rows, split_along_span

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""
CORRECTIONS = 2
"""How often the equations are solved: the second time takes back the rounding of a long way."""


def work_of_proof(m: int) -> int:
    """Return the length of the scratch array of `prove_binding` for m inputs."""
    return 2 * m * m + 4 * m


def prove_binding(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Find the point nearest to the proposal where some constraints and bounds hold.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        rows: positive for the constraints that hold, shape (k,).
        at: which bounds hold, -1 for a lower and 1 for an upper one, shape (m,).
        u: receives the point, shape (m,).
        work: scratch of `work_of_proof`.

    Returns:
        Whether it is the minimiser: it meets all constraints, and what holds presses in the right
        direction.
    """
    m = len(u)
    for j in range(m):
        u[j] = low[j] if at[j] < 0.0 else high[j] if at[j] > 0.0 else v[j]
    count = settle_on_rows(a, b, roots, normals, unit, rows, at, u, work)
    for j in range(m):
        u[j] = min(max(u[j], low[j]), high[j])
    nothing = drop_rounding(v, low, high, roots, u)
    for i in range(len(b)):
        if unit[i] > 0.0:
            margin, allowed = row_margin(a, i, b[i], u), row_tolerance(a, i, b[i], u)
            if margin < -allowed or (rows[i] > 0.0 and margin > allowed):
                return False
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, shares = vector_view(work, place, m), vector_view(work, place + m, m)
    way, rest = vector_view(work, place + 2 * m, m), vector_view(work, place + 3 * m, m)
    for j in range(m):
        way[j] = (u[j] - v[j]) * roots[j]
    split_along_span(count, way, at, basis, triangle, shares, rest)
    for c in range(count):
        if not shares[c] >= -nothing:
            return False
    for j in range(m):
        left = way[j]
        for c in range(count):
            left -= shares[c] * normals[int(order[c]), j]
        # A bound presses inwards, as strongly as it takes.
        wrong = -left if at[j] < 0.0 else left if at[j] > 0.0 else abs(left)
        if not wrong <= nothing:
            return False
    return True


def settle_on_rows(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> int:
    """Move inputs that no bound holds by the shortest way to where some constraints are 0.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, shape (k,).
        rows: positive for the constraints that are to be 0, shape (k,).
        at: 0 for the inputs that no bound holds, shape (m,).
        u: inputs, shape (m,), which are moved.
        work: scratch of `work_of_proof`; receives basis, triangle and order of `span_of_rows`.

    Returns:
        How many constraints are in the basis.
    """
    m = len(u)
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, values = vector_view(work, place, m), vector_view(work, place + m, m)
    step = vector_view(work, place + 2 * m, m)
    count = span_of_rows(normals, rows, at, basis, triangle, order)
    for _ in range(CORRECTIONS):
        for c in range(count):
            i = int(order[c])
            values[c] = row_margin(a, i, b[i], u) / unit[i]
        least_step_in_span(count, values, basis, triangle, step)
        for j in range(m):
            u[j] -= step[j] / roots[j]
    return count


def drop_rounding(
    v: np.ndarray, low: np.ndarray, high: np.ndarray, roots: np.ndarray, u: np.ndarray
) -> float:
    """Set inputs that are nothing but rounding of the way from the proposal to 0.

    A constraint of such an input alone may ask for that.

    Args:
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        u: inputs, shape (m,), which are changed.

    Returns:
        The rounding of the way.
    """
    way = 0.0
    for j in range(len(u)):
        way = max(way, abs(u[j] - v[j]) * roots[j])
    for j in range(len(u)):
        if abs(u[j]) <= ROUNDING * way / roots[j]:
            u[j] = min(max(0.0, low[j]), high[j])
    return ROUNDING * way
