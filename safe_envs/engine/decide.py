"""What a filter decides on a proposed input: one text, interpreted on lists or in machine code.

A filter has k constraints a_i(x) u + b_i(x) >= 0 on m inputs, which conditions state as formulas:

- a reciprocal one asks for a_i u + b_i >= demand_i(x) in its domain. Outside it has no meaning, and
  the input goes where h rises most, as far as the other constraints allow;
- an uncertain one asks for a_i u + b_i >= sqrt([1, u]' Q_i(x) [1, u]): one input is met on an
  interval, several have a plane above the root, which is exact at the corners of the bounds;
- a sampled one has a margin for what it changes while the input is held;
- a partial one is of a barrier that may have no value at a state. There it is violated by infinity,
  and the input does not regard it;
- one of a maximum is that of the function whose constraint is nearest to the proposed input.

With a goal the filter solves min w_u |u|^2 + w_d d^2 subject to growth(x) + along(x) u <= d, the
constraints and the bounds, whatever is proposed. d is an input of its own, d = unit e, with the
weight of the others. Its bounds are 0 and twice the most that it may have to be, so that the goal's
constraint can always be met, also after rounding.

**Margins of held inputs.** A constraint a u + b >= 0 changes at a rate that is quadratic in the
held input. To first order its value at the end of the period dt is

    q(u) = a u + b + dt (c_0 + c u + u' C u),

so that it holds all along the period where a u + b >= 0 and q(u) >= 0: two constraints, of which
one is quadratic. Where the input that the constraints allow at its beginning violates one of them,
each round takes one step of Newton's method: they are linearised there, and the QP proposes another
input. On the line through both inputs all constraints are known in closed form, and the step ends
at the nearest input at which all of them hold. Where there is none on the line, it ends where their
squared violations are least among their roots and vertices and what the QP proposed; where that
helps little, lines along each input are tried. So for one input one step finds the nearest one,
whatever the curvatures; several inputs end at one that has been checked, which need not be the
nearest.

**Numbers.** `shape` describes the filter, see `shape_of`. `values` holds a (k m, row by row) and b
(k); with a goal, growth and along (1 + m); then for each constraint, as far as it has them, the
expressions that are positive in its domain and its demand; what has a value where its barrier has;
the upper triangle of Q, row by row; a, b and the level of each function of a maximum; and the
coefficients of 1, u_j and u_j u_n, j <= n, of its rate of change. `weights` holds those of the
inputs, and of the slack of the goal, then the priorities likewise. `ends` holds the lower and the
upper bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, sqrt

from safe_envs.engine.plain_natives import floats_at
from safe_envs.engine.qp import (
    ROUNDING,
    Floats,
    project,
    project_uncertain,
    residual,
    scratch_size,
)

PLAIN = 0
"""Kind of a QP whose constraints are those of the conditions as they are."""
CHANGED = 1
"""Kind of any other one."""
UNCERTAIN = 2
"""Kind of a QP with uncertain constraints on one input, which are solved as they are."""
UNDEFINED = -1
"""Result of `decide` where the constraints have no finite value."""
UNDEFINED_GOAL = -2
"""Result of `decide` where the goal has no finite value."""
FAR_AWAY = 1e4
"""How many times further than the bounds reach is far away."""
ROUNDS = 12
"""Of Newton's method; it stops where all constraints hold, or where a round does not help."""
INWARDS = 1e-8
"""Share of its terms without input by which a constraint at the end of the period has to exceed 0.
A filter that rides the edge would else be carried beyond it by the errors of integrators."""
FAR = 1e37
"""No point of a line is further away; it is a number in single precision as well."""
BETTER = 0.999999999
"""Share of the squared violations that is left by a step that helps, beyond rounding."""
ENOUGH = 0.9
"""Share of the squared violations that is left by a round after which another one is tried."""
SLOW = 0.25
"""Share of them that is left by a step after which lines along each input are tried."""
POINTS = 5
"""Where on a line a constraint changes; see `point_of_change`."""
ON_LINE = 7
"""Coefficients on a line: of 1, t, t^2, the size of the terms, and of 1, t, t^2 of uncertainty."""

# Places in `shape`.
K = 0
M = 1
GOAL = 2
KIND = 3
PERIOD = 4
UNIT = 5
OWNED = 6
SAMPLED = 7
COUNTS = 8
# Places after `COUNTS`, in units of k numbers.
DOMAIN = 0
IS_SAMPLED = 1
IS_UNCERTAIN = 2
IS_PARTIAL = 3
FUNCTIONS = 4
OWNER = 5

Scratch = Sequence[Floats]
"""Arrays of the lengths that `scratch_lengths` tells."""


def shape_of(
    sizes: Sequence[int], kind: int, period: float, unit: float, parts: Sequence[Sequence[int]]
) -> list[float]:
    """Return the numbers that describe a filter.

    Args:
        sizes: k, m, and 1 for a goal, else 0.
        kind: `PLAIN`, `CHANGED` or `UNCERTAIN`.
        period: control period in s.
        unit: of the goal's slack.
        parts: for each constraint, the number of expressions that are positive in its domain (0
            unless it is reciprocal), whether it is sampled, uncertain and partial, the number of
            functions (0 unless it is of a maximum), and the barrier that it is of, not falling.
    """
    k = sizes[0]
    columns = [float(entry) for column in zip(*parts, strict=True) for entry in column]
    owned = 1 + max((part[OWNER] for part in parts), default=-1)
    sampled = sum(part[IS_SAMPLED] for part in parts)
    head = [*sizes, kind, period, unit, 0 if owned == k else owned, sampled]
    return [*map(float, head), *columns]


def scratch_lengths(shape: Sequence[float]) -> tuple[int, ...]:
    """Return the lengths of the scratch arrays of `decide`, as it names them."""
    k, m, goal, sampled = (int(shape[i]) for i in (K, M, GOAL, SAMPLED))
    n, count, width = k + goal, k + sampled, 1 + m + (m * (m + 1) >> 1)
    search, size = sampled > 0, scratch_size(max(n, count), m + goal)
    if any(shape[COUNTS + IS_UNCERTAIN * k : COUNTS + IS_PARTIAL * k]):
        size = max(size, 1 << m)  # the corners of the bounds
    return (
        m,  # wanted
        k * m + k,  # own
        m + 1 + k,  # target
        3 * k,  # flags
        3 * k + 3 * sampled + 1,  # forms
        2 * m + 2,  # wide
        n * (m + goal) + n,  # rows
        m + 1 + 2 * n,  # result
        size,  # work
        count * width if search else 0,  # held
        count * m + count if search else 0,  # tangent
        m + count if search else 0,  # priorities
        2 * count if search else 0,  # state
        ON_LINE * count if search else 0,  # line
        m + 2 * count if search else 0,  # answer
    )


def answer_length(k: int, m: int, goal: int) -> int:
    """Return the length of `out`: inputs, margins, active constraints, slacks, the goal's input."""
    return m + 3 * k + goal * m


def decide(
    shape: Floats,
    weights: Floats,
    values: Floats,
    u: Floats,
    ends: Floats,
    out: Floats,
    scratch: Scratch,
) -> int:
    """Decide on the input u that is proposed.

    Args:
        shape: see `shape_of`.
        weights: see above.
        values: see above.
        u: proposed input (m).
        ends: bounds of the inputs (2 m).
        out: receives the input (m), and margin, 1 if active, else 0, and slack of each constraint
            (3 k); with a goal also the input that is best without constraints (m). Where barriers
            have several constraints, the first entries are those of barriers.
        scratch: see `scratch_lengths`.

    Returns:
        Twice the barrier of the active constraint that is furthest from the proposed input,
        counted from 1, or 0 where none is active, plus 1 where the constraints can be met; or
        `UNDEFINED`, `UNDEFINED_GOAL`.
    """
    k, m, goal = int(shape[K]), int(shape[M]), int(shape[GOAL])
    wanted, own, target, flags, forms, wide, rows, result, work = scratch[:9]
    if k == 1 and shape[KIND] == PLAIN:
        return conclude_single(m, u, project(1, m, values, u, ends, weights, out, work), out)
    total = 0.0
    for j in range(m):
        total += 0.0 * u[j]  # which does not overflow
    if not isfinite(total):
        return UNDEFINED
    if shape[KIND] == PLAIN:
        feasible = project(k, m, values, u, ends, weights, out, work)
    else:
        for j in range(m):
            wanted[j] = u[j]
        if goal > 0:
            total = 0.0
            for j in range(m + 1):
                total += values[k * m + k + j]
            if not isfinite(total):
                return UNDEFINED_GOAL
            pursue(
                k, m, values, shape[UNIT], ends, weights, wanted, target, wide, rows, result, work
            )
            for j in range(m):
                out[m + 3 * k + j] = wanted[j]
        finite = read_constraints(shape, weights, values, ends, wanted, own, target, flags, forms)
        if not (finite and write_rows(shape, values, ends, weights, scratch)):
            return UNDEFINED
        feasible = minimise(shape, ends, weights, out, target, forms, wide, rows, result, work)
        if shape[SAMPLED] > 0.0:
            feasible = hold(shape, values, ends, weights, out, scratch)
        feasible = leave_domains(k, m, own, out, flags) and feasible
    total = 0.0
    for c in range(m + k):
        total += out[c]
    if not isfinite(total):
        return UNDEFINED
    if shape[KIND] == PLAIN:
        cause = furthest(k, m, values, values, k * m, u, weights, out)
    else:
        for i in range(k):
            if flags[k + i] == 0.0:
                out[m + i], out[m + k + i] = -inf, 1.0
                feasible = False
        cause = furthest(k, m, own, target, m + 1, wanted, weights, out)
        for i in range(k - 1, -1, -1):  # outside its domain one is further than any
            if flags[i] == 0.0 and largest(i, m, own) > 0.0:
                cause = i
    for i in range(k):
        margin = out[m + i]
        out[m + 2 * k + i] = -margin if margin < 0.0 and not feasible else 0.0
    if shape[OWNED] > 0.0:
        cause = gather_barriers(k, m, shape, cause, out)
    return 2 * cause + 3 if feasible else 2 * cause + 2


def conclude_single(m: int, u: Floats, feasible: bool, out: Floats) -> int:
    """Write the slack of a filter of one plain constraint; return what `decide` does.

    Args:
        m: number of inputs.
        u: proposed input (m).
        feasible: whether the constraint can be met.
        out: input, margin and whether the constraint is active (m + 2); receives the slack (1).
    """
    margin = out[m]
    out[m + 2] = 0.0 if feasible else -margin
    total = margin
    for j in range(m):
        total += 0.0 * u[j]
    if not isfinite(total):
        return UNDEFINED
    if out[m + 1] == 0.0:
        return 1
    return 3 if feasible else 2


def pursue(
    k: int,
    m: int,
    values: Floats,
    unit: float,
    ends: Floats,
    weights: Floats,
    wanted: Floats,
    target: Floats,
    wide: Floats,
    rows: Floats,
    result: Floats,
    work: Floats,
) -> None:
    """Write the input that is best for the goal without constraints, and the bounds with d."""
    growth = k * m + k
    most = values[growth]
    for j in range(m):
        along, low, high = values[growth + 1 + j], ends[j], ends[m + j]
        most += max(along * low, along * high)
        wide[j] = low
        wide[m + 1 + j] = high
        rows[j] = -along
        target[j] = 0.0
    wide[m] = target[m] = 0.0
    wide[2 * m + 1] = 2.0 * most / unit if most > 0.0 else 1.0
    rows[m] = unit
    rows[m + 1] = -values[growth]
    project(1, m + 1, rows, target, wide, weights, result, work)
    for j in range(m):
        wanted[j] = result[j]


def read_constraints(
    shape: Floats,
    weights: Floats,
    values: Floats,
    ends: Floats,
    wanted: Floats,
    own: Floats,
    target: Floats,
    flags: Floats,
    forms: Floats,
) -> bool:
    """Take the values of constraints apart; return whether all their numbers are finite.

    A constraint whose barrier has no value is 0, which every input meets. `flags` receives 1 for
    constraints inside their domain, for those that have a value, and where the values of each have
    coefficients of its rate of change (3 k); `target` what is asked for in place of b.
    """
    k, m, goal = int(shape[K]), int(shape[M]), int(shape[GOAL])
    place, entries, total = k * m + k + goal * (m + 1), (m + 1) * (m + 2) >> 1, 0.0
    for i in range(k):
        levels, part = int(shape[COUNTS + DOMAIN * k + i]), COUNTS + i
        inside, known, demand, b = 1.0, 1.0, 0.0, values[k * m + i]
        for c in range(levels):
            inside = inside if values[place + c] > 0.0 else 0.0
        if levels > 0:
            demand = values[place + levels]
            place += levels + 1
        if shape[part + IS_PARTIAL * k] > 0.0:
            height = values[place] + b
            for j in range(m):
                height += values[i * m + j]
            # At the end of where it has a value, its derivatives may have none.
            known = 1.0 if isfinite(height) else 0.0
            place += 1
        if shape[part + IS_UNCERTAIN * k] > 0.0:
            for c in range(entries):
                total += values[place + c] if known > 0.0 else 0.0
            for c in range(3 if shape[KIND] == UNCERTAIN else 0):
                forms[3 * i + c] = values[place + c] if known > 0.0 else 0.0
            place += entries
        elif shape[KIND] == UNCERTAIN:
            forms[3 * i] = forms[3 * i + 1] = forms[3 * i + 2] = 0.0
        functions, chosen = int(shape[part + FUNCTIONS * k]), i * m
        if functions > 0:
            height = 0.0
            for c in range(functions * (m + 2)):
                height += values[place + c]
            if shape[part + IS_PARTIAL * k] > 0.0 and not isfinite(height):
                known = 0.0
            total += height if known > 0.0 else 0.0
            chosen = place
            if known > 0.0:
                chosen += (m + 2) * nearest(functions, m, values, place, wanted, ends, weights)
            b = values[chosen + m]
            place += functions * (m + 2)
        inside = inside if known > 0.0 else 1.0
        for j in range(m):
            own[i * m + j] = values[chosen + j] if known > 0.0 else 0.0
            total += own[i * m + j]
        own[k * m + i] = b if known > 0.0 else 0.0
        total += own[k * m + i]
        if known > 0.0 and inside > 0.0:
            target[m + 1 + i] = b - demand
        else:
            target[m + 1 + i] = 0.0
        flags[i], flags[k + i], flags[2 * k + i] = inside, known, float(place)
        if shape[part + IS_SAMPLED * k] > 0.0:
            place += 1 + m + (m * (m + 1) >> 1)
    return isfinite(total)


def nearest(
    count: int, m: int, values: Floats, place: int, wanted: Floats, ends: Floats, weights: Floats
) -> int:
    """Return the function of a maximum whose constraint is nearest to an input.

    It is one whose set holds the state: the constraint of another would not keep the maximum. Where
    none of these can be met, and outside of all sets, it is the largest one's.
    """
    width, chosen, top = m + 2, 0, values[place + m + 1]
    for f in range(1, count):
        if values[place + f * width + m + 1] > top:
            chosen, top = f, values[place + f * width + m + 1]
    least = inf
    for f in range(count):
        at = place + f * width
        unit, square, value, most = 0.0, 0.0, values[at + m], values[at + m]
        for j in range(m):
            unit = max(unit, abs(values[at + j]))
        unit = unit if unit > 0.0 else 1.0  # so that squares neither overflow nor vanish
        for j in range(m):
            a = values[at + j]
            square += a / unit * (a / unit) / weights[j]
            value += a * wanted[j]
            most += max(a * ends[j], a * ends[m + j])
        distance = -value / unit
        if square > 0.0:
            distance = distance / sqrt(square)
        distance = distance if distance > 0.0 else 0.0
        level = values[at + m + 1]
        if most >= 0.0 and (level >= 0.0 or level == top) and distance < least:
            chosen, least = f, distance
    return chosen


def write_rows(
    shape: Floats, values: Floats, ends: Floats, weights: Floats, scratch: Scratch
) -> bool:
    """Write the rows of the QP and what it is nearest to; return whether all is finite."""
    k, m, goal = int(shape[K]), int(shape[M]), int(shape[GOAL])
    wanted, own, target, flags, _, _, rows, result, work = scratch[:9]
    count, width, total, outside = k + goal, m + goal, 0.0, False
    if goal == 0:
        for j in range(m):
            target[j] = wanted[j]
    for i in range(k):
        inside = flags[i] > 0.0
        outside = outside or not inside
        for j in range(m):
            rows[i * width + j] = own[i * m + j] if inside else 0.0
        if goal > 0:
            rows[i * width + m] = 0.0
        rows[count * width + i] = target[m + 1 + i]
        uncertain = shape[COUNTS + IS_UNCERTAIN * k + i] > 0.0 and shape[KIND] != UNCERTAIN
        if uncertain and flags[k + i] > 0.0:
            at = int(flags[2 * k + i]) - ((m + 1) * (m + 2) >> 1)
            constant = plane_above(m, values, at, ends, result, work)
            for j in range(m):
                rows[i * width + j] -= result[j]
            rows[count * width + i] -= constant
        total += rows[count * width + i]
    if goal > 0:
        growth = k * m + k
        for j in range(m):
            rows[k * width + j] = -values[growth + 1 + j]
        rows[k * width + m] = shape[UNIT]
        rows[count * width + k] = -values[growth]
    if outside:
        target_outwards(k, m, own, ends, weights, target, flags, result)
    return isfinite(total)


def minimise(
    shape: Floats,
    ends: Floats,
    weights: Floats,
    out: Floats,
    target: Floats,
    forms: Floats,
    wide: Floats,
    rows: Floats,
    result: Floats,
    work: Floats,
) -> bool:
    """Solve the QP; return whether its constraints can be met."""
    k, m, goal = int(shape[K]), int(shape[M]), int(shape[GOAL])
    if shape[KIND] == UNCERTAIN:
        return project_uncertain(k, rows, forms, target, ends, weights, out, work)
    if goal == 0:
        return project(k, m, rows, target, ends, weights, out, work)
    project(k + 1, m + 1, rows, target, wide, weights, result, work)
    feasible = True
    for j in range(m):
        out[j] = result[j]
    # The goal's constraint, which can always be met, has no say in that, nor has its rounding.
    for i in range(k):
        margin, allowed = residual(i, k + 1, m + 1, rows, result)
        feasible = feasible and margin >= -allowed
        out[m + i] = margin
        out[m + k + i] = result[m + 1 + k + 1 + i]
    return feasible


def leave_domains(k: int, m: int, own: Floats, out: Floats, flags: Floats) -> bool:
    """Write the rates of h of constraints outside their domain; return whether there are none."""
    inside = True
    for i in range(k):
        if flags[i] == 0.0:
            out[m + i], _ = residual(i, k, m, own, out)
            out[m + k + i] = 1.0
            inside = False
    return inside


def target_outwards(
    k: int,
    m: int,
    own: Floats,
    ends: Floats,
    weights: Floats,
    target: Floats,
    flags: Floats,
    rise: Floats,
) -> None:
    """Set the target far away where h of constraints outside their domain rises most.

    The allowed input nearest to one so far off is where h rises most among the allowed ones. Other
    constraints are not to suffer from one that has no meaning.
    """
    for j in range(m):
        rise[j] = 0.0
    for i in range(k):
        if flags[i] == 0.0:
            size = largest(i, m, own)
            for j in range(m):
                rise[j] += own[i * m + j] / (size if size > 0.0 else 1.0)
    size, steepness, reach = largest(0, m, rise), 0.0, 0.0
    size = size if size > 0.0 else 1.0
    for j in range(m):
        rise[j] /= size
        steepness += rise[j] * rise[j] / weights[j]
        reach += abs(rise[j]) * (ends[m + j] - ends[j])
    far = FAR_AWAY * reach / (steepness if steepness > 0.0 else 1.0)
    for j in range(m):
        corner = ends[m + j] if rise[j] > 0.0 else ends[j] if rise[j] < 0.0 else target[j]
        target[j] = corner + far * rise[j] / weights[j]


def largest(i: int, m: int, a: Floats) -> float:
    """Return the size of the largest coefficient of constraint i."""
    size = 0.0
    for j in range(m):
        size = max(size, abs(a[i * m + j]))
    return size


def plane_above(m: int, q: Floats, at: int, ends: Floats, slopes: Floats, work: Floats) -> float:
    """Write the slopes of a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within bounds.

    The slopes are the mean differences between the faces of the bounds, and c_0 is as small as the
    corners allow: the root is convex, so that the plane is above it everywhere if it is there.

    Returns:
        c_0.
    """
    corners = 1 << m
    for c in range(corners):
        square, place = 0.0, at
        for i in range(m + 1):
            for j in range(i, m + 1):
                product = corner_entry(c, i, m, ends) * corner_entry(c, j, m, ends)
                square += q[place] * (product if i == j else 2.0 * product)
                place += 1
        work[c] = sqrt(square) if square > 0.0 else 0.0
    for j in range(m):
        rise, width = 0.0, ends[m + j] - ends[j]
        for c in range(corners):
            rise += work[c] if c >> j & 1 == 1 else -work[c]
        # An input that its bounds hold has two equal faces.
        slopes[j] = rise / (0.5 * corners * width) if width > 0.0 else 0.0
    above = 0.0
    for c in range(corners):
        gap = work[c]
        for j in range(m):
            gap -= slopes[j] * corner_entry(c, j + 1, m, ends)
        above = gap if c == 0 or gap > above else above
    return above


def corner_entry(c: int, i: int, m: int, ends: Floats) -> float:
    """Return entry i of [1, u] at corner c of the bounds."""
    if i == 0:
        return 1.0
    return ends[m + i - 1] if c >> (i - 1) & 1 == 1 else ends[i - 1]


def furthest(
    k: int, m: int, a: Floats, b: Floats, at: int, u: Floats, weights: Floats, out: Floats
) -> int:
    """Return the active constraint whose half-space is furthest from an input, else -1.

    One that says nothing of the input is nearer than any; of several such, the first counts.
    """
    cause, most = -1, 0.0
    for i in range(k):
        if out[m + k + i] > 0.0:
            unit, square, value, distance = largest(i, m, a), 0.0, b[at + i], -inf
            if unit > 0.0:  # so that squares neither overflow nor vanish
                for j in range(m):
                    part = a[i * m + j] / unit
                    square += part * part / weights[j]
                    value += a[i * m + j] * u[j]
                distance = -value / unit / sqrt(square)
            if cause < 0 or distance > most:
                cause, most = i, distance
    return cause


def gather_barriers(k: int, m: int, shape: Floats, cause: int, out: Floats) -> int:
    """Write what counts of the constraints of each barrier; return the barrier of the cause."""
    for part in range(3):
        at, last = m + part * k, -1
        for i in range(k):
            owner, value = int(shape[COUNTS + OWNER * k + i]), out[at + i]
            if owner > last:
                out[at + owner] = value
            elif part == 0:
                out[at + owner] = min(out[at + owner], value)
            else:
                out[at + owner] = max(out[at + owner], value)
            last = owner
    return cause if cause < 0 else int(shape[COUNTS + OWNER * k + cause])


def hold(
    shape: Floats, values: Floats, ends: Floats, weights: Floats, out: Floats, scratch: Scratch
) -> bool:
    """Move the input to where its constraints hold all along the period; return whether they do."""
    k, m, count = int(shape[K]), int(shape[M]), int(shape[K] + shape[SAMPLED])
    flags, forms, rows, work = scratch[3], scratch[4], scratch[6], scratch[8]
    held, tangent, priorities, state, line, answer = scratch[9:15]
    goal = int(shape[GOAL])
    width, place = 1 + m + (m * (m + 1) >> 1), k
    for j in range(m):
        priorities[j] = weights[j]
    for c in range(2 * count):
        state[c] = 0.0
    for c in range(3 * (k if shape[KIND] != UNCERTAIN else 0)):
        forms[c] = 0.0
    for c in range(3 * k, 3 * count):
        forms[c] = 0.0
    for i in range(k):
        priorities[m + i] = weights[m + goal + i]
        held[i * width] = rows[(k + goal) * (m + goal) + i]
        for c in range(1, width):
            held[i * width + c] = rows[i * (m + goal) + c - 1] if c <= m else 0.0
        if shape[COUNTS + IS_SAMPLED * k + i] > 0.0:
            end, change = place * width, int(flags[2 * k + i])
            counts = flags[i] > 0.0 and flags[k + i] > 0.0
            fall = shape[PERIOD] * values[change] if counts else 0.0
            offset = held[i * width]
            held[end] = offset + fall - INWARDS * (abs(offset) + abs(fall))
            for c in range(1, width):
                held[end + c] = held[i * width + c]
                held[end + c] += shape[PERIOD] * values[change + c] if counts else 0.0
            priorities[m + place] = priorities[m + i]
            place += 1
    feasible = all_hold(count, m, held, forms, out, tangent, state)
    for _ in range(ROUNDS):
        if feasible:
            break
        project(count, m, tangent, out, ends, priorities, answer, work)
        left = move_on_line(count, m, held, forms, ends, priorities, out, answer, line)
        if m > 1 and left > SLOW:
            for axis in range(m):
                for j in range(m):
                    answer[j] = out[j] + 1.0 if j == axis else out[j]
                left *= move_on_line(count, m, held, forms, ends, priorities, out, answer, line)
        feasible = all_hold(count, m, held, forms, out, tangent, state)
        if not left < ENOUGH:
            break
    place = k
    for i in range(k):
        out[m + i] = state[i]
        if state[count + i] > 0.0:
            out[m + k + i] = 1.0
    for i in range(k):
        if shape[COUNTS + IS_SAMPLED * k + i] > 0.0:
            out[m + i] = state[place] if state[place] < out[m + i] else out[m + i]
            if not isfinite(state[place]):
                out[m + i] = state[place]
            if state[count + place] > 0.0:
                out[m + k + i] = 1.0
            place += 1
    return feasible


def all_hold(
    count: int, m: int, held: Floats, forms: Floats, u: Floats, tangent: Floats, state: Floats
) -> bool:
    """Return whether all constraints hold at an input, and linearise them there.

    `state` receives their values, and then 1 for those that do not hold.
    """
    holds, width = True, 1 + m + (m * (m + 1) >> 1)
    for i in range(count):
        offset = held[i * width]
        reached, size = offset, abs(offset)
        for j in range(m):
            term = held[i * width + 1 + j] * u[j]
            reached += term
            size += abs(term)
            tangent[i * m + j] = held[i * width + 1 + j]
        place = i * width + 1 + m
        for j in range(m):
            for n in range(j, m):
                term = held[place] * u[j] * u[n]
                reached += term
                size += abs(term)
                offset -= term
                tangent[i * m + j] += held[place] * u[n]
                tangent[i * m + n] += held[place] * u[j]
                place += 1
        allowed = ROUNDING * size
        q0, q1, q2 = forms[3 * i], forms[3 * i + 1], forms[3 * i + 2]
        linear, square = 2.0 * q1 * u[0], q2 * u[0] * u[0]
        inside = q0 + linear + square
        if inside > 0.0:
            root, blur = sqrt(inside), ROUNDING * (abs(q0) + abs(linear) + square)
            allowed += sqrt(inside + blur) - root
            steepness = (q1 + q2 * u[0]) / root
            reached -= root
            tangent[i * m] -= steepness
            offset += steepness * u[0] - root
        tangent[count * m + i] = offset
        state[i] = reached
        if not reached >= -allowed:
            state[count + i] = 1.0
            holds = False
    return holds


def move_on_line(
    count: int,
    m: int,
    held: Floats,
    forms: Floats,
    ends: Floats,
    priorities: Floats,
    u: Floats,
    v: Floats,
    line: Floats,
) -> float:
    """Move an input u on the line to v, to where constraints are violated least.

    `v` receives the direction.

    Returns:
        Which share of the squared violations is left.
    """
    width, proposed, first, last = 1 + m + (m * (m + 1) >> 1), 1.0, -FAR, FAR
    for j in range(m):
        v[j] -= u[j]
    if m == 1:  # there is one line, whatever is proposed
        proposed, v[0] = v[0], 1.0
    for j in range(m):
        if v[j] != 0.0:
            near, far = (ends[j] - u[j]) / v[j], (ends[m + j] - u[j]) / v[j]
            first = max(first, near if v[j] > 0.0 else far)
            last = min(last, far if v[j] > 0.0 else near)
    for i in range(count):
        constant, rate, bend, size = held[i * width], 0.0, 0.0, abs(held[i * width])
        place = i * width + 1 + m
        for j in range(m):
            c = held[i * width + 1 + j]
            constant += c * u[j]
            rate += c * v[j]
            size += abs(c * u[j])
            for n in range(j, m):
                c = held[place]
                constant += c * u[j] * u[n]
                rate += c * (u[j] * v[n] + v[j] * u[n])
                bend += c * v[j] * v[n]
                size += abs(c * u[j] * u[n])
                place += 1
        at, q1, q2 = ON_LINE * i, forms[3 * i + 1], forms[3 * i + 2]
        line[at], line[at + 1], line[at + 2], line[at + 3] = constant, rate, bend, size
        line[at + 4] = forms[3 * i] + 2.0 * q1 * u[0] + q2 * u[0] * u[0]
        line[at + 5] = 2.0 * (q1 + q2 * u[0]) * v[0]
        line[at + 6] = q2 * v[0] * v[0]
    before = violation_on_line(count, m, line, priorities, 0.0)
    best, least = 0.0, before
    for c in range(POINTS * count + 1):
        t = proposed if c == POINTS * count else point_of_change(c % POINTS, c // POINTS, line)
        t = first if t < first else last if t > last else t
        missed = violation_on_line(count, m, line, priorities, t)
        if missed < BETTER * least or (missed == least and abs(t) < abs(best)):
            best, least = t, missed
    for j in range(m):
        at_best = u[j] + best * v[j]
        u[j] = ends[j] if at_best < ends[j] else ends[m + j] if at_best > ends[m + j] else at_best
    return least / before if before > 0.0 else 1.0


def violation_on_line(count: int, m: int, line: Floats, priorities: Floats, t: float) -> float:
    """Return the sum of the squared violations at a point of a line."""
    total = 0.0
    for i in range(count):
        at = ON_LINE * i
        linear, square = line[at + 1] * t, line[at + 2] * t * t
        reached = line[at] + linear + square
        inside = line[at + 4] + line[at + 5] * t + line[at + 6] * t * t
        reached -= sqrt(inside) if inside > 0.0 else 0.0
        if not reached >= -ROUNDING * (line[at + 3] + abs(linear) + abs(square)):
            total += priorities[m + i] * reached * reached
    return total


def point_of_change(which: int, i: int, line: Floats) -> float:
    """Return a point of a line at which constraint i may begin to hold, or is violated least.

    It is a little beyond a root, and 0 where there is none.

    Args:
        which: 0 for the vertex of a constraint, 1 and 2 for its roots, 3 and 4 for those of an
            uncertain one.
        i: number of the constraint.
        line: coefficients.
    """
    at = ON_LINE * i
    constant, rate, bend = line[at], line[at + 1], line[at + 2]
    if which == 0:
        return ratio(-0.5 * rate, bend)
    if which > 2:
        if line[at + 4] == 0.0 and line[at + 6] == 0.0:
            return 0.0  # the constraint is certain
        constant, rate = constant * constant - line[at + 4], 2.0 * constant * rate - line[at + 5]
        bend = line[at + 1] * line[at + 1] - line[at + 6]
    square = rate * rate - 4.0 * bend * constant
    root = sqrt(square) if square > 0.0 else 0.0
    half = -0.5 * (rate + (root if rate > 0.0 else -root))
    found = ratio(half, bend) if which == 1 or which == 3 else ratio(constant, half)
    return found + ROUNDING * found


def ratio(numerator: float, denominator: float) -> float:
    """Return a quotient, 0 where it is none."""
    return numerator / denominator if denominator != 0.0 else 0.0


def decide_columns(numbers: Sequence[int]) -> int:
    """Decide for states whose numbers are the columns of tables, in machine code.

    Args:
        numbers: how many states there are, how many values each has, and 1 where each has bounds of
            its own, else 0; then the addresses of shape, weights, the tables of values, inputs,
            bounds and answers, of what receives the results of `decide`, of room for a column of
            each table, and of each scratch array.

    Returns:
        The result for the last state.
    """
    count, size, apart, code = numbers[0], numbers[1], numbers[2], 0
    shape, weights, values = floats_at(numbers[3]), floats_at(numbers[4]), floats_at(numbers[5])
    u, ends, out = floats_at(numbers[6]), floats_at(numbers[7]), floats_at(numbers[8])
    scratch = (
        floats_at(numbers[11]),
        floats_at(numbers[12]),
        floats_at(numbers[13]),
        floats_at(numbers[14]),
        floats_at(numbers[15]),
        floats_at(numbers[16]),
        floats_at(numbers[17]),
        floats_at(numbers[18]),
        floats_at(numbers[19]),
        floats_at(numbers[20]),
        floats_at(numbers[21]),
        floats_at(numbers[22]),
        floats_at(numbers[23]),
        floats_at(numbers[24]),
        floats_at(numbers[25]),
    )
    if count == 1:
        return decide(shape, weights, values, u, ends, out, scratch)
    codes, m = floats_at(numbers[9]), int(shape[M])
    length = answer_length(int(shape[K]), m, int(shape[GOAL]))
    of_values = numbers[10]
    of_inputs = of_values + 8 * size
    of_ends = of_inputs + 8 * m
    of_answer = of_ends + 16 * m
    column, proposed, bounds = floats_at(of_values), floats_at(of_inputs), floats_at(of_ends)
    answer = floats_at(of_answer)
    for i in range(count):
        for c in range(size):
            column[c] = values[c * count + i]
        for c in range(m):
            proposed[c] = u[c * count + i]
        for c in range(2 * m):
            bounds[c] = ends[c * count + i] if apart > 0 else ends[c]
        code = decide(shape, weights, column, proposed, bounds, answer, scratch)
        codes[i] = float(code)
        for c in range(length):
            out[c * count + i] = answer[c]
    return code


def decide_at(data: Floats, work: Floats, place: int) -> int:
    """Decide on an input in a program that is executed as Python.

    Args:
        data: numbers of the program.
        work: scratch array, which holds values and inputs, and receives the answer.
        place: in the data, of the numbers of `decide_columns`, with places for addresses: of shape,
            weights and bounds in the data, of all else in `work`.
    """
    places = [int(number) for number in data[place : place + 26]]
    shape, weights, ends = (data[places[i] :] for i in (3, 4, 7))
    values, u, out = (work[places[i] :] for i in (5, 6, 8))
    return decide(shape, weights, values, u, ends, out, [work[at:] for at in places[11:]])
