"""Several constraints on any number of inputs, for one state.

A solver proposes which constraints and bounds hold the answer, and the point that these hold is
returned if it proves to be the answer; else what contradicts the proof changes them. So the
precision is that of the equations, not that of the solver. Where nothing is proved, a slower method
decides: for two inputs that of `safe_envs.wrappers.qp.plane_batch`, else that of
`safe_envs.wrappers.qp.active_set`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.wrappers.qp import active_set, one_constraint, plane_batch
from safe_envs.wrappers.qp.dual_active_set import propose
from safe_envs.wrappers.qp.plain_qp import margins
from safe_envs.wrappers.qp.rounding import FloatAnswer, Floats
from safe_envs.wrappers.qp.working_set import FloatQP, Point

_PIVOTS = 12
"""How often a working set is changed: more do not help where these do not."""


def project_floats(
    a: Sequence[Floats],
    b: Floats,
    v: Floats,
    low: Floats,
    high: Floats,
    w: Floats,
    priority: Floats,
) -> FloatAnswer:
    """Project the input of one state; see `dispatch.project_floats`."""
    if not all(map(any, a)):
        return _beside_flat(a, b, v, low, high, w, priority)
    qp = FloatQP(a, b, v, low, high, w, priority)
    missed = [i for i, value in enumerate(qp.margin) if not value >= 0.0]
    if not missed:
        return qp.start, qp.margin, [False] * len(b), True
    found = _of_one(missed[0], qp) if len(missed) == 1 else None
    if not found:
        try:
            found = _proved(qp.scaled())
        except ArithmeticError:  # too large, or too small, for the way to a proof
            found = None
        found = found or _unproved(qp)
    u, margin, allowed = found[:3]
    active = [value <= doubt for value, doubt in zip(margin, allowed, strict=True)]
    met = [value >= -doubt for value, doubt in zip(margin, allowed, strict=True)]
    return u, margin, active, all(met)


def _of_one(i: int, qp: FloatQP) -> tuple[list[float], list[float], list[float]] | None:
    """Return the answer where one constraint counts: that for it alone, if it meets the others."""
    p = qp
    u = one_constraint.project_floats(p.a[i], p.b[i], p.v, p.low, p.high, p.w)[0]
    margin, allowed = margins(p.a, p.b, u)
    for c, value in enumerate(margin):
        if c != i and not value >= -allowed[c]:
            return None
    return u, margin, allowed


def _beside_flat(
    a: Sequence[Floats],
    b: Floats,
    v: Floats,
    low: Floats,
    high: Floats,
    w: Floats,
    priority: Floats,
) -> FloatAnswer:
    """Project where some constraints say nothing of the input, and are met or not by themselves."""
    told = [i for i, row in enumerate(a) if any(row)]
    unmet = [i for i, row in enumerate(a) if b[i] < 0.0 and not any(row)]
    u = [min(max(vj, lo), hi) for vj, lo, hi in zip(v, low, high, strict=True)]
    margins, actives, feasible = [], [], True
    if told:
        rows, offsets = [a[i] for i in told], [b[i] for i in told]
        priorities = [priority[i] for i in told]
        u, margins, actives, feasible = project_floats(rows, offsets, v, low, high, w, priorities)
    margin, active = list(b), [i in unmet for i in range(len(b))]
    for i, value, acts in zip(told, margins, actives, strict=True):
        margin[i], active[i] = value, acts
    return u, margin, active, feasible and not unmet


def _proved(qp: FloatQP) -> Point | None:
    """Return the answer if a working set proves it."""
    working = qp.first()
    if len(working.rows) > 1 and qp.meets_each(working.rows):
        found = qp.point(working)
        if found.change is None:
            return found
    for proposed in propose(qp):
        found = qp.point(proposed)
        if found.change is None:
            return found
        working = found.change
    for _ in range(_PIVOTS):
        found = qp.point(working)
        if found.change is None:
            return found
        working = found.change
    return None


def _unproved(qp: FloatQP) -> tuple[list[float], list[float], list[float]]:
    p = qp
    numbers = [np.array(part) for part in (p.a, p.b, p.v, p.low, p.high, p.w, p.priority)]
    slow = plane_batch.project_single if len(p.v) == 2 else active_set.project
    with np.errstate(all="ignore"):
        u = slow(*numbers).tolist()
    return u, *margins(p.a, p.b, u)
