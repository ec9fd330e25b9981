"""Any number of constraints and inputs: each QP goes to the method that is exact for its size.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a_i . u + b_i >= 0,   low <= u <= high

Where the constraints cannot be met together, the answer is the least-violating action, flagged: it
minimises sum_i priority_i slack_i^2 with slack_i = max(0, -(a_i . u + b_i)), and among the
minimisers it is the one nearest to v. One constraint, one input and two inputs have exact methods
of their own, and so has a single constraint that binds; the rest goes to ProxQP, which is imported
on first use. Constraints can be met where the action that is returned meets them by the tolerance
of `safe_envs.wrappers.qp.rounding`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence

import numpy as np

from safe_envs.wrappers.qp import (
    interval,
    one_constraint,
    plane,
    plane_batch,
    single_active_constraint,
)
from safe_envs.wrappers.qp.rounding import ArrayAnswer, Arrays, Entries, FloatAnswer, Floats, stack


def prepare(k: int, m: int) -> None:
    """Import what the QPs of a size need, so that no decision waits for it.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    if k > 1 and m > 2:
        importlib.import_module("safe_envs.wrappers.qp.proxqp")


def project_floats(
    a: Sequence[Floats],
    b: Floats,
    v: Floats,
    low: Floats,
    high: Floats,
    w: Floats,
    priority: Floats,
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
    elif len(v) == 1:
        found = interval.project_floats([ai for (ai,) in a], b, v[0], low[0], high[0])
    if found:
        return found
    *parts, feasible = project_arrays(a, b, [np.array([c]) for c in v], low, high, w, priority)
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
    if len(v) == 2:
        u, margin, active, feasible = plane_batch.project_arrays(a, b, v, low, high, w, priority)
        return list(u), list(margin), list(active), feasible
    return _solver(a, b, v, low, high, w, priority)


def _solver(
    a: Sequence[Entries],
    b: Entries,
    v: Arrays,
    low: Entries,
    high: Entries,
    w: Entries,
    priority: Floats,
) -> ArrayAnswer:
    size = len(v[0])
    rows = [stack(ai, size) for ai in a]
    offsets, proposed, lower, upper = [stack(part, size) for part in (b, v, low, high)]
    # A constraint that says nothing of the input is met or not, exactly, whatever the solver's
    # precision.
    flat = np.array([(row == 0.0).all(axis=0) for row in rows])
    unmet = flat & (offsets < 0.0)
    solvable = np.where(unmet, 0.0, offsets)
    (u, margin, active, feasible), left = single_active_constraint.project_arrays(
        rows, solvable, proposed, lower, upper, w
    )
    if left.size:
        # Imported here, since few filters need a solver.
        from safe_envs.wrappers.qp import proxqp

        def of_left(part: np.ndarray) -> np.ndarray:
            return part[:, left].T

        table = np.stack([of_left(row) for row in rows], axis=1)
        found = proxqp.project(
            table,
            of_left(solvable),
            of_left(proposed),
            of_left(lower),
            of_left(upper),
            of_left(stack(w, size)),
            np.array(priority),
        )
        for whole, part in zip((u, margin, active), found[:3], strict=True):
            whole[:, left] = part.T
        feasible[left] = found.feasible
    return (
        list(u),
        list(np.where(unmet, offsets, margin)),
        list(np.where(flat, unmet, active)),
        feasible & ~unmet.any(axis=0),
    )
