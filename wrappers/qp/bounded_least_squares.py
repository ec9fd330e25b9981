"""The least sum of squared slacks of one state, by bounded-variable least squares (SciPy's BVLS)."""

from __future__ import annotations

import numpy as np
import scipy.optimize


def least_violating(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """An action of least sum_i priority_i slack_i^2.

    With p the positive and s the negative part of a row's margin, min |a u + b - p|^2 over u in the box and p >= 0 leaves
    s as the residual: a bounded least-squares problem, which BVLS solves exactly.

    Args:
        a: rows, shape (k, m).
        b: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
    """
    k, m = a.shape
    units = np.sqrt(priority)
    units = units / ((units[:, None] * np.abs(a)).max() or 1.0)
    matrix = units[:, None] * np.hstack([a, -np.eye(k)])
    # BVLS asks for low < high; a fixed input gets an interval that the clipping below takes back.
    open_high = np.where(high > low, high, np.nextafter(low, np.inf))
    bounds = np.concatenate([low, np.zeros(k)]), np.concatenate([open_high, np.full(k, np.inf)])
    fit = scipy.optimize.lsq_linear(matrix, -units * b, bounds, method="bvls", tol=1e-14)
    return np.clip(fit.x[:m], low, high)
