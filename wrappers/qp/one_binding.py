"""Several rows of which a single one binds: its own closed form, where the other rows allow what that gives.

The minimiser under one row alone is that under all rows, if it meets them: so exact, and many times faster than a solver,
in most states of most filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from wrappers.qp.one_row import project_arrays as project_onto_row
from wrappers.qp.rows import stack, tolerance, total

Answer = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def project_arrays(
    a: Sequence[np.ndarray], b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: Sequence[Any]
) -> tuple[Answer, np.ndarray]:
    """Project the proposed inputs of the states in which at most one row binds.

    Args:
        a: k rows, each (m, B).
        b: offsets, shape (k, B).
        v: proposed inputs, shape (m, B).
        low: lower bounds, shape (m, B).
        high: upper bounds, shape (m, B).
        w: m positive weights, each a float or an array (B,).

    Returns:
        Inputs (m, B), margins and binding rows (k, B) and feasibility (B,), as far as solved; and the states (indices) that
        are left for a solver.
    """
    u = np.minimum(np.maximum(v, low), high)
    margin, active, feasible = _margins(a, b, u), np.zeros(b.shape, dtype=bool), np.ones(b.shape[1], dtype=bool)
    missed = margin < 0.0
    left = np.flatnonzero(missed.any(axis=0))
    weights = stack(w, b.shape[1])
    for i, row in enumerate(a):
        tried = left[missed[i, left]]
        if not tried.size:
            continue
        found, _, _, met = project_onto_row(
            list(row[:, tried]), b[i, tried], list(v[:, tried]), list(low[:, tried]), list(high[:, tried]), list(weights[:, tried])
        )
        rows = [r[:, tried] for r in a]
        reached = _margins(rows, b[:, tried], np.array(found))
        rounding = np.array([tolerance(r, offset, found) for r, offset in zip(rows, b[:, tried], strict=True)])
        allowed = met & (reached >= -rounding).all(axis=0)
        solved = tried[allowed]
        u[:, solved] = np.array(found)[:, allowed]
        margin[:, solved] = reached[:, allowed]
        active[:, solved] = (reached <= rounding)[:, allowed]
        left = np.setdiff1d(left, solved, assume_unique=True)
    return (u, margin, active, feasible), left


def _margins(a: Sequence[np.ndarray], b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Margins a u + b of each row, shape (k, B)."""
    return np.array([total(row * u) for row in a]) + b
