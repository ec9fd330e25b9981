"""The judge of statements: branch and bound, rounded outwards.

A box is settled where the region has no state in it, or where the enclosure of the claim is at
least 0 and all that has to be smooth is. What is left is bisected, across the axis along which the
enclosures vary most. A statement is proved when no box is left. It is refuted by a state which is
certainly in the region and where the claim certainly fails.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.errors import SystemDefinitionError
from safe_envs.wrappers.verification.branch_and_bound import BranchAndBound, Budget
from safe_envs.wrappers.verification.statements import Statement

Word = Literal["proved", "refuted", "undecided"]


class JudgeResult(NamedTuple):
    """What is known of a statement.

    Attributes:
        word: "proved", "refuted" or "undecided".
        boxes: number of boxes that were looked at.
        state: where it fails, shape (n,); None unless it is refuted.
        box: where it is open, lower and upper ends, shape (2, n); None unless it is undecided.
        reason: why it is not proved, in words; empty where it is.
    """

    word: Word
    boxes: int
    state: np.ndarray | None = None
    box: np.ndarray | None = None
    reason: str = ""


class Supremum(NamedTuple):
    """Bounds of the supremum of an expression over a region.

    Attributes:
        upper: proved upper bound; infinite where none was found, -inf where the region is empty.
        lower: largest value that was certainly met; -inf where no state was.
        state: where that is, shape (n,); None where no state was met.
        boxes: number of boxes that were looked at.
        reason: why the bounds are not near each other, in words; empty where they are.
    """

    upper: float
    lower: float
    state: np.ndarray | None
    boxes: int
    reason: str = ""


def judge(
    statement: Statement, budget: Budget | None = None, hints: np.ndarray | None = None
) -> JudgeResult:
    """Decide a statement.

    Args:
        statement: to be decided.
        budget: what it may cost.
        hints: states where it may fail, shape (B, n).

    Returns:
        The verdict, which is never "proved" for a false statement.
    """
    budget = budget or Budget()
    try:
        search = BranchAndBound(statement, budget, target=0.0)
    except SystemDefinitionError as error:
        return JudgeResult("undecided", 0, reason=str(error))
    if hints is not None and search.tried(np.asarray(hints, dtype=float).T):
        return _refuted(statement, search)
    while search.open_boxes:
        reason = search.exhausted or search.settle_some()
        if search.best > 0.0:
            return _refuted(statement, search)
        if reason:
            return JudgeResult("undecided", search.boxes, box=search.widest_open, reason=reason)
    return JudgeResult("proved", search.boxes)


def supremum(
    statement: Statement,
    expression: Any,
    tolerance: float,
    budget: Budget | None = None,
    hints: np.ndarray | None = None,
) -> Supremum:
    """Bound the supremum of an expression over the region of a statement.

    Args:
        statement: whose region is taken; its claim does not matter.
        expression: of its symbols.
        tolerance: largest difference between the bounds that is wanted.
        budget: what it may cost; the upper bound is one also where it does not suffice.
        hints: states where it may be large, shape (B, n).

    Returns:
        The bounds.
    """
    budget = budget or Budget()
    try:
        search = BranchAndBound(replace(statement, claim=-sp.sympify(expression)), budget)
    except SystemDefinitionError as error:
        return Supremum(math.inf, -math.inf, None, 0, str(error))
    search.margin = tolerance
    if hints is not None:
        search.tried(np.asarray(hints, dtype=float).T)
    reason = ""
    while search.open_boxes and not reason:
        reason = search.exhausted or search.settle_some()
    return Supremum(search.upper, search.best, search.best_state, search.boxes, reason)


def _refuted(statement: Statement, search: BranchAndBound) -> JudgeResult:
    state = search.best_state if search.best_state is not None else np.zeros(0)
    values = zip(statement.states, state.tolist(), strict=True)
    at = ", ".join(f"{s} = {value:.6g}" for s, value in values)
    reason = f"{statement.name} fails at {at}, by {search.best:.3g}"
    return JudgeResult("refuted", search.boxes, state=state, reason=reason)
