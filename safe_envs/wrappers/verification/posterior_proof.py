"""What the judge proves of the numbers of a bound over a posterior."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.safety_filter import SafetyFilter
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.input_terms import exact_number
from safe_envs.wrappers.verification.judge import judge, supremum
from safe_envs.wrappers.verification.statements import Statement

_BUDGET = Budget(boxes=300_000, seconds=60.0)
_RELATIVE, _SMALL = 1e-2, 1e-4


class PosteriorNumbers(NamedTuple):
    """The numbers of a bound over a posterior that the judge proves.

    Attributes:
        supremum: proved upper bound of c; infinite without one.
        shortfall: proved upper bound of m, in the units of h per s; infinite without one.
        reason: what is not proved, in words; empty where all is.
    """

    supremum: float
    shortfall: float
    reason: str


def decision_at(robust: SafetyFilter, x: np.ndarray, rest: np.ndarray) -> FilterDecision:
    """Return what a filter of one barrier makes of an input.

    Args:
        robust: the filter.
        x: states, shape (B, n).
        rest: the input, shape (m,).

    Raises:
        NumericalError: The condition has no finite value at a state.
    """
    found = robust.filter(x, np.broadcast_to(rest, (len(x), len(rest))))
    lost = np.isinf(found.slack[:, 0])
    if lost.any():
        raise robust.undefined("the constraint", x[lost.argmax()].tolist(), [0])
    return found


def proved_numbers_of(
    problem: SafetyProblem, robust: SafetyFilter, barrier: sp.Expr, found: tuple[float, float]
) -> PosteriorNumbers:
    """Prove upper bounds of c and m over the safe set within the workspace.

    The input of the filter at the middle of a box is a witness: where it misses the condition by
    at most m on the whole box, so does the filter, whose own input misses it by the least.

    Args:
        problem: whose workspace and input bounds are taken.
        robust: filter with the robust condition.
        barrier: h, with numbers for all parameters.
        found: c and m of a search.

    Returns:
        The numbers, or what is not proved.
    """
    row, inputs = robust.constraints[0], robust.model.inputs
    if row.uncertainty is None or row.terms is not None or row.change is not None:
        return PosteriorNumbers(
            math.inf, math.inf, "the robust condition has no interval form for the judge"
        )
    box = tuple((exact_number(v.low), exact_number(v.high)) for v in problem.states)
    vector: tuple[Any, ...] = (sp.Integer(1), *inputs)
    pairs = itertools.combinations_with_replacement(range(len(vector)), 2)
    spread: Any = sum(
        q * vector[i] * vector[j] * (1 if i == j else 2)
        for q, (i, j) in zip(row.uncertainty, pairs, strict=True)
    )
    rate: Any = sum(a * u for a, u in zip(row.coefficient, inputs, strict=True)) + row.offset
    numeric = robust.model.numeric
    missed = numeric(sp.sqrt(sp.Max(spread, 0)) - rate)
    low, high = np.array(problem.box).T
    rest = (low + high) / 2.0

    def witness(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            chosen = decision_at(robust, x, rest).action
        return np.clip(np.nan_to_num(chosen), low, high)

    region = Statement("C", problem.plant.states, box, sp.Integer(1), positive=(barrier,))
    smooth = judge(replace(region, name="h on C", smooth=(barrier,)), _BUDGET)
    c, m = found
    top = supremum(region, barrier, 1e-3 * c, _BUDGET)
    tolerance = max(_RELATIVE * m, _SMALL * c / problem.duration)
    lack = supremum(replace(region, witnesses=inputs, witness=witness), missed, tolerance, _BUDGET)
    reasons = [smooth.reason]
    reasons += [bound.reason for bound in (top, lack) if not math.isfinite(bound.upper)]
    return PosteriorNumbers(
        max(top.upper, 0.0), max(lack.upper, 0.0), next(filter(None, reasons), "")
    )
