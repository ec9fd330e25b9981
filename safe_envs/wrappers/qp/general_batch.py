"""Several constraints on any number of inputs, for a batch of states.

As `safe_envs.wrappers.qp.general`, with the working sets of
`safe_envs.wrappers.qp.parametric`. States in which these do not prove their points, few but where
sizes differ by many orders of magnitude, are solved one by one.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from safe_envs.wrappers.qp import general, parametric
from safe_envs.wrappers.qp.rounding import ArrayAnswer
from safe_envs.wrappers.qp.working_set_batch import ArrayQP, find_points

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
        u[:, i] = general.project_floats(*parts, priority=priority.tolist())[0]
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
            functools.partial(parametric.propose, soft=soft, firm=firm) for soft, firm in _SOFTNESS
        ]
    return [importlib.import_module("safe_envs.wrappers.qp.proxqp").propose]
