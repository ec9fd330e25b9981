"""Several constraints on any number of inputs, for one state.

A solver proposes which constraints and bounds hold the answer, and the point that these hold is
returned if it proves to be the answer; else what contradicts the proof changes them. So the
precision is that of the equations, not that of the solver. Where nothing is proved, a slower method
decides: for two inputs that of `safe_envs.engine.qp.plane`, else that of
`safe_envs.engine.qp.working_set`.

As `safe_envs.engine.qp.general`, with the working sets of
`safe_envs.engine.qp.working_set`. States in which these do not prove their points, few but where
sizes differ by many orders of magnitude, are solved one by one.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from safe_envs.engine.qp import one_constraint, plane, working_set
from safe_envs.engine.qp.rounding import ArrayAnswer, FloatAnswer, Floats, margins
from safe_envs.engine.qp.working_set import ArrayQP, FloatQP, Point, find_points, propose_daqp

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
    for proposed in propose_daqp(qp):
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
    slow = plane.project_single if len(p.v) == 2 else working_set.project
    with np.errstate(all="ignore"):
        u = slow(*numbers).tolist()
    return u, *margins(p.a, p.b, u)


_SOFTNESS = ((1e-8, 1e-12), (1e-8, 1e-17), (1e-5, 1e-14))
"""Of soft constraints, the least and that of the firmest one at least; see `parametric.propose`.
The second is for constraints of very different weights."""
_FEW = 8
"""States that one by one take less time than together."""


def project_arrays(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
    solver: str,
) -> ArrayAnswer:
    """Project the proposed inputs of a batch.

    Args:
        a: constraints, shape (k, m, B).
        b: offsets, shape (k, B).
        v: proposed inputs, shape (m, B).
        low: lower bounds, shape (m, B).
        high: upper bounds, shape (m, B).
        w: positive weights, shape (m, B).
        priority: positive weights of the squared slacks, shape (k,).
        solver: what proposes working sets; "daqp" for the fast methods.

    Returns:
        As `dispatch.project_arrays`.
    """
    # A constraint that says nothing of the input is met or not by itself.
    flat = (a == 0.0).all(axis=1)
    unmet = flat & (b < 0.0)
    p = ArrayQP.of(a, np.where(flat, 0.0, b), v, low, high, w, priority[:, None])
    u = np.minimum(np.maximum(v, low), high)
    margin, allowed = p.margins(u)
    missed: Any = (margin < 0.0).any(axis=0)
    active, feasible = np.zeros(b.shape, dtype=bool), np.ones(b.shape[1], dtype=bool)
    left = np.flatnonzero(missed)
    for propose in _methods(solver):
        if left.size <= _FEW and solver == "daqp":
            break
        part = p if left.size == len(missed) else p.take(left)
        found = find_points(part, *propose(part))
        solved = left[found.proved]
        u[:, solved] = found.u[:, found.proved]
        margin[:, solved] = found.margin[:, found.proved]
        allowed[:, solved] = found.allowed[:, found.proved]
        left = left[~found.proved]
    for i in left.tolist():
        parts = [part[..., i].tolist() for part in (a, p.b, v, low, high, w)]
        u[:, i] = project_floats(*parts, priority=priority.tolist())[0]
    margin[:, left], allowed[:, left] = p.take(left).margins(u[:, left])
    active[:, missed] = (margin <= allowed)[:, missed]
    feasible = (margin >= -allowed).all(axis=0) & ~unmet.any(axis=0)
    active = np.where(flat, unmet, active)
    margin = np.where(flat, b, margin)
    return list(u), list(margin), list(active), feasible


def _methods(solver: str) -> list[Callable[[ArrayQP], tuple[np.ndarray, np.ndarray]]]:
    """Return what proposes working sets, one after the other."""
    if solver == "daqp":
        return [
            functools.partial(working_set.propose_parametric, soft=soft, firm=firm)
            for soft, firm in _SOFTNESS
        ]
    return [importlib.import_module("safe_envs.engine.qp.proxqp").propose]
