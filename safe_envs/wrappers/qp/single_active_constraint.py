"""Several constraints of which a single one binds: its closed form, where the others allow it.

The minimiser under one constraint alone is that under all constraints, if it meets them: so exact,
and many times faster than a solver, in most states of most filters.
"""

from __future__ import annotations

import numpy as np

from safe_envs.wrappers.qp.one_constraint import project_arrays as project_onto_row
from safe_envs.wrappers.qp.rounding import ROUNDING, Arrays, Entries, stack, total

Answer = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def project_arrays(
    a: Arrays, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: Entries
) -> tuple[Answer, np.ndarray]:
    """Project the proposed inputs of the states in which at most one constraint binds.

    Args:
        a: k constraints, each (m, B).
        b: offsets, shape (k, B).
        v: proposed inputs, shape (m, B).
        low: lower bounds, shape (m, B).
        high: upper bounds, shape (m, B).
        w: m positive weights, each a float or an array (B,).

    Returns:
        Inputs (m, B), margins and binding constraints (k, B) and feasibility (B,), as far as
        solved; and the states (indices) that are left for a solver.
    """
    u = np.minimum(np.maximum(v, low), high)
    margin, active, feasible = (
        np.array([total(r * u) for r in a]) + b,
        np.zeros(b.shape, dtype=bool),
        np.ones(b.shape[1], dtype=bool),
    )
    missed = margin < 0.0
    left = np.flatnonzero(missed.any(axis=0))
    weights = stack(w, b.shape[1])
    for i, row in enumerate(a):
        tried = left[missed[i, left]]
        if not tried.size:
            continue
        found, _, _, met = project_onto_row(
            list(row[:, tried]),
            b[i, tried],
            list(v[:, tried]),
            list(low[:, tried]),
            list(high[:, tried]),
            list(weights[:, tried]),
        )
        at = np.array(found)
        products = [r[:, tried] * at for r in a]
        reached = np.array([total(p) for p in products]) + b[:, tried]
        # As `tolerances`, from the same products.
        rounding = ROUNDING * np.abs(b[:, tried]) + np.array(
            [total(ROUNDING * np.abs(p)) for p in products]
        )
        allowed = met & (reached >= -rounding).all(axis=0)
        solved = tried[allowed]
        u[:, solved] = at[:, allowed]
        margin[:, solved] = reached[:, allowed]
        active[:, solved] = (reached <= rounding)[:, allowed]
        active[i, solved] = True  # whatever the rounding of a long way there left of its margin
        left = np.setdiff1d(left, solved, assume_unique=True)
    return (u, margin, active, feasible), left
