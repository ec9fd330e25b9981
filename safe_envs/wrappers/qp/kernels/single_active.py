"""Several constraints of which a single one binds: its closed form, where the others allow it.

A constraint that says nothing of the input is met or not whatever the input is, and has no part in
what follows. Where the minimiser under one of the others alone meets them all, it is that under all
of them; elsewhere the QP is left to a solver.
"""

from __future__ import annotations

import numpy as np

from safe_envs.wrappers.qp.kernels.one_constraint import (
    project_onto_row,
    row_margin,
    row_tolerance,
)


def work_of_single_active(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_single_active`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 7 * m + 2 * k


def project_single_active(  # noqa: PLR0913
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
) -> tuple[bool, bool]:
    """Project the inputs of one state where at most one constraint binds.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: without a say, shape (k,).
        u: receives the inputs, shape (m,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_single_active`.

    Returns:
        Whether the QP is solved, and whether all constraints can be met. What is received has a
        meaning only where it is solved.
    """
    k, m = len(b), len(v)
    missed, flat = 7 * m, 7 * m + k
    for j in range(m):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]
    feasible, solved = True, True
    for i in range(k):
        margin[i] = row_margin(a, i, b[i], u)
        work[flat + i] = 1.0 if row_says_nothing(a, i, m) else 0.0
        unmet = work[flat + i] > 0.0 and b[i] < 0.0
        active[i] = 1.0 if unmet else 0.0
        work[missed + i] = 1.0 if margin[i] < 0.0 and not unmet else 0.0
        feasible = feasible and not unmet
        solved = solved and work[missed + i] == 0.0
    for i in range(k):
        if not solved and work[missed + i] > 0.0:
            _, _, met = project_onto_row(a, i, b[i], v, low, high, w, u, work)
            if met and other_rows_allow(k, flat, a, b, u, margin, active, work):
                active[i] = 1.0  # whatever the rounding of the way there left of its margin
                solved = True
    return solved, feasible


def row_says_nothing(a: np.ndarray, i: int, m: int) -> bool:
    """Return whether constraint i does not depend on the input.

    Args:
        a: constraints, shape (k, m).
        i: the one that counts.
        m: number of inputs.
    """
    flat = True
    for j in range(m):
        flat = flat and a[i, j] == 0.0
    return flat


def other_rows_allow(
    k: int,
    flat: int,
    a: np.ndarray,
    b: np.ndarray,
    u: np.ndarray,
    margin: np.ndarray,
    active: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Return whether an input meets all constraints that depend on it, and record its margins.

    Args:
        k: number of constraints.
        flat: where the scratch array says which constraints do not depend on the input.
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        u: inputs, shape (m,).
        margin: receives the margins of those that depend on it, shape (k,).
        active: receives which of these bind, 1 or 0, shape (k,).
        work: scratch of `work_of_single_active`.
    """
    allowed = True
    for i in range(k):
        if work[flat + i] == 0.0:
            reached = row_margin(a, i, b[i], u)
            rounding = row_tolerance(a, i, b[i], u)
            margin[i] = reached
            active[i] = 1.0 if reached <= rounding else 0.0
            allowed = allowed and reached >= -rounding
    return allowed
