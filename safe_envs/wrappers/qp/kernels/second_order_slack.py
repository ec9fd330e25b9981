"""The least sum of squared slacks of uncertain constraints on one input, for one state."""

from __future__ import annotations

from math import sqrt

import numpy as np

SLACK_BISECTIONS = 64
"""As many as halve an interval of doubles down to neighbours."""


def least_violating_of_several(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    priority: np.ndarray,
    v: float,
    left: float,
    right: float,
) -> float:
    """Return the minimiser of the sum of squared slacks nearest to v.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
        priority: positive weights, shape (k,).
        v: proposed input.
        left: no constraint alone is violated least before it.
        right: none is after it.
    """
    first = end_of_least_slacks(a, b, q, priority, left, right, True)
    if v <= first:
        return first
    return min(v, end_of_least_slacks(a, b, q, priority, left, right, False))


def end_of_least_slacks(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    priority: np.ndarray,
    lo: float,
    hi: float,
    first: bool,
) -> float:
    """Return the first or the last minimiser of the sum of squared slacks, by bisection.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        q: forms, shape (k, 3).
        priority: positive weights, shape (k,).
        lo: where to begin.
        hi: where to end.
        first: whether it is the first.
    """
    for _ in range(SLACK_BISECTIONS):
        middle = 0.5 * (lo + hi)
        rate = 0.0
        for i in range(len(b)):
            form = max(q[i, 0] + middle * (2.0 * q[i, 1] + middle * q[i, 2]), 0.0)
            spread = sqrt(form)
            slope = a[i, 0] - ((q[i, 1] + q[i, 2] * middle) / spread if spread > 0.0 else 0.0)
            rate += priority[i] * min(a[i, 0] * middle + b[i] - spread, 0.0) * slope
        beyond = rate > 0.0 or (first and rate == 0.0)
        if middle == (hi if beyond else lo):
            break
        if beyond:
            hi = middle
        else:
            lo = middle
    return 0.5 * (lo + hi)
