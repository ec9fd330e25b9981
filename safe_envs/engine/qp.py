"""The quadratic program of a filter: one text, interpreted on lists or compiled on pointers.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a_i . u + b_i >= 0,   low <= u <= high

Where the constraints cannot be met together, the answer is the nearest to v of the least-violating
inputs: those that minimise sum_i priority_i slack_i^2 with slack_i = max(0, -(a_i . u + b_i)).

A constraint counts as met where a_i . u + b_i >= -ROUNDING (|b_i| + sum_j |a_ij u_j|), whatever the
units of constraints and inputs. Feasible means that the returned input meets all constraints so.

One input, and one constraint, have closed forms. Elsewhere, if the answer for one constraint alone
meets the others, it is the answer. Otherwise a first active-set method reduces the slacks (Stark,
Parker, Bounded-variable least squares, Computational Statistics 10, 1995), and a second one goes
from there to v as far as no slack grows (Nocedal, Wright, Numerical Optimization, Sec. 16.5).

All functions take plain numbers and flat arrays: `rows` holds a (k m entries, row by row) and b
(k), `ends` the m lower and the m upper bounds, `weights` w (m) and the priorities (k). `out`
receives the input (m), the margins a_i . u + b_i (k), and 1 for each constraint that binds or
cannot be met, else 0 (k); none binds where the clipped proposal meets them all.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

ROUNDING = 3.552713678800501e-15
"""Relative error of a constraint's value: 16 times the spacing of doubles at 1. The sum of n
products is off by at most n spacings; the rest is for the coefficients, which are rounded."""
FAR_OFF = 1e3
"""Widths of the bounds from which on a proposal drowns the input in its rounding."""
SMALL_SQUARE = 1e-200
"""Squares from here to `LARGE_SQUARE` neither vanish nor overflow."""
LARGE_SQUARE = 1e200
"""See `SMALL_SQUARE`."""
STEPS = 20
"""Steps for each constraint and input: many times more than were ever needed."""
CORRECTIONS = 4
"""Steps that take back the rounding of a long one: each time it shrinks by a factor of 1e16."""
DEPENDENT = 1e-14
"""Part of a vector that remains, by rounding, of one that depends on others."""
FAINT = 1e-100
"""Size of a constraint beside the largest one, below which it has no say against that in any case:
smaller ones are taken for as large, so that their squares do not vanish."""
NO_FORCE = 1e-12
"""Part of the forces of slacks on an input that is rounding."""
NO_DISTANCE = 1e-13
"""Part of a step, or of the distance to the proposal, that is rounding."""
SURELY = 1e3
"""Tolerances from which on a margin is no rounding, nor are the forces that come of it."""
BISECTIONS = 200
"""More than are needed to separate any two doubles by half steps."""
ENDLESS = 1.7976931348623157e308
"""In place of infinity."""

Floats = Any
"""A flat array of numbers: a list where text is interpreted, an array in machine code."""


def scratch_size(k: int, m: int) -> int:
    """Return the length of `work` for k constraints on m inputs."""
    return 4 * k * m + 2 * m * m + 9 * k + 8 * m


def project(
    k: int,
    m: int,
    rows: Floats,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> bool:
    """Write the answer to `out`; return whether all constraints can be met."""
    satisfied = True
    if k == 1 and m == 1:
        return project_scalar(rows[0], rows[1], proposed[0], ends[0], ends[1], out)
    for j in range(m):
        x, low, high = proposed[j], ends[j], ends[m + j]
        out[j] = low if x < low else high if x > high else x
    for i in range(k):
        total = 0.0
        for j in range(m):
            total += rows[i * m + j] * out[j]
        total += rows[k * m + i]
        out[m + i] = total
        out[m + k + i] = 0.0
        if not total >= 0.0:
            satisfied = False
    if satisfied:
        return True
    if m == 1:
        return project_interval(k, rows, rows, False, proposed, ends, weights, out, work)
    if k == 1:
        project_row(0, k, m, rows, proposed, ends, weights, out, work)
        out[m], allowed = residual(0, k, m, rows, out)
        out[m + 1] = 1.0
        return out[m] >= -allowed
    return project_rows(k, m, rows, proposed, ends, weights, out, work)


def project_scalar(a: float, b: float, v: float, low: float, high: float, out: Floats) -> bool:
    """Project one input onto one constraint: to its root, or the bound next to it."""
    u = low if v < low else high if v > high else v
    product = a * u
    out[0], out[1], out[2] = u, product + b, 0.0
    if product + b >= 0.0:
        return True
    if a != 0.0:
        x = -b / a
        u = low if x < low else high if x > high else x
    product = a * u
    out[0], out[1], out[2] = u, product + b, 1.0
    return product + b >= -ROUNDING * abs(b) - ROUNDING * abs(product)


def clip(x: float, j: int, m: int, ends: Floats) -> float:
    """Return input j moved inside its bounds."""
    return ends[j] if x < ends[j] else ends[m + j] if x > ends[m + j] else x


def residual(i: int, k: int, m: int, rows: Floats, u: Floats) -> tuple[float, float]:
    """Return a_i . u + b_i and its tolerance."""
    total, allowed = 0.0, 0.0
    for j in range(m):
        term = rows[i * m + j] * u[j]
        total += term
        allowed += ROUNDING * abs(term)
    b = rows[k * m + i]
    return total + b, allowed + ROUNDING * abs(b)


def count_unmet(k: int, m: int, rows: Floats, out: Floats) -> int:
    """Write margins and binding constraints; return how many are not met."""
    unmet = 0
    for i in range(k):
        total, allowed = residual(i, k, m, rows, out)
        out[m + i] = total
        out[m + k + i] = 1.0 if total <= allowed else 0.0
        if not total >= -allowed:
            unmet += 1
    return unmet


def project_uncertain(
    k: int,
    rows: Floats,
    forms: Floats,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> bool:
    """Project one input onto constraints that may be uncertain; see `project_interval`."""
    u, satisfied = clip(proposed[0], 0, 1, ends), True
    for i in range(k):
        margin, _ = interval_residual(i, k, rows, forms, True, u)
        out[1 + i] = margin
        out[1 + k + i] = 0.0
        satisfied = satisfied and margin >= 0.0
    out[0] = u
    if satisfied:
        return True
    return project_interval(k, rows, forms, True, proposed, ends, weights, out, work)


def project_interval(
    k: int,
    rows: Floats,
    forms: Floats,
    uncertain: bool,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> bool:
    """Project one input, whose constraints are each met on an interval.

    Uncertain ones ask for a u + b >= sqrt(q_0 + 2 q_1 u + q_2 u^2) with the three numbers of
    `forms`. The interval of one that no input meets is empty, and begins at infinity.
    """
    low, high, v = ends[0], ends[1], proposed[0]
    first, last = low, high
    near, far = (low, high) if uncertain else (ENDLESS, -ENDLESS)
    for i in range(k):
        a = rows[i]
        start, end = -ENDLESS, ENDLESS
        if uncertain:
            start, end = uncertain_interval(i, k, rows, forms)
        elif a != 0.0:
            root = -rows[k + i] / a
            start, end = (root, ENDLESS) if a > 0.0 else (-ENDLESS, root)
            near, far = min(near, root), max(far, root)
        work[i] = start
        work[k + i] = end
        first = start if start > first else first
        last = end if end < last else last
    u = first if v < first else v
    # Two constraints that meet in one point may miss each other by the rounding of their roots.
    u = last if u > last else u
    u = low if u < low else high if u > high else u
    solvable = False
    for i in range(k):
        value, allowed = interval_residual(i, k, rows, forms, uncertain, u)
        solvable = solvable or (value < -allowed and (uncertain or rows[i] != 0.0))
    if solvable and (k > 1 or uncertain):
        # The least sum lies between roots, and bounds may be infinite.
        near, far = clip(near, 0, 1, ends), clip(far, 0, 1, ends)
        u = least_slack(k, rows, forms, uncertain, v, near, far, weights)
        # A move that is nothing but rounding is no intervention.
        for part in range(2):
            exact = clip(v if part == 1 else 0.0, 0, 1, ends)
            alike = abs(u - exact) <= ROUNDING * (far - near)
            for i in range(k):
                value, allowed = interval_residual(i, k, rows, forms, uncertain, exact)
                before, _ = interval_residual(i, k, rows, forms, uncertain, u)
                alike = alike and value >= min(before, 0.0) - allowed
            u = exact if alike else u
    out[0] = u
    feasible = True
    for i in range(k):
        value, allowed = interval_residual(i, k, rows, forms, uncertain, u)
        out[1 + i] = value
        # An end may be rounded by more than the margin that is nothing but rounding.
        at_end = uncertain and (u == work[i] or u == work[k + i])
        out[1 + k + i] = 1.0 if value <= allowed or at_end else 0.0
        feasible = feasible and value >= -allowed
    return feasible


def interval_residual(
    i: int, k: int, rows: Floats, forms: Floats, uncertain: bool, u: float
) -> tuple[float, float]:
    """Return the margin of a constraint on one input, and its tolerance."""
    term, b = rows[i] * u, rows[k + i]
    value, allowed = term + b, ROUNDING * abs(b) + ROUNDING * abs(term)
    if uncertain:
        linear, square = 2.0 * forms[3 * i + 1] * u, forms[3 * i + 2] * u * u
        form = forms[3 * i] + u * (2.0 * forms[3 * i + 1] + u * forms[3 * i + 2])
        root = sqrt(form if form > 0.0 else 0.0)
        value -= root
        form = form if form > 0.0 else 0.0
        rounding = ROUNDING * (abs(forms[3 * i]) + abs(linear) + square)
        allowed += sqrt(form + rounding) - root
    return value, allowed


def uncertain_interval(i: int, k: int, rows: Floats, forms: Floats) -> tuple[float, float]:
    """Return where an uncertain constraint is met: a concave function of the input is positive.

    The ends are roots of (a^2 - q_2) u^2 + 2 (a b - q_1) u + b^2 - q_0 with a u + b >= 0.
    """
    a, b = rows[i], rows[k + i]
    q0, q1, q2 = forms[3 * i], forms[3 * i + 1], forms[3 * i + 2]
    unit = max(abs(a), abs(b), sqrt(abs(q0)), sqrt(abs(q2)))
    unit = unit if unit > 0.0 else 1.0  # so that products of four neither overflow nor vanish
    a, b, q0, q1, q2 = a / unit, b / unit, q0 / unit / unit, q1 / unit / unit, q2 / unit / unit
    if q2 == 0.0:
        least = sqrt(q0 if q0 > 0.0 else 0.0) - b
        if a == 0.0:
            return (ENDLESS, ENDLESS) if least > 0.0 else (-ENDLESS, ENDLESS)
        return (least / a, ENDLESS) if a > 0.0 else (-ENDLESS, least / a)
    leading, middle, last = a * a - q2, a * b - q1, b * b - q0
    # (a b - q_1)^2 - leading last, without the products that cancel.
    discriminant = a * a * q0 - 2.0 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1)
    root = sqrt(discriminant if discriminant > 0.0 else 0.0)
    if leading == 0.0:
        if middle * a <= 0.0:
            return ENDLESS, ENDLESS
        end = -last / (2.0 * middle)
        return (end, ENDLESS) if a > 0.0 else (-ENDLESS, end)
    t = -(middle + (root if middle >= 0.0 else -root))
    one = t / leading if t != 0.0 else 0.0
    other = last / t if t != 0.0 else 0.0
    start, end = (one, other) if one < other else (other, one)
    if leading > 0.0:
        return (end, ENDLESS) if a > 0.0 else (-ENDLESS, start)
    if discriminant < 0.0 or b - a * middle / leading < 0.0:
        return ENDLESS, ENDLESS
    return start, end


def least_slack(
    k: int,
    rows: Floats,
    forms: Floats,
    uncertain: bool,
    v: float,
    low: float,
    high: float,
    weights: Floats,
) -> float:
    """Return the input nearest to v of those with the least sum of squared slacks.

    The sum is convex. Newton's method finds where its derivative vanishes, and bisection helps it.
    """
    size = 0.0
    for i in range(k):
        top = max(abs(rows[i]), abs(rows[k + i]))
        if uncertain:
            top = max(top, sqrt(abs(forms[3 * i])), sqrt(abs(forms[3 * i + 2])))
        size = max(size, sqrt(weights[1 + i]) * top)
    if slack_rate(k, rows, forms, uncertain, low, size, weights)[0] > 0.0:
        return low
    if slack_rate(k, rows, forms, uncertain, high, size, weights)[0] < 0.0:
        return high
    u = low if v < low else high if v > high else v
    for count in range(BISECTIONS):
        rate, curvature = slack_rate(k, rows, forms, uncertain, u, size, weights)
        if rate > 0.0:
            high = u
        elif rate < 0.0:
            low = u
        elif curvature > 0.0 or count == 0:
            return u
        elif u < v:
            low = u
        else:
            high = u
        middle, apart = low + 0.5 * (high - low), 4.0 * ROUNDING * abs(u)
        best = u - rate / curvature if curvature > 0.0 and count & 3 != 3 else middle
        if high - low <= 2.0 * apart:
            return low if best < low else high if best > high else best
        if abs(best - u) < apart:  # there may be a kink next to it
            best = u - apart if rate > 0.0 else u + apart
        best = best if low < best < high else middle
        if not low < best < high:
            return u
        u = best
    return u


def slack_rate(
    k: int,
    rows: Floats,
    forms: Floats,
    uncertain: bool,
    u: float,
    size: float,
    weights: Floats,
) -> tuple[float, float]:
    """Return half the derivatives of the sum of squared slacks, over the square of a size."""
    rate, curvature = 0.0, 0.0
    for i in range(k):
        unit = sqrt(weights[1 + i]) / size  # so that squares neither overflow nor vanish
        slope = rows[i] * unit
        value, bend = slope * u + rows[k + i] * unit, 0.0
        if uncertain:
            unit2 = unit * unit
            q1, q2 = forms[3 * i + 1] * unit2, forms[3 * i + 2] * unit2
            form = forms[3 * i] * unit2 + u * (2.0 * q1 + u * q2)
            root = sqrt(form if form > 0.0 else 0.0)
            value -= root
            if root > 0.0:
                change = (q1 + q2 * u) / root
                slope -= change
                bend = (q2 - change * change) / root
        if value < 0.0:
            rate += value * slope
            curvature += slope * slope - value * bend
    return rate, curvature


def project_row(
    i: int,
    k: int,
    m: int,
    rows: Floats,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> None:
    """Write the nearest input to `out` that meets constraint i, or violates it least.

    The minimiser is u(l) = clip(v + l a / w) for the smallest multiplier l >= 0 at which
    phi(l) = a . u(l) + b is 0. phi is piecewise linear and does not fall, with a kink wherever an
    input enters or leaves its interval. An input whose proposal is beyond its near bound is
    measured from there once it enters, so that a proposal of 1e16 does not drown it.
    """
    at, b = i * m, rows[k * m + i]
    value, slope, size = b, 0.0, 0.0
    for j in range(m):
        a = rows[at + j]
        work[j] = a / weights[j]
        value += a * proposed[j]
        slope += a * work[j]
    if SMALL_SQUARE < slope < LARGE_SQUARE:
        inside, step = True, value / slope
        for j in range(m):
            low, high, v = ends[j], ends[m + j], proposed[j]
            x, reach = v - step * work[j], FAR_OFF * (high - low)
            out[j] = x
            if not (low <= x <= high and low - reach <= v <= high + reach):
                inside = False
        if inside:
            value, allowed = residual(i, k, m, rows, out)
            if -allowed <= value <= allowed:
                return
    for j in range(m):
        size = max(size, abs(rows[at + j]))
    size = size if size > 0.0 else 1.0  # so that products neither overflow nor vanish
    row, direction, start, far, enter = 0, m, 2 * m, 3 * m, 4 * m
    leave = 5 * m
    for j in range(m):
        low, high, v = ends[j], ends[m + j], proposed[j]
        work[row + j] = rows[at + j] / size
        d = work[row + j] / weights[j]
        work[direction + j] = d
        work[start + j] = low if v < low else high if v > high else v
        work[far + j] = high if d > 0.0 else low if d < 0.0 else work[start + j]
        work[enter + j] = work[leave + j] = 0.0
        if d != 0.0:
            near = ((low if d > 0.0 else high) - v) / d
            end = (work[far + j] - v) / d
            work[enter + j] = near if near > 0.0 else 0.0
            work[leave + j] = end if end > 0.0 else 0.0
    # The last kink at which the constraint is violated; the first candidate is the start.
    kink = 0.0
    for c in range(enter, enter + 2 * m):
        if work[c] > kink and follow_row(m, work[c], b / size, out, work) < 0.0:
            kink = work[c]
    value, slope = follow_row(m, kink, b / size, out, work), 0.0
    for j in range(m):
        # An input so far off that it enters and leaves at one multiplier, by rounding, is free.
        end = work[leave + j]
        free = work[start + j] != work[far + j] and (
            work[enter + j] <= kink < end or work[enter + j] == kink == end
        )
        work[direction + j] = work[direction + j] if free else 0.0
        slope += work[row + j] * work[direction + j]
    if not slope > 0.0:
        for j in range(m):
            out[j] = work[far + j]
        return
    step = value / slope if value < 0.0 else 0.0
    for _ in range(CORRECTIONS):  # divide among the free inputs what rounding leaves
        for j in range(m):
            if work[direction + j] != 0.0:
                x = out[j] - step * work[direction + j]
                out[j] = ends[j] if x < ends[j] else ends[m + j] if x > ends[m + j] else x
        value, allowed = residual(i, k, m, rows, out)
        if -allowed <= value <= allowed:
            return
        step = value / size / slope


def follow_row(m: int, multiplier: float, b: float, out: Floats, work: Floats) -> float:
    """Write the input at a multiplier, and return the value of the constraint there."""
    total = b
    for j in range(m):
        passed = multiplier - work[4 * m + j]
        x = work[2 * m + j]
        if passed > 0.0:
            far = multiplier >= work[5 * m + j]
            x = work[3 * m + j] if far else x + passed * work[m + j]
        out[j] = x
        total += work[j] * x
    return total


def project_rows(
    k: int,
    m: int,
    rows: Floats,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> bool:
    """Project several inputs onto several constraints, of which the clipped proposal misses some.

    `out` holds the clipped proposal and its margins.
    """
    missed, hopeless = 6 * m, 0  # the first entries are those of `project_row`
    for i in range(k):
        work[missed + i] = 0.0
        if not out[m + i] >= 0.0:
            # One that says nothing of the input cannot be met, and has no part in what follows.
            if is_silent(i, k, m, rows, ends):
                hopeless += 1
            else:
                work[missed + i] = 1.0
    corner = solved = hopeless == k
    for i in range(k):
        if work[missed + i] > 0.0 and not corner:
            solved = False
            project_row(i, k, m, rows, proposed, ends, weights, out, work)
            if count_unmet(k, m, rows, out) == hopeless:
                out[m + k + i] = 1.0  # whatever the rounding of its margin
                return hopeless == 0
            value, allowed = residual(i, k, m, rows, out)
            corner = value < -allowed  # even alone it cannot be met
    if not corner:
        for j in range(m):
            out[j] = clip(proposed[j], j, m, ends)
    if not solved:
        reduce_slacks(k, m, rows, ends, weights, corner, out, work)
        approach(k, m, rows, proposed, ends, weights, out, work)
    return count_unmet(k, m, rows, out) == 0


def is_silent(i: int, k: int, m: int, rows: Floats, ends: Floats) -> bool:
    """Return whether no input within its bounds changes a constraint by more than rounding may."""
    reach = 0.0
    for j in range(m):
        a = abs(rows[i * m + j])
        reach += a * (ends[m + j] - ends[j]) if a > 0.0 else 0.0
    return reach <= SURELY * ROUNDING * abs(rows[k * m + i])


def reduce_slacks(
    k: int,
    m: int,
    rows: Floats,
    ends: Floats,
    weights: Floats,
    corner: bool,
    out: Floats,
    work: Floats,
) -> None:
    """Move the input to where the sum of weighted squared slacks is least, inside its bounds.

    In a `corner`, its bounds hold the input from the start. The last m entries of `work` receive
    which bounds hold it wherever the sum is least, -1 for a lower and 1 for an upper one.

    Each step is the least-squares step of the violated constraints over the free inputs. It ends
    where an input meets its bound, which holds it from then on, or where another constraint is on
    the point of being violated, which takes part from then on.
    """
    scaled, offset = 0, k * m
    margin, violated = offset + k, offset + 2 * k
    fixed, step = offset + 3 * k, offset + 3 * k + m
    barred, last = step + m, step + 2 * m + k
    reach, fit = last + m, last + m + k
    size = 0.0
    for i in range(k):
        for j in range(m):
            size = max(size, sqrt(weights[m + i]) * abs(rows[i * m + j]))
    size = size if size > 0.0 else 1.0
    for i in range(k):
        unit, top = sqrt(weights[m + i]) / size, 0.0
        for j in range(m):
            top = max(top, abs(rows[i * m + j]))
        if is_silent(i, k, m, rows, ends):
            unit = top = 0.0
        elif unit * top < FAINT:
            unit = FAINT / top
        for j in range(m):
            work[scaled + i * m + j] = unit * rows[i * m + j]  # squares neither overflow nor vanish
        work[offset + i] = unit * rows[k * m + i] if top > 0.0 else 0.0
    slack_margins(k, m, work, out)
    for i in range(k):
        work[violated + i] = 1.0 if work[margin + i] < 0.0 else 0.0
    for j in range(m):
        at_end = out[j] == ends[j] or out[j] == ends[m + j]
        work[fixed + j] = 1.0 if corner and at_end else 0.0
    for c in range(k + m):
        work[barred + c] = 0.0
    freed, done = -1, False
    for _ in range(STEPS * (k + m)):
        fit_step(k, m, work, margin, violated, fixed, step, fit)
        if done:
            break
        length = 1.0
        for j in range(m):
            d = work[step + j]
            if d != 0.0:
                part = ((ends[m + j] if d > 0.0 else ends[j]) - out[j]) / d
                length = part if part < length else length
        for i in range(k):
            work[reach + i] = 2.0
            if work[violated + i] == 0.0:
                change = 0.0
                for j in range(m):
                    change += work[scaled + i * m + j] * work[step + j]
                if change < 0.0:
                    spare = work[margin + i]
                    part = (spare if spare > 0.0 else 0.0) / -change
                    work[reach + i] = part
                    length = part if part < length else length
        for j in range(m):
            d = work[step + j]
            if d != 0.0:
                end = ends[m + j] if d > 0.0 else ends[j]
                x = out[j] + length * d
                if (end - out[j]) / d <= length:
                    x = end
                    if length < 1.0:
                        work[fixed + j] = 1.0
                out[j] = clip(x, j, m, ends)
        if slack_margins(k, m, work, out) == 0.0:
            break  # all constraints can be met
        if length < 1.0:
            for i in range(k):
                if work[reach + i] <= length:
                    work[violated + i] = 1.0
            if length > 0.0:
                for c in range(k + m):
                    work[barred + c] = 0.0
            elif freed >= 0 and work[(violated if freed < k else fixed - k) + freed] > 0.0:
                work[barred + freed] = 1.0  # let go and stopped at once: once is enough
            freed = -1
        else:
            freed = release(k, m, ends, out, work)
            done = freed < 0
    # The margins are those of many steps; a last one takes back their rounding, or leads astray.
    least = slack_margins(k, m, work, out)
    if least > 0.0:
        for j in range(m):
            work[last + j] = out[j]
            out[j] = clip(out[j] + work[step + j], j, m, ends)
        before, least = least, slack_margins(k, m, work, out)
        if not least < before:
            for j in range(m):
                out[j] = work[last + j]
            least = slack_margins(k, m, work, out)
    # The slacks are the same wherever their sum is least, and so are their forces on the bounds.
    certain, hard = least > 0.0, scratch_size(k, m) - m
    for i in range(k):
        if certain:
            value, allowed = residual(i, k, m, rows, out)
            certain = abs(value) > SURELY * allowed
    for j in range(m):
        push, terms = 0.0, 0.0
        for i in range(k):
            if certain and work[margin + i] < 0.0:
                force = -work[margin + i] * work[scaled + i * m + j]
                push += force
                terms += abs(force)
        side = 0.0
        if abs(push) > 2.0 / SURELY * terms:
            side = 1.0 if push > 0.0 else -1.0
            side = side if out[j] == (ends[m + j] if push > 0.0 else ends[j]) else 0.0
        work[hard + j] = side


def slack_margins(k: int, m: int, work: Floats, u: Floats) -> float:
    """Write the weighted margins of `reduce_slacks`; return the sum of squared slacks."""
    squares = 0.0
    for i in range(k):
        total = 0.0
        for j in range(m):
            total += work[i * m + j] * u[j]
        total += work[k * m + i]
        work[k * m + k + i] = total
        if total < 0.0:
            squares += total * total
    return squares


def release(k: int, m: int, ends: Floats, u: Floats, work: Floats) -> int:
    """Let go of the constraint that is met by most, or else of the input that is pushed inwards.

    Returns:
        The constraint, or k plus the input, or -1.
    """
    margin, violated = k * m + k, k * m + 2 * k
    fixed, barred = violated + k, violated + k + 2 * m
    largest, strongest, freed = 0.0, 0.0, -1
    for i in range(k):
        if work[violated + i] > 0.0:
            pull = 0.0
            for j in range(m):
                pull = max(pull, abs(work[i * m + j]))
            pull *= work[margin + i]
            largest = max(largest, abs(pull))
            if work[barred + i] == 0.0 and pull > strongest:
                freed, strongest = i, pull
    if strongest > NO_FORCE * largest:
        work[violated + freed] = 0.0
        return freed
    freed, strongest = -1, 0.0
    for j in range(m):
        if work[fixed + j] > 0.0 and work[barred + k + j] == 0.0:
            push, terms = 0.0, 0.0
            for i in range(k):
                if work[violated + i] > 0.0:
                    force = work[margin + i] * work[i * m + j]
                    push -= force
                    terms += abs(force)
            if u[j] >= ends[m + j]:
                push = -push
            if push > NO_FORCE * terms and push > strongest:
                freed, strongest = k + j, push
    if freed >= 0:
        work[fixed + freed - k] = 0.0
    return freed


def fit_step(
    k: int, m: int, work: Floats, margin: int, violated: int, fixed: int, step: int, at: int
) -> None:
    """Write the shortest step of the free inputs with the least squares of the violated margins.

    In an orthonormal basis of the constraints the problem has full rank.
    """
    space, triangle = at, at + m * m
    columns, basis = triangle + m * (k + m), triangle + m * (2 * k + m)
    order, shares = basis + k * m, basis + k * m + m
    ones, target = shares + m, shares + 2 * m
    rest, nothing = target + k, target + 2 * k
    count, taken = row_space(k, m, work, 0, violated, fixed, space, triangle, order), 0
    for i in range(k):
        taken += 1 if work[violated + i] > 0.0 else 0
    if taken == count:  # all margins can be 0
        for c in range(count):
            work[shares + c] = -work[margin + int(work[order + c])]
        least_step(count, m, work, space, triangle, shares, step)
        return
    for i in range(k):
        work[target + i] = -work[margin + i] if work[violated + i] > 0.0 else 0.0
        work[nothing + i] = 0.0
        for c in range(count):
            total = 0.0
            if work[violated + i] > 0.0:
                for j in range(m):
                    total += work[i * m + j] * work[space + c * m + j]
            work[columns + c * k + i] = total
    for c in range(count):
        work[ones + c] = 1.0
    count = row_space(count, k, work, columns, ones, nothing, basis, triangle, order)
    split(count, k, work, target, nothing, basis, triangle, shares, rest)
    for j in range(m):
        total = 0.0
        for c in range(count):
            total += work[shares + c] * work[space + int(work[order + c]) * m + j]
        work[step + j] = total


def least_step(
    size: int, n: int, work: Floats, basis: int, triangle: int, values: int, step: int
) -> None:
    """Write the shortest step whose products with the vectors of `row_space` are given values.

    The values, in the order of the basis, are overwritten.
    """
    for j in range(n):
        work[step + j] = 0.0
    for c in range(size):
        value = work[values + c]
        for before in range(c):
            value -= work[triangle + before * n + c] * work[values + before]
        value /= work[triangle + c * n + c]
        work[values + c] = value
        for j in range(n):
            work[step + j] += value * work[basis + c * n + j]


def row_space(
    count: int,
    n: int,
    work: Floats,
    vectors: int,
    taken: int,
    fixed: int,
    basis: int,
    triangle: int,
    order: int,
) -> int:
    """Orthonormalise the free entries of those of `count` vectors of n entries that are taken.

    Each is the sum of `triangle` times `basis`, up to its own place; `order` receives the numbers
    of those in the basis. One that depends on those before it, up to rounding, is left out.

    Returns:
        How many are in the basis.
    """
    size = 0
    for i in range(count):
        if work[taken + i] > 0.0:
            whole, new = 0.0, basis + size * n
            for j in range(n):
                x = work[vectors + i * n + j] if work[fixed + j] == 0.0 else 0.0
                work[new + j] = x
                whole += x * x
            for c in range(size):
                work[triangle + c * n + size] = 0.0
            for _ in range(2 if size > 0 else 0):  # the second time takes back rounding
                for c in range(size):
                    share = 0.0
                    for j in range(n):
                        share += work[basis + c * n + j] * work[new + j]
                    work[triangle + c * n + size] += share
                    for j in range(n):
                        work[new + j] -= share * work[basis + c * n + j]
            left = 0.0
            for j in range(n):
                left += work[new + j] * work[new + j]
            if left > DEPENDENT * DEPENDENT * whole:
                length = sqrt(left)
                for j in range(n):
                    work[new + j] /= length
                work[triangle + size * n + size] = length
                work[order + size] = float(i)
                size += 1
                if size == n:
                    break
    return size


def split(
    size: int,
    n: int,
    work: Floats,
    vector: int,
    fixed: int,
    basis: int,
    triangle: int,
    shares: int,
    rest: int,
) -> None:
    """Write the free entries of a vector as a sum of vectors and a rest that is normal to them.

    `shares` receives the coefficients of the vectors in the basis of `row_space`, in its order.
    """
    for j in range(n):
        work[rest + j] = work[vector + j] if work[fixed + j] == 0.0 else 0.0
    for c in range(size):
        work[shares + c] = 0.0
    for _ in range(2):
        for c in range(size):
            share = 0.0
            for j in range(n):
                share += work[basis + c * n + j] * work[rest + j]
            work[shares + c] += share
            for j in range(n):
                work[rest + j] -= share * work[basis + c * n + j]
    for back in range(size):
        c = size - 1 - back
        for d in range(c + 1, size):
            work[shares + c] -= work[triangle + c * n + d] * work[shares + d]
        work[shares + c] /= work[triangle + c * n + c]


def approach(
    k: int,
    m: int,
    rows: Floats,
    proposed: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    work: Floats,
) -> None:
    """Go from the least-violating input to the nearest to the proposal with no larger slack.

    Where no step leads nearer, the rest of the distance is a sum of the normals of what holds the
    input back. What has the wrong sign in it is let go. Distances are those of sqrt(w) u, in which
    constraints have unit length.
    """
    normal, length = 0, k * m
    spare, binding = length + k, length + 2 * k
    offset, least = length + 3 * k, length + 4 * k
    root = length + 5 * k
    fixed, start = root + m, root + 2 * m
    step, distance = root + 3 * m, root + 4 * m
    rest, move = root + 5 * m, root + 6 * m
    shares, order = root + 7 * m, root + 8 * m
    basis, triangle = root + 9 * m, root + 9 * m + m * m
    for j in range(m):
        work[root + j] = sqrt(weights[j])
        work[start + j] = out[j]
        work[fixed + j] = 2.0 * work[scratch_size(k, m) - m + j]  # for good
        work[step + j] = 0.0
        work[move + j] = 0.0  # marks inputs on which a constraint depends
    whole, violated = 0.0, False
    for i in range(k):
        size, square, silent = 0.0, 0.0, is_silent(i, k, m, rows, ends)
        for j in range(m):
            x = 0.0 if silent else rows[i * m + j] / work[root + j]
            work[normal + i * m + j] = x
            size = max(size, abs(x))
            if x != 0.0:
                work[move + j] = 1.0
        if size > 0.0:
            for j in range(m):
                work[normal + i * m + j] /= size  # squares neither overflow nor vanish
                square += work[normal + i * m + j] * work[normal + i * m + j]
            for j in range(m):
                work[normal + i * m + j] /= sqrt(square)
        work[length + i] = size * sqrt(square)
        value, allowed = residual(i, k, m, rows, out)
        slack = -value if value < -allowed else 0.0
        work[offset + i] = rows[k * m + i] + slack
        work[least + i] = -slack
        violated = violated or slack > 0.0
        work[spare + i] = (value if value > 0.0 else 0.0) / work[length + i] if size > 0.0 else 0.0
        work[binding + i] = 1.0 if size > 0.0 and value <= allowed else 0.0
    for j in range(m):
        toward = (proposed[j] - out[j]) * work[root + j] if work[move + j] > 0.0 else 0.0
        work[distance + j] = toward
        whole = max(whole, abs(toward))
    for _ in range(STEPS * (k + m)):
        count = row_space(k, m, work, normal, binding, fixed, basis, triangle, order)
        left, size, part, stop = 0.0, 0.0, 1.0, -1
        for j in range(m):
            work[rest + j] = work[distance + j] - work[step + j]
        split(count, m, work, rest, fixed, basis, triangle, shares, move)
        for j in range(m):
            if work[fixed + j] == 0.0:
                left = max(left, abs(work[rest + j]))
                size = max(size, abs(work[move + j]))
        if size > NO_DISTANCE * left:
            for j in range(m):
                d = work[move + j]
                if d != 0.0:
                    end = ((ends[m + j] if d > 0.0 else ends[j]) - work[start + j]) * work[root + j]
                    to_end = (end - work[step + j]) / d
                    if to_end < part:
                        part, stop = to_end, k + j
            for i in range(k):
                if work[binding + i] == 0.0:
                    change, value = 0.0, work[spare + i]
                    for j in range(m):
                        change += work[normal + i * m + j] * work[move + j]
                        value += work[normal + i * m + j] * work[step + j]
                    if change < -NO_DISTANCE * size:
                        to_row = (value if value > 0.0 else 0.0) / -change
                        if to_row < part:
                            part, stop = to_row, i
            for j in range(m):
                low = (ends[j] - work[start + j]) * work[root + j]
                high = (ends[m + j] - work[start + j]) * work[root + j]
                x = work[step + j] + part * work[move + j]
                if stop == k + j:
                    work[fixed + j] = 1.0 if work[move + j] > 0.0 else -1.0
                    x = high if work[move + j] > 0.0 else low
                work[step + j] = low if x < low else high if x > high else x
            if stop >= 0:
                if stop < k:
                    work[binding + stop] = 1.0
                continue
        freed, strongest = -1, NO_DISTANCE * whole
        for c in range(count):
            if work[shares + c] > strongest:
                freed, strongest = int(work[order + c]), work[shares + c]
        for j in range(m):
            if abs(work[fixed + j]) == 1.0:
                push = work[rest + j]
                for c in range(count):
                    push -= work[shares + c] * work[normal + int(work[order + c]) * m + j]
                push *= -work[fixed + j]
                if push > strongest:
                    freed, strongest = k + j, push
        if freed < 0:
            break
        work[(binding if freed < k else fixed - k) + freed] = 0.0
    moved = False
    for j in range(m):
        moved = moved or work[step + j] != 0.0
        side = work[fixed + j]
        x = work[start + j] + work[step + j] / work[root + j]
        out[j] = ends[j] if side < 0.0 else ends[m + j] if side > 0.0 else x
    # Where the input does not move, nearly parallel constraints would only add rounding.
    while moved:
        count = row_space(k, m, work, normal, binding, fixed, basis, triangle, order)
        for _ in range(2):  # the second time takes back rounding
            for c in range(count):
                i = int(work[order + c])
                value = 0.0
                for j in range(m):
                    value += rows[i * m + j] * out[j]
                work[shares + c] = (value + work[offset + i]) / work[length + i]
            least_step(count, m, work, basis, triangle, shares, rest)
            for j in range(m):
                out[j] -= work[rest + j] / work[root + j]
        moved = False
        for j in range(m):
            x = clip(out[j], j, m, ends)
            if x != out[j] and work[fixed + j] == 0.0:  # then this bound holds it, too
                work[fixed + j] = 1.0
                moved = True
            out[j] = x
    whole, worse = 0.0, False
    for j in range(m):
        whole = max(whole, abs(out[j] - proposed[j]) * work[root + j])
    for j in range(m):
        # A constraint of an input alone may ask for 0, which rounding of the way hides. From the
        # least-violating input that is no longer than the bounds are apart.
        if abs(out[j]) <= ROUNDING * min(whole / work[root + j], ends[m + j] - ends[j]):
            out[j] = clip(0.0, j, m, ends)
    # Where constraints or inputs differ by many orders of magnitude, rounding may lead astray: then
    # the least-violating input is safer.
    for i in range(k):
        value, allowed = residual(i, k, m, rows, out)
        worse = worse or not value + (SURELY if violated else 1.0) * allowed >= work[least + i]
    if worse:
        for j in range(m):
            out[j] = work[start + j]
