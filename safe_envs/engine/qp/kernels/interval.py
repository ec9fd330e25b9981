"""`safe_envs.engine.qp.interval` for one state: several constraints on one input."""

from __future__ import annotations

from math import sqrt

import numpy as np

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""


def work_of_interval(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_interval`.

    Args:
        k: number of constraints.
        m: number of inputs, 1.
    """
    return 2 * k * m


def project_interval(  # noqa: PLR0913
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
    """Project the input of one state.

    Args:
        a: coefficients, shape (k, 1).
        b: offsets, shape (k,).
        v: proposed input, shape (1,).
        low: lower bound, shape (1,).
        high: upper bound, shape (1,).
        w: without a say, shape (1,).
        priority: positive weights of the squared slacks, shape (k,).
        u: receives the input, shape (1,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_interval`.

    Returns:
        Whether all constraints can be met.
    """
    k = len(b)
    lowest, highest, proposed = low[0], high[0], v[0]
    at = lowest if proposed < lowest else highest if proposed > highest else proposed
    u[0] = at
    missed = False
    for i in range(k):
        margin[i] = a[i, 0] * at + b[i]
        active[i] = 0.0
        missed = missed or margin[i] < 0.0
    if not missed:
        return True
    lo, hi = lowest, highest
    for i in range(k):
        slope = a[i, 0]
        if slope > 0.0:
            lo = max(lo, -b[i] / slope)
        elif slope < 0.0:
            hi = min(hi, -b[i] / slope)
    # Two constraints that meet in one point may miss each other by the rounding of their roots.
    at = min(max(min(max(proposed, lo), hi), lowest), highest)
    missed = False
    for i in range(k):
        product = a[i, 0] * at
        reached = product + b[i]
        missed = missed or (a[i, 0] != 0.0 and reached < -scalar_tolerance(product, b[i]))
    if missed:
        for i in range(k):
            unit = sqrt(priority[i])
            work[i] = a[i, 0] * unit
            work[k + i] = b[i] * unit
        at = least_square_of_misses(k, 0, k, lowest, highest, work)
    u[0] = at
    feasible = True
    for i in range(k):
        product = a[i, 0] * at
        allowed = scalar_tolerance(product, b[i])
        margin[i] = product + b[i]
        active[i] = 1.0 if margin[i] <= allowed else 0.0
        feasible = feasible and not margin[i] < -allowed
    return feasible


def scalar_tolerance(product: float, b: float) -> float:
    """Return by how much a constraint on one input may be violated and count as met.

    Args:
        product: its coefficient times the input.
        b: its offset.
    """
    return ROUNDING * abs(b) + ROUNDING * abs(product)


def least_square_of_misses(
    k: int, slopes: int, offsets: int, low: float, high: float, work: np.ndarray
) -> float:
    """Minimise sum_i min(0, a_i u + b_i)^2 where no input meets all constraints.

    Args:
        k: number of constraints.
        slopes: where the k coefficients begin in the scratch array, which are scaled.
        offsets: where the k offsets begin, likewise.
        low: lower bound.
        high: upper bound.
        work: the scratch array.

    Returns:
        The minimiser; of several the middle one.
    """
    size = 0.0
    for i in range(k):
        size = max(size, max(abs(work[slopes + i]), abs(work[offsets + i])))
    if not size > 0.0:
        return low
    for i in range(k):
        work[slopes + i] /= size  # so that squares neither overflow nor vanish
        work[offsets + i] /= size
    # The derivative has a kink at each root; the minimiser lies between the last kink before which
    # the sum falls and the first one after which it rises.
    left, right = low, high
    for c in range(k + 2):
        if c < k:
            if work[slopes + c] == 0.0:
                continue
            point = -work[offsets + c] / work[slopes + c]
            point = low if point < low else high if point > high else point
        else:
            point = low if c == k else high
        rate = 0.0
        for i in range(k):
            rate += work[slopes + i] * min(work[slopes + i] * point + work[offsets + i], 0.0)
        if rate <= 0.0:
            left = max(left, point)
        if rate >= 0.0:
            right = min(right, point)
    middle = 0.5 * (left + right)
    curvature, force = 0.0, 0.0
    for i in range(k):
        if work[slopes + i] * middle + work[offsets + i] < 0.0:
            curvature += work[slopes + i] * work[slopes + i]
            force += work[slopes + i] * work[offsets + i]
    at = -force / curvature if curvature > 0.0 else left
    return left if at < left else right if at > right else at
