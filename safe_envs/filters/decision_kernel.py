"""Parts of a filter's decision on one state, as functions that can be compiled.

They compute what `safe_envs.filters.solver` does, of k constraints on m inputs.

A constraint has the coefficients of 1, of the m inputs u_j, and of u_j u_n, j <= n. On one input it
may have an uncertainty q_0, q_1, q_2 as well, and asks for them to exceed its root.
"""

from __future__ import annotations

from collections.abc import Sequence
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

    See `FilterQPSolver.nearest`.

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


ROUNDS = 12
"""As in `safe_envs.filters.solver`, like the other constants."""
ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""
INWARDS = 1e-8
"""Share of its terms without input by which a constraint at the end of the period exceeds 0."""
FAR = 1e37
"""No point of a line is further away; it is a number in single precision as well."""
BETTER = 0.999999999
"""Share of the squared violations that is left by a step that helps."""
ENOUGH = 0.9
"""Share of them that is left by a round after which another one is tried."""
SLOW = 0.25
"""Share of them that is left by a step after which lines along each input are tried."""
POINTS = 5
"""Where on a line a constraint changes; see `point_of_change`."""
COEFFICIENTS = 7
"""Of a constraint on a line: of 1, t, t^2, the size of its terms, and those of its uncertainty."""


def end_of_period(i: int, dt: float, change: Sequence[float], constraints: np.ndarray) -> None:
    """Turn a constraint of the beginning of the period into that of its end.

    Args:
        i: number of the constraint.
        dt: period in s.
        change: coefficients of its rate of change.
        constraints: coefficients, shape (K, 1 + m + m (m + 1)/2).
    """
    fall = dt * change[0]
    constraints[i, 0] = constraints[i, 0] + fall - INWARDS * (abs(constraints[i, 0]) + abs(fall))
    for e in range(1, len(change)):
        constraints[i, e] += dt * change[e]


def constraints_hold(
    m: int,
    constraints: np.ndarray,
    form: np.ndarray,
    u: np.ndarray,
    slopes: np.ndarray,
    offsets: np.ndarray,
    value: np.ndarray,
    missed: np.ndarray,
) -> bool:
    """Return whether all constraints hold at an input, and linearise them there.

    Args:
        m: number of inputs.
        constraints: coefficients, shape (K, 1 + m + m (m + 1)/2).
        form: uncertainties, 0 for certain constraints, shape (K, 3).
        u: the input, m entries or more.
        slopes: receives the coefficients of the inputs, shape (K, m).
        offsets: receives the offsets, shape (K,).
        value: receives the values, shape (K,).
        missed: receives 1 for constraints that do not hold, and keeps the others, shape (K,).
    """
    holds = True
    for i in range(len(offsets)):
        reached, size, offsets[i] = constraints[i, 0], abs(constraints[i, 0]), constraints[i, 0]
        for j in range(m):
            term = constraints[i, 1 + j] * u[j]
            reached += term
            size += abs(term)
            slopes[i, j] = constraints[i, 1 + j]
        e = 1 + m
        for j in range(m):
            for n in range(j, m):
                term = constraints[i, e] * u[j] * u[n]
                reached += term
                size += abs(term)
                offsets[i] -= term
                slopes[i, j] += constraints[i, e] * u[n]
                slopes[i, n] += constraints[i, e] * u[j]
                e += 1
        allowed = ROUNDING * size
        linear, square = 2.0 * form[i, 1] * u[0], form[i, 2] * u[0] * u[0]
        inside = max(form[i, 0] + linear + square, 0.0)
        if inside > 0.0:
            root, blur = sqrt(inside), ROUNDING * (abs(form[i, 0]) + abs(linear) + square)
            allowed += sqrt(inside + blur) - root
            steepness = (form[i, 1] + form[i, 2] * u[0]) / root
            reached -= root
            slopes[i, 0] -= steepness
            offsets[i] += steepness * u[0] - root
        value[i] = reached
        if not reached >= -allowed:
            missed[i] = 1.0
            holds = False
    return holds


def move_on_line(  # noqa: PLR0913
    m: int,
    constraints: np.ndarray,
    form: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    line: np.ndarray,
) -> float:
    """Move an input along the line to another one, to where constraints are violated least.

    Args:
        m: number of inputs.
        constraints: coefficients, shape (K, 1 + m + m (m + 1)/2).
        form: uncertainties, 0 for certain constraints, shape (K, 3).
        low: lower bounds, m entries or more.
        high: upper bounds, likewise.
        priority: positive weights of the squared violations, shape (K,).
        u: the input, m entries or more, which is changed.
        v: the other one, likewise; receives the direction.
        line: scratch, shape (K, `COEFFICIENTS`).

    Returns:
        Which share of the squared violations is left.
    """
    for j in range(m):
        v[j] -= u[j]
    proposed = 1.0
    if m == 1:
        proposed, v[0] = v[0], 1.0
    first, last = -FAR, FAR
    for j in range(m):
        if v[j] > 0.0:
            first, last = max(first, (low[j] - u[j]) / v[j]), min(last, (high[j] - u[j]) / v[j])
        if v[j] < 0.0:
            first, last = max(first, (high[j] - u[j]) / v[j]), min(last, (low[j] - u[j]) / v[j])
    for i in range(len(priority)):
        reached, slope, bend, size = constraints[i, 0], 0.0, 0.0, abs(constraints[i, 0])
        e = 1 + m
        for j in range(m):
            reached += constraints[i, 1 + j] * u[j]
            slope += constraints[i, 1 + j] * v[j]
            size += abs(constraints[i, 1 + j] * u[j])
            for n in range(j, m):
                reached += constraints[i, e] * u[j] * u[n]
                slope += constraints[i, e] * (u[j] * v[n] + v[j] * u[n])
                bend += constraints[i, e] * v[j] * v[n]
                size += abs(constraints[i, e] * u[j] * u[n])
                e += 1
        line[i, 0], line[i, 1], line[i, 2], line[i, 3] = reached, slope, bend, size
        line[i, 4] = form[i, 0] + 2.0 * form[i, 1] * u[0] + form[i, 2] * u[0] * u[0]
        line[i, 5] = 2.0 * (form[i, 1] + form[i, 2] * u[0]) * v[0]
        line[i, 6] = form[i, 2] * v[0] * v[0]
    before = violation_on_line(line, priority, 0.0)
    best, least = 0.0, before
    for c in range(POINTS * len(priority) + 1):
        t = proposed
        if c < POINTS * len(priority):
            t = point_of_change(c % POINTS, int(c / POINTS), line)
        t = first if t < first else last if t > last else t
        missed = violation_on_line(line, priority, t)
        if missed < BETTER * least or (missed == least and abs(t) < abs(best)):
            best, least = t, missed
    for j in range(m):
        at = u[j] + best * v[j]
        u[j] = low[j] if at < low[j] else high[j] if at > high[j] else at
    return least / before if before > 0.0 else 1.0


def violation_on_line(line: np.ndarray, priority: np.ndarray, t: float) -> float:
    """Return the sum of the squared violations at a point of a line.

    Args:
        line: coefficients of the constraints, shape (K, `COEFFICIENTS`).
        priority: weights, shape (K,).
        t: the point.
    """
    total = 0.0
    for i in range(len(priority)):
        linear, square = line[i, 1] * t, line[i, 2] * t * t
        reached = line[i, 0] + linear + square
        reached -= sqrt(max(line[i, 4] + line[i, 5] * t + line[i, 6] * t * t, 0.0))
        if not reached >= -ROUNDING * (line[i, 3] + abs(linear) + abs(square)):
            total += priority[i] * reached * reached
    return total


def point_of_change(which: int, i: int, line: np.ndarray) -> float:
    """Return a point of a line at which a constraint may begin to hold, or is violated least.

    Args:
        which: 0 for the vertex of a constraint, 1 and 2 for its roots, 3 and 4 for those of an
            uncertain one.
        i: number of the constraint.
        line: coefficients, shape (K, `COEFFICIENTS`).

    Returns:
        The point, a little beyond a root; 0 where there is none.
    """
    constant, rate, bend = line[i, 0], line[i, 1], line[i, 2]
    if which == 0:
        return ratio(-0.5 * rate, bend)
    if which > 2:
        if line[i, 4] == 0.0 and line[i, 6] == 0.0:
            return 0.0  # the constraint is certain
        constant, rate = constant * constant - line[i, 4], 2.0 * constant * rate - line[i, 5]
        bend = line[i, 1] * line[i, 1] - line[i, 6]
    square = rate * rate - 4.0 * bend * constant
    root = sqrt(0.0 if square < 0.0 else square)
    half = -0.5 * (rate + (root if rate > 0.0 else -root))
    found = ratio(half, bend) if which == 1 or which == 3 else ratio(constant, half)
    return found + ROUNDING * found


def ratio(numerator: float, denominator: float) -> float:
    """Return a quotient, 0 where it is none.

    Args:
        numerator: of it.
        denominator: of it.
    """
    return numerator / denominator if denominator != 0.0 else 0.0
