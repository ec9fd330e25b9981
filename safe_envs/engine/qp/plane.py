"""Several constraints on two inputs for one state, exact, in plain floats.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a_i . u + b_i >= 0,   low <= u <= high

Seidel's incremental scheme. The proposal clipped into the input bounds is the minimiser without
constraints. Where it violates the next constraint, the new minimiser lies on that constraint's
line: the input bounds and the constraints before leave an interval of the line, and the point of
the line nearest to v is clipped into it. Where the interval is empty, be it by rounding or because
no action meets the constraints, `safe_envs.engine.qp.general` finds the answer.

A line is written u_p = alpha + beta u_f. The free input f is the one that adds less to the
constraint, given how far each input can go: to the end of the input bounds, or as far in the metric
of the objective as the line is away, since a box may be endless. So neither term is much larger
than u_p, and rounding stays small. Every test compares a sum with its own terms: constraints may
have any size.

The states that violate the constraint in turn are gathered and moved onto its line, so that the
number of NumPy calls grows with the number of constraints and not with the batch. Every number
comes from the same operations in the same order as for one state.

The sum is convex and piecewise quadratic. A Newton step goes to the minimiser, over the input
bounds, of the quadratic that the constraints violated now define; the sum is then minimised along
the step. Near the minimiser the violated constraints no longer change and the step is exact. A
state is done when the forces of the constraints, slack times coefficient, balance with those of the
input bounds.

Constraints count in their own units, so that one may be 1e9 times as steep as another: its slack at
the minimiser is then below the rounding of its margin, and it acts as a wall. What the other
constraints ask for along the wall must not drown in its rounding. Hence the frame of a step is that
of the steepest constraint, and a force is known as an interval, judged along the walls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from safe_envs.engine.qp import bounded_least_squares, interval
from safe_envs.engine.qp.rounding import (
    ROUNDING,
    ArrayAnswer,
    Arrays,
    Entries,
    FloatAnswer,
    Floats,
    stack,
    tolerance,
    tolerances,
    total,
)

Row = tuple[float, float, float]
"""(a_1, a_2, b) of a constraint a . u + b >= 0; on a line, the second and first input are the pivot
and the free one."""


Input = tuple[float, float, float, float]
"""Proposal, lower and upper bound, and weight of an input."""


def project_floats(
    a: Sequence[Floats], b: Floats, v: Floats, low: Floats, high: Floats, w: Floats
) -> FloatAnswer | None:
    """Project the input of one state.

    Args:
        a: k constraints of two coefficients.
        b: k offsets.
        v: two proposed inputs.
        low: two lower bounds.
        high: two upper bounds.
        w: two positive weights.

    Returns:
        As `dispatch.project_floats`; None where the constraints cannot be met together, or can up
        to rounding only.
    """
    (v1, v2), (l1, l2), (h1, h2) = v, low, high
    c1 = l1 if v1 < l1 else h1 if v1 > h1 else v1
    c2 = l2 if v2 < l2 else h2 if v2 > h2 else v2
    rows = [(a1, a2, bi) for (a1, a2), bi in zip(a, b, strict=True)]
    margin = [a1 * c1 + a2 * c2 + bi for a1, a2, bi in rows]
    if min(margin) >= 0.0:
        return [c1, c2], margin, [False] * len(margin), True
    r1, r2 = math.sqrt(w[0]), math.sqrt(w[1])
    e1, e2 = max(-l1, h1), max(-l2, h2)
    u = u1, u2 = c1, c2
    for i, (a1, a2, bi) in enumerate(rows):
        miss = a1 * u1 + a2 * u2 + bi
        if miss >= 0.0 or miss >= -ROUNDING * (abs(a1 * u1) + abs(a2 * u2) + abs(bi)):
            continue
        steepness = abs(a1) / r1 + abs(a2) / r2
        reach = r1 * abs(u1) + r2 * abs(u2) - (miss / steepness if steepness > 0.0 else miss)
        if abs(a1) * min(e1, reach / r1) >= abs(a2) * min(e2, reach / r2):
            u = _onto_line(rows[i], rows[:i], (v1, l1, h1, w[0]), (v2, l2, h2, w[1]))
        else:
            before = [(q2, q1, q0) for q1, q2, q0 in rows[:i]]
            found = _onto_line((a2, a1, bi), before, (v2, l2, h2, w[1]), (v1, l1, h1, w[0]))
            u = found and (found[1], found[0])
        if u is None:
            return None
        u1, u2 = u
    margin = [a1 * u1 + a2 * u2 + bi for a1, a2, bi in rows]
    if not all(
        [  # noqa: C419
            g >= 0.0 or g >= -tolerance((a1, a2), bi, u)
            for (a1, a2, bi), g in zip(rows, margin, strict=True)
        ]
    ):
        return None
    return [u1, u2], margin, binding(a, b, u, margin, low, high, w), True


def binding(
    a: Sequence[Floats],
    b: Floats,
    u: Floats,
    margin: Floats,
    low: Floats,
    high: Floats,
    w: Floats,
) -> list[bool]:
    """Return which margins (k) exceed zero by no more than rounding.

    Args:
        a: k constraints of two coefficients.
        b: k offsets.
        u: two inputs.
        margin: k margins there.
        low: two lower bounds.
        high: two upper bounds.
        w: two positive weights.
    """
    r1, r2 = math.sqrt(w[0]), math.sqrt(w[1])
    reach = r1 * abs(u[0]) + r2 * abs(u[1])
    s1 = min(max(-low[0], high[0]), reach / r1)
    s2 = min(max(-low[1], high[1]), reach / r2)
    return [
        g <= 0.0 or g <= ROUNDING * (abs(bi) + abs(a1) * s1 + abs(a2) * s2)
        for (a1, a2), bi, g in zip(a, b, margin, strict=True)
    ]


def _onto_line(
    line: Row, before: list[Row], pivot_input: Input, free_input: Input
) -> tuple[float, float] | None:
    """Return the minimiser (pivot, free) on a line within the constraints before, or None."""
    vp, lp, hp, wp = pivot_input
    vf, lf, hf, wf = free_input
    ap, af, b = line
    if ap == 0.0:
        return None
    alpha, beta = -b / ap, -af / ap
    lo, hi = lf, hf
    for rp, rf, rb in (*before, (1.0, 0.0, -lp), (-1.0, 0.0, hp)):
        slope, offset = rf + rp * beta, rb + rp * alpha
        if abs(slope) <= ROUNDING * abs(rf):
            if offset < -ROUNDING * (abs(rb) + abs(rp * alpha)):
                return None
        elif slope > 0.0:
            end = -offset / slope
            if end > lo:
                lo = end
        else:
            end = -offset / slope
            if end < hi:
                hi = end
    if not lo <= hi:
        return None
    aim = vf + wp * beta * (vp - alpha - beta * vf) / (wf + wp * beta * beta)
    free = lo if aim < lo else hi if aim > hi else aim
    pivot = alpha + beta * free
    return (lp if pivot < lp else hp if pivot > hp else pivot), free


_STEPS = 20
_SURELY = 100.0
"""A constraint violated by so many times its rounding surely has a slack: one that binds may
be violated by a few."""
_FAR = 1e150
"""A line further off than this meets no box. How far does not matter, and its square would
overflow."""


class _Rows(NamedTuple):
    """Constraints x u_1 + y u_2 + r in units of the steepest (k, B), bounds and inputs (2, B)."""

    x: np.ndarray
    y: np.ndarray
    r: np.ndarray
    low: np.ndarray
    high: np.ndarray
    u: np.ndarray

    def take(self, states: np.ndarray) -> _Rows:
        return _Rows(*[part[:, states] for part in self])


def least_violating(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """Minimise sum_i priority_i max(0, -(a_i . u + b_i))^2 over a box of two inputs.

    Args:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        low: lower bounds, shape (2, B).
        high: upper bounds, shape (2, B).
        priority: positive weights, shape (k,).
        start: inputs to begin with, shape (2, B), inside the input bounds.

    Returns:
        Minimisers, shape (2, B).
    """
    units = np.sqrt(priority)[:, None]
    size = (units * np.abs(a)).max(axis=(0, 1))
    size = np.where(size > 0.0, size, 1.0)  # so that squares neither overflow nor vanish
    u, left = start.copy(), np.arange(start.shape[1])
    rows = _Rows(
        a[0] * units / size,
        a[1] * units / size,
        np.clip(b * units / size, -_FAR, _FAR),
        low,
        high,
        u,
    )
    for _ in range(_STEPS):
        margin, error = _margin(rows)
        # The smallest and the largest slack of each constraint that rounding allows.
        least, most = np.maximum(-margin - error, 0.0), np.maximum(-margin + error, 0.0)
        moving = np.flatnonzero(~_balanced(rows, least, most))
        if not moving.size:
            return u
        left, rows = left[moving], rows.take(moving)
        u[:, left] = _newton(
            rows, margin[:, moving], error[:, moving], least[:, moving], most[:, moving]
        )
        rows = rows._replace(u=u[:, left])
    for i in left.tolist():
        fit = bounded_least_squares.least_violating(
            a[:, :, i].T, b[:, i], low[:, i], high[:, i], priority, start[:, i]
        )
        missed = [
            np.linalg.norm(units[:, 0] * np.minimum(a[:, :, i].T @ end + b[:, i], 0.0))
            for end in (u[:, i], fit)
        ]
        u[:, i] = u[:, i] if missed[0] <= missed[1] else fit
    return u


def is_unique(a: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return whether minimisers u (2, B) are the only actions with their slacks, shape (B,).

    They are if the constraints that they violate cross.

    Args:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        u: the minimisers.
    """
    first, second = a[0] * u[0], a[1] * u[1]
    rounding = ROUNDING * (np.abs(first) + np.abs(second) + np.abs(b))
    violated = first + second + b < -_SURELY * rounding
    _, _, along = _frame(np.where(violated, a[0], 0.0), np.where(violated, a[1], 0.0))
    return np.any(along != 0.0, axis=0)


def _margin(rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
    """Margins of the constraints and what rounding may make of them."""
    first, second = rows.x * rows.u[0], rows.y * rows.u[1]
    return first + second + rows.r, ROUNDING * (np.abs(first) + np.abs(second) + np.abs(rows.r))


def _balanced(rows: _Rows, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return whether the forces cancel (B,), along both inputs and along each constraint.

    A constraint has no part in the force along itself.
    """
    nothing = np.zeros_like(rows.u[:1])
    along = (
        np.concatenate([nothing + 1.0, nothing, -rows.y]),
        np.concatenate([nothing, nothing + 1.0, rows.x]),
    )
    first, second = along[0] * rows.x[:, None], along[1] * rows.y[:, None]
    share, error = first + second, ROUNDING * (np.abs(first) + np.abs(second))
    ends = share * least[:, None], share * most[:, None]
    error *= most[:, None]
    down, up = total(np.minimum(*ends) - error), total(np.maximum(*ends) + error)
    for j in (0, 1):
        # A face of the input bounds pushes inwards, as strongly as it takes.
        down = np.where(
            (rows.u[j] <= rows.low[j]) & (along[j] < 0.0)
            | (rows.u[j] >= rows.high[j]) & (along[j] > 0.0),
            -np.inf,
            down,
        )
        up = np.where(
            (rows.u[j] <= rows.low[j]) & (along[j] > 0.0)
            | (rows.u[j] >= rows.high[j]) & (along[j] < 0.0),
            np.inf,
            up,
        )
    return np.all((down <= 0.0) & (up >= 0.0), axis=0)


def _newton(
    rows: _Rows, margin: np.ndarray, error: np.ndarray, least: np.ndarray, most: np.ndarray
) -> np.ndarray:
    part = least > 0.0
    while True:
        x, y, r, doubt = [np.where(part, entry, 0.0) for entry in (rows.x, rows.y, margin, error)]
        goal = _least_squares(rows._replace(x=x, y=y, r=r), doubt)
        step = goal - rows.u
        change = rows.x * step[0] + rows.y * step[1]
        # A wall, whose slack may be mere rounding, takes part if the step would go through it.
        hit = (most > 0.0) & (change < 0.0) & ~part
        if not hit.any():
            break
        part |= hit
    nothing = np.zeros(goal.shape[1])
    length = interval.least_violating(change, margin, nothing, nothing + 1.0, np.ones(len(margin)))
    return np.where(
        length == 1.0, goal, np.minimum(np.maximum(rows.u + length * step, rows.low), rows.high)
    )


def _least_squares(rows: _Rows, error: np.ndarray) -> np.ndarray:
    """Minimise |x d_1 + y d_2 + r|^2, r being known up to an error, with u + d within its bounds.

    The minimum is inside, or else on an edge.
    """
    goal = rows.u + _unbounded(rows)
    outside = np.flatnonzero(~((goal >= rows.low) & (goal <= rows.high)).all(axis=0))
    if outside.size:
        goal[:, outside] = _best_edge(rows.take(outside), error[:, outside])
    return goal


def _frame(
    x: np.ndarray, y: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Return the steepest constraint (2, B), and each one's components across and along it.

    The latter are zero where the constraints are parallel.
    """
    steepest = np.maximum(np.abs(x), np.abs(y)).argmax(axis=0)[None]
    n1, n2 = [np.take_along_axis(part, steepest, axis=0)[0] for part in (x, y)]
    first, second = y * n1, x * n2
    along = first - second
    return (
        (n1, n2),
        x * n1 + y * n2,
        np.where(np.abs(along) > ROUNDING * (np.abs(first) + np.abs(second)), along, 0.0),
    )


def _unbounded(rows: _Rows) -> np.ndarray:
    """Return the least-squares step (2, B), in the frame of the steepest constraint.

    It is across that alone where all are parallel.
    """
    (n1, n2), across, along = _frame(rows.x, rows.y)
    square = total(across * across)
    square = np.where(square > 0.0, square, 1.0)
    common = total(across * along) / square
    rest = along - common * across
    lone = total(rest * rest)
    first = -total(across * rows.r) / square
    second = np.where(lone > 0.0, -total(rest * (rows.r + first * across)) / lone, 0.0)
    first = first - common * second
    return np.array([first * n1 - second * n2, first * n2 + second * n1])


def _best_edge(rows: _Rows, error: np.ndarray) -> np.ndarray:
    """Return the point of the four edges whose multiplier has the right sign.

    If several do up to rounding, it is that of the least sum, and the nearest.
    """
    u, low, high = rows.u, rows.low, rows.high
    best, least_wrong, least_sum = (
        u.copy(),
        np.full(u.shape[1], np.inf),
        np.full(u.shape[1], np.inf),
    )
    nearer = u - low <= high - u
    for j, near in ((0, True), (1, True), (0, False), (1, False)):
        fixed, moving = (rows.x, rows.y) if j == 0 else (rows.y, rows.x)
        end, sign = np.where(
            nearer[j] == near, (low[j], -np.ones_like(low[j])), (high[j], np.ones_like(low[j]))
        )
        shift = fixed * (end - u[j])
        square = total(moving * moving)
        step = np.where(square > 0.0, -total(moving * (rows.r + shift)) / square, 0.0)
        along = np.minimum(np.maximum(u[1 - j] + step, low[1 - j]), high[1 - j])
        turn = moving * (along - u[1 - j])
        margin = rows.r + shift + turn
        doubt = error + ROUNDING * (np.abs(shift) + np.abs(turn))
        force = sign * total(fixed * margin)
        wrong = np.where(force > total(np.abs(fixed) * doubt), force, 0.0) / np.sqrt(
            total(fixed * fixed)
        )
        missed = total(np.where(np.abs(margin) > doubt, margin * margin, 0.0))
        better = (wrong < least_wrong) | (wrong == least_wrong) & (missed < least_sum)
        least_wrong, least_sum = (
            np.where(better, wrong, least_wrong),
            np.where(better, missed, least_sum),
        )
        best[j], best[1 - j] = np.where(better, end, best[j]), np.where(better, along, best[1 - j])
    return best


class Plane(NamedTuple):
    """Problems of B states; pairs of inputs in front.

    Attributes:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        v: proposals, shape (2, B).
        low: lower bounds, shape (2, B).
        high: upper bounds, shape (2, B).
        w: positive weights, shape (2, B).
    """

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    w: np.ndarray

    def take(self, states: np.ndarray) -> Plane:
        """Return some states of the batch."""
        return Plane(*[part[..., states] for part in self])

    def clip(self, u: np.ndarray) -> np.ndarray:
        """Return inputs (2, B) clipped to their bounds."""
        return np.minimum(np.maximum(u, self.low), self.high)

    def margin(self, u: np.ndarray) -> np.ndarray:
        """Return the margins (k, B) at inputs (2, B)."""
        return self.a[0] * u[0] + self.a[1] * u[1] + self.b

    def scale(self, u: np.ndarray, away: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how far each input can go (2, B).

        It goes to its bound, or as far as u and `away` in the metric of the objective.

        Args:
            u: inputs, shape (2, B).
            away: how far more, shape (B,).
        """
        root = np.sqrt(self.w)
        reach = root[0] * np.abs(u[0]) + root[1] * np.abs(u[1]) + away
        return np.minimum(np.maximum(-self.low, self.high), reach / root)

    def met(self, u: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return whether all constraints are met (B,).

        Args:
            u: inputs, shape (2, B).
            margin: the constraints' there, shape (k, B).
        """
        return (margin >= -tolerances(self.a, self.b, u)).all(axis=0)

    def binds(self, u: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return whether a margin exceeds zero by no more than rounding (k, B).

        Args:
            u: inputs, shape (2, B).
            margin: the constraints' there, shape (k, B).
        """
        s1, s2 = self.scale(u)
        return (margin <= 0.0) | (
            margin <= ROUNDING * (np.abs(self.b) + np.abs(self.a[0]) * s1 + np.abs(self.a[1]) * s2)
        )


@np.errstate(all="ignore")
def project_arrays(
    a: Sequence[Entries],
    b: Entries,
    v: Arrays,
    low: Entries,
    high: Entries,
    w: Entries,
    otherwise: Callable[[Sequence[np.ndarray]], ArrayAnswer],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project the inputs of B states.

    Args:
        a: k constraints of two coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        v: two arrays (B,) of proposed inputs.
        low: two lower bounds, each a float or an array (B,).
        high: two upper bounds, likewise.
        w: two positive weights, likewise.
        otherwise: finds inputs, margins and whether constraints can be met, from all of these in
            arrays, where the constraints cannot be met, or by rounding only.

    Returns:
        Inputs (2, B), margins (k, B), constraints that bind or cannot be met (k, B), and whether
        all constraints can be met (B,).
    """
    size = len(v[0])
    a_of_input = np.array([stack([row[j] for row in a], size) for j in (0, 1)])
    plane = Plane(a_of_input, stack(b, size), *[stack(pair, size) for pair in (v, low, high, w)])
    u = plane.clip(plane.v)
    margin = plane.margin(u)
    active, feasible = np.zeros(margin.shape, dtype=bool), np.ones(size, dtype=bool)
    acting = np.flatnonzero((margin < 0.0).any(axis=0))
    if acting.size:
        part = plane.take(acting)
        moved, met = _nearest(part)
        reached = part.margin(moved)
        met &= part.met(moved, reached)
        unmet = np.flatnonzero(~met)
        if unmet.size:
            rows, *others = part.take(unmet)
            least, missed, _, met[unmet] = otherwise([np.swapaxes(rows, 0, 1), *others])
            moved[:, unmet], reached[:, unmet] = least, missed
        u[:, acting], margin[:, acting], feasible[acting] = moved, reached, met
        active[:, acting] = part.binds(moved, reached)
    return u, margin, active, feasible


def project_single(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    """Return the nearest inputs (2,) of those that violate the constraints of one state least.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        priority: positive weights of the squared slacks, shape (k,).
    """
    plane = Plane(a.T[:, :, None], *[part[:, None] for part in (b, v, low, high, w)])
    u, met = _nearest(plane)
    if not (met & plane.met(u, plane.margin(u))).all():
        u = _nearest_of_least_violating(plane, priority)
    return u[:, 0]


def _nearest_of_least_violating(plane: Plane, priority: np.ndarray) -> np.ndarray:
    """Return the action nearest to v of those with the least sum of squared slacks.

    All of these have the same slacks.
    """
    u = least_violating(plane.a, plane.b, plane.low, plane.high, priority, plane.clip(plane.v))
    several = np.flatnonzero(~is_unique(plane.a, plane.b, u))
    if several.size:
        part, least = plane.take(several), u[:, several]
        line = -(part.a[0] * least[0] + part.a[1] * least[1])
        nearest, met = _nearest(part._replace(b=np.maximum(part.b, line)))
        # A step of rounding size would only move an input off the end of its interval.
        away = (np.abs(nearest - least) > ROUNDING * part.scale(least)).any(axis=0)
        u[:, several] = np.where(met & away, nearest, least)
    return u


def _nearest(plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    """Return minimisers (2, B), undefined where constraints cannot be met, and whether they can."""
    u = plane.clip(plane.v)
    met = np.ones(u.shape[1], dtype=bool)
    for i, (a1, a2, b) in enumerate(zip(*plane.a, plane.b, strict=True)):
        first, second = a1 * u[0], a2 * u[1]
        miss = first + second + b
        states = np.flatnonzero(
            (miss < -ROUNDING * (np.abs(first) + np.abs(second) + np.abs(b))) & met
        )
        if states.size:
            part = plane.take(states)
            part = part._replace(a=part.a[:, : i + 1], b=part.b[: i + 1])
            u[:, states], met[states] = _onto_lines(part, u[:, states], miss[states])
    return u, met


def _onto_lines(plane: Plane, u: np.ndarray, miss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return minimisers (2, B) on the line of the last constraint, which u violates.

    Returns:
        These, and whether the constraints before and the input bounds leave any (B,).
    """
    first, second = np.abs(plane.a[:, -1])
    root = np.sqrt(plane.w)
    steepness = first / root[0] + second / root[1]
    s1, s2 = plane.scale(u, -np.where(steepness > 0.0, miss / steepness, miss))
    steep = first * s1 >= second * s2
    (rp, rf), (vp, vf), (lp, lf), (hp, hf), (wp, wf) = [
        (np.where(steep, *pair), np.where(steep, *pair[::-1]))
        for pair in (plane.a, plane.v, plane.low, plane.high, plane.w)
    ]
    alpha, beta = -plane.b[-1] / rp[-1], -rf[-1] / rp[-1]
    box = np.ones((2, len(alpha)))
    box[1] = -1.0
    before = _OnLine.of(
        np.concatenate([rp[:-1], box]),
        np.concatenate([rf[:-1], 0.0 * box]),
        np.concatenate([plane.b[:-1], [-lp, hp]]),
        alpha,
        beta,
    )
    aim = vf + wp * beta * (vp - alpha - beta * vf) / (wf + wp * beta * beta)
    lo, hi = before.interval(lf, hf, 0.0)
    free = np.minimum(np.maximum(aim, lo), hi)
    met = lo <= hi
    if not met.all():
        between = np.minimum(np.maximum(aim, hi), lo)
        lo, hi = before.interval(lf, hf, ROUNDING)
        free = np.where(met, free, np.minimum(np.maximum(between, lo), hi))
        met |= (lo <= hi) & before.holds(free)
    met &= before.crosses
    pivot = np.minimum(np.maximum(alpha + beta * free, lp), hp)
    return np.array([np.where(steep, pivot, free), np.where(steep, free, pivot)]), met


class _OnLine(NamedTuple):
    """Constraints slope * u_f + offset >= 0 along a line (k, B), with the sizes of their terms."""

    slope: np.ndarray
    offset: np.ndarray
    slope_terms: np.ndarray
    offset_terms: np.ndarray
    parallel: np.ndarray

    @classmethod
    def of(
        cls, rp: np.ndarray, rf: np.ndarray, rb: np.ndarray, alpha: np.ndarray, beta: np.ndarray
    ) -> _OnLine:
        turn, shift = rp * beta, rp * alpha
        slope = rf + turn
        parallel = np.abs(slope) <= ROUNDING * np.abs(rf)
        return cls(
            slope, rb + shift, np.abs(rf) + np.abs(turn), np.abs(rb) + np.abs(shift), parallel
        )

    @property
    def crosses(self) -> np.ndarray:
        """Whether no constraint lies parallel to the line on its wrong side (B,)."""
        return np.all(~self.parallel | (self.offset >= -ROUNDING * self.offset_terms), axis=0)

    def interval(
        self, lo: np.ndarray, hi: np.ndarray, relative: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what the constraints leave of [lo, hi] if each may miss by part of its terms."""
        offset = self.offset
        if relative:
            offset = offset + relative * (
                self.offset_terms + self.slope_terms * np.abs(offset / self.slope)
            )
        end = -offset / self.slope
        lo = np.maximum(lo, np.where((self.slope > 0.0) & ~self.parallel, end, -np.inf).max(axis=0))
        return lo, np.minimum(
            hi, np.where((self.slope < 0.0) & ~self.parallel, end, np.inf).min(axis=0)
        )

    def holds(self, free: np.ndarray) -> np.ndarray:
        """Whether every constraint is met up to rounding where the free input is as given (B,)."""
        terms = self.offset_terms + self.slope_terms * np.abs(free)
        return np.all(self.slope * free + self.offset >= -2.0 * ROUNDING * terms, axis=0)
