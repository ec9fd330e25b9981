"""Several constraints on two inputs for one state, exact, in plain floats.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a_i . u + b_i >= 0,   low <= u <= high

Seidel's incremental scheme. The proposal clipped into the input bounds is the minimiser without
constraints. Where it violates the next constraint, the new minimiser lies on that constraint's
line: the input bounds and the constraints before leave an interval of the line, and the point of
the line nearest to v is clipped into it. Where the interval is empty, be it by rounding or because
no action meets the constraints, `safe_envs.wrappers.qp.general` finds the answer.

A line is written u_p = alpha + beta u_f. The free input f is the one that adds less to the
constraint, given how far each input can go: to the end of the input bounds, or as far in the metric
of the objective as the line is away, since a box may be endless. So neither term is much larger
than u_p, and rounding stays small. Every test compares a sum with its own terms: constraints may
have any size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from safe_envs.wrappers.qp.rounding import ROUNDING, FloatAnswer, Floats, tolerance

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
