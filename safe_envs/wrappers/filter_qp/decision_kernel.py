"""Parts of a filter's decision on one state, as functions that can be compiled.

They compute what `safe_envs.wrappers.filter_qp.solver` does, of k constraints on m inputs.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

FAR_AWAY = 1e4
"""How many times further than the input bounds reach is far away; as in the solver."""


def aim_outwards(
    m: int,
    a: np.ndarray,
    inside: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    rise: np.ndarray,
    aim: np.ndarray,
) -> None:
    """Aim far away where h of reciprocal conditions outside their domain rises most, if any is.

    Args:
        m: number of inputs.
        a: constraints, shape (k, m).
        inside: 0 for reciprocal conditions outside their domain, else 1, shape (k,).
        low: lower bounds, m entries or more.
        high: upper bounds, likewise.
        w: positive weights, likewise.
        rise: scratch, likewise.
        aim: proposed inputs, likewise, which are changed.
    """
    outside = False
    for j in range(m):
        rise[j] = 0.0
    for i in range(len(inside)):
        if inside[i] == 0.0:
            outside = True
            size = unit_of_row(m, a, i)
            for j in range(m):
                rise[j] += a[i, j] / size
    if not outside:
        return
    size = 0.0
    for j in range(m):
        size = max(size, abs(rise[j]))
    if not size > 0.0:
        size = 1.0
    steepness, span = 0.0, 0.0
    for j in range(m):
        rise[j] /= size
        steepness += rise[j] * rise[j] / w[j]
        span += abs(rise[j]) * (high[j] - low[j])
    far = FAR_AWAY * span / (steepness if steepness > 0.0 else 1.0)
    for j in range(m):
        corner = high[j] if rise[j] > 0.0 else low[j] if rise[j] < 0.0 else aim[j]
        aim[j] = corner + far * rise[j] / w[j]


def unit_of_row(m: int, a: np.ndarray, i: int) -> float:
    """Return the largest size of the coefficients of constraint i; 1 where all are 0.

    Args:
        m: number of inputs.
        a: constraints, shape (k, m).
        i: the one that counts.
    """
    size = 0.0
    for j in range(m):
        size = max(size, abs(a[i, j]))
    return size if size > 0.0 else 1.0


def furthest_constraint(
    m: int,
    a: np.ndarray,
    b: np.ndarray,
    u: np.ndarray,
    w: np.ndarray,
    inside: np.ndarray,
    active: np.ndarray,
) -> int:
    """Return the active constraint whose half-space is furthest from the proposed input.

    A reciprocal one outside its domain is further than any, and one that says nothing of the input
    nearer than any; of several such, the first counts.

    Args:
        m: number of inputs.
        a: constraints, shape (k, m).
        b: offsets, shape (k,), less what is asked for.
        u: proposed inputs, m entries or more.
        w: positive weights, likewise.
        inside: 0 for reciprocal conditions outside their domain, else 1, shape (k,).
        active: 1 for active constraints, else 0, k entries or more.

    Returns:
        Its number, -1 if there is none.
    """
    cause, furthest = -1, -inf
    for i in range(len(b)):
        unit = unit_of_row(m, a, i)  # so that squares neither overflow nor vanish
        square, value = 0.0, 0.0
        for j in range(m):
            share = a[i, j] / unit
            square += share * share / w[j]
            value += a[i, j] * u[j]
        if active[i] > 0.0:
            distance = -inf
            if square > 0.0:
                distance = -(value + b[i]) / unit / sqrt(square) if inside[i] > 0.0 else inf
            if cause < 0 or distance > furthest:
                cause, furthest = i, distance
    return cause


def take_nearest_function(  # noqa: PLR0913
    i: int,
    m: int,
    functions: np.ndarray,
    u: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
) -> None:
    """Write the constraint of a maximum: that of a function whose is nearest to the proposed input.

    See `CompiledQP.nearest`.

    Args:
        i: number of the constraint.
        m: number of inputs.
        functions: coefficients, offset and level of each function, shape (count, m + 2).
        u: proposed inputs, m entries or more.
        low: lower bounds, likewise.
        high: upper bounds, likewise.
        w: positive weights, likewise.
        a: constraints, shape (k, m), which are changed.
        b: offsets, shape (k,), which are changed.
    """
    chosen, top = 0, functions[0, m + 1]
    for f in range(functions.shape[0]):
        if functions[f, m + 1] > top:
            chosen, top = f, functions[f, m + 1]
    least = inf
    for f in range(functions.shape[0]):
        unit = unit_of_row(m, functions, f)
        square, value, most = 0.0, 0.0, 0.0
        for j in range(m):
            part = functions[f, j] / unit
            square += part * part / w[j]
            value += functions[f, j] * u[j]
            most += max(functions[f, j] * low[j], functions[f, j] * high[j])
        distance = -(value + functions[f, m]) / unit
        if square > 0.0:
            distance = distance / sqrt(square)
        distance = max(distance, 0.0)
        keeps = functions[f, m + 1] >= 0.0 or functions[f, m + 1] == top
        if keeps and functions[f, m] + most >= 0.0 and distance < least:
            chosen, least = f, distance
    for j in range(m):
        a[i, j] = functions[chosen, j]
    b[i] = functions[chosen, m]
