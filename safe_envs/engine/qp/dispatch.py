"""Any number of constraints and inputs: each QP goes to the method that is exact for its size.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a_i . u + b_i >= 0,   low <= u <= high

Where the constraints cannot be met together, the answer is the least-violating action, flagged: it
minimises sum_i priority_i slack_i^2 with slack_i = max(0, -(a_i . u + b_i)), and among the
minimisers it is the one nearest to v. One constraint and one input have exact methods of their own,
and so have constraints on two inputs that can be met. For the rest a solver proposes which
constraints and bounds hold the answer, and their equations prove it; what that needs is imported by
`prepare`, or on first use. Constraints can be met where the action that is returned meets them by
the tolerance of `safe_envs.engine.qp.rounding`.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.engine.qp import interval, one_constraint, plane
from safe_envs.engine.qp.rounding import ArrayAnswer, Arrays, Entries, FloatAnswer, Floats, stack

SOLVERS = ("daqp", "proxqp")
"""What proposes the constraints and bounds that hold an answer. The answer is that of their
equations, and so the same; ProxQP is slower, and there as a second opinion."""


def prepare(k: int, m: int, solver: str = "daqp") -> None:
    """Import what the QPs of a size need, so that no decision waits for it.

    Args:
        k: number of constraints.
        m: number of inputs.
        solver: one of `SOLVERS`.
    """
    if k > 1 and m > 1:
        _general("general")
        if solver != "daqp":
            _general(solver)


@functools.cache
def _general(name: str) -> Any:
    """Import a module of the general method, which few filters need."""
    return importlib.import_module(f"safe_envs.engine.qp.{name}")


def project_floats(
    a: Sequence[Floats],
    b: Floats,
    v: Floats,
    low: Floats,
    high: Floats,
    w: Floats,
    priority: Floats,
    solver: str = "daqp",
) -> FloatAnswer:
    """Project the proposed input of one state.

    Args:
        a: k constraints of m coefficients.
        b: k offsets.
        v: m proposed inputs.
        low: m lower bounds.
        high: m upper bounds.
        w: m positive weights.
        priority: k positive weights of the squared slacks.
        solver: one of `SOLVERS`, for several constraints on three and more inputs.

    Returns:
        Inputs (m), margins a_i . u + b_i (k), constraints that bind or cannot be met (k; none where
        the clipped proposal meets them all), and whether all constraints can be met.
    """
    if len(b) == 1:
        u, margin, active, feasible = one_constraint.project_floats(a[0], b[0], v, low, high, w)
        return u, [margin], [active], feasible
    found = None
    if len(v) == 2:
        found = plane.project_floats(a, b, v, low, high, w)
        if not found and solver == "daqp":
            u, margin, _, met = _general("general").project_floats(a, b, v, low, high, w, priority)
            return u, margin, plane.binding(a, b, u, margin, low, high, w), met
    elif len(v) == 1:
        found = interval.project_floats([ai for (ai,) in a], b, v[0], low[0], high[0])
    elif solver == "daqp":
        found = _general("general").project_floats(a, b, v, low, high, w, priority)
    if found:
        return found
    proposed = [np.array([c]) for c in v]
    *parts, feasible = project_arrays(a, b, proposed, low, high, w, priority, solver)
    inputs, margins, binding = [[entry.item() for entry in part] for part in parts]
    return inputs, margins, binding, feasible.item()


@np.errstate(all="ignore")
def project_arrays(
    a: Sequence[Entries],
    b: Entries,
    v: Arrays,
    low: Entries,
    high: Entries,
    w: Entries,
    priority: Floats,
    solver: str = "daqp",
) -> ArrayAnswer:
    """Project the proposed inputs of a batch of B states.

    Args:
        a: k constraints of m coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        v: m arrays (B,) of proposed inputs.
        low: m lower bounds, each a float or an array (B,).
        high: m upper bounds, likewise.
        w: m positive weights, likewise.
        priority: k positive weights of the squared slacks.
        solver: one of `SOLVERS`, for several constraints on three and more inputs.

    Returns:
        As `project_floats`, with an array (B,) for every number.
    """
    if len(b) == 1:
        u, margin, active, feasible = one_constraint.project_arrays(a[0], b[0], v, low, high, w)
        return u, [margin], [active], feasible
    if len(v) == 1:
        u, margin, active, feasible = interval.project_arrays(
            [ai for (ai,) in a], b, v[0], low[0], high[0], priority
        )
        return [u], list(margin), list(active), feasible
    weights = np.array(priority)

    def by_proof(parts: Sequence[np.ndarray]) -> ArrayAnswer:
        return _general("general").project_arrays(*parts, weights, solver)

    if len(v) == 2:
        u, margin, active, feasible = plane.project_arrays(a, b, v, low, high, w, by_proof)
        return list(u), list(margin), list(active), feasible
    size = len(v[0])
    table = np.array([stack(ai, size) for ai in a])
    return by_proof([table, *[stack(part, size) for part in (b, v, low, high, w)]])
