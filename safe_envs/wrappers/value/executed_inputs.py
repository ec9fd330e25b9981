"""Intervals that hold the input which a filter executes anywhere in a box of states.

With one input and one constraint a u + b >= 0 the filter executes the input of the bounds next to
the proposed one that meets it, or, where none does, the one that comes closest. With t = -b/a that
is max(u, t) for a > 0 and min(u, t) for a < 0, cut to the bounds. Both are monotone in u and in t,
so that their ends on a box come from the ends of u and of t.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from safe_envs.dynamics.interval_arithmetic import IntervalArithmetic, negative
from safe_envs.dynamics.intervals import Interval, IntervalFunction, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.conditions.base import Condition

_SINGLE = 2.0**-23
"""Of a number: rounding of observations and actions to single precision, with room."""

_EXECUTED = 1e-6
"""Of the width of the input bounds: rounding of actions and of the filter."""

Ends = tuple[np.ndarray, np.ndarray]


class ExecutedInputs:
    """Which inputs a policy under a filter may execute, from boxes of the plant's states.

    Args:
        problem: with one input.
        condition: of the filter, on a problem with one barrier; None without a filter.
        policy: "any", or "nominal" for the problem's own controller.

    Raises:
        ConfigurationError: Such a closed loop is not bounded.
    """

    def __init__(self, problem: SafetyProblem, condition: Condition | None, policy: str) -> None:
        if policy not in ("any", "nominal"):
            raise ConfigurationError(f"policy = {policy!r}; allowed: any, nominal")
        if len(problem.inputs) != 1:
            raise ConfigurationError(
                f"{problem.name} has {len(problem.inputs)} inputs; closed loops of one are bounded"
            )
        self._low, self._high = map(float, problem.box[0])
        self._law = self._features = self._constraint = None
        if policy == "nominal":
            law = problem.model.numeric(problem.nominal[0])
            self._features = interval_function(
                problem.plant.states, _known([f.expression for f in problem.features])
            )
            self._law = interval_function([f.symbol for f in problem.features], _known([law]))
        if condition is not None:
            self._constraint = _constraint(problem, condition)

    def of_boxes(self, low: Sequence[np.ndarray], high: Sequence[np.ndarray]) -> Ends:
        """Return the ends of the executed inputs, arrays (B,).

        Args:
            low: least states, n arrays (B,).
            high: largest states.
        """
        boxes = [Interval(a, b) for a, b in zip(low, high, strict=True)]
        first, last = np.full(len(low[0]), self._low), np.full(len(low[0]), self._high)
        if self._law is not None and self._features is not None:
            seen = [
                Interval(f.low - _SINGLE * np.abs(f.low), f.high + _SINGLE * np.abs(f.high))
                for f in self._features(boxes)
            ]
            proposed = self._law(seen)[0]
            first = self._cut(first * 0.0 + proposed.low)
            last = self._cut(last * 0.0 + proposed.high)
        if self._constraint is not None:
            first, last = self._filtered(first, last, *self._constraint(boxes))
        slack = _EXECUTED * (self._high - self._low)
        return self._cut(first - slack), self._cut(last + slack)

    def _cut(self, values: np.ndarray) -> np.ndarray:
        return np.clip(values, self._low, self._high)

    def _filtered(self, first: np.ndarray, last: np.ndarray, a: Interval, b: Interval) -> Ends:
        ops = IntervalArithmetic()
        zero = np.zeros(len(first))
        a, b = (Interval(zero + c.low, zero + c.high) for c in (a, b))
        with np.errstate(all="ignore"):
            edge = ops.multiply(negative(b), ops.reciprocal(a))
            met = ops.add(ops.multiply(a, Interval(first, last)), b).low >= 0.0
        rising = self._cut(np.maximum(first, edge.low)), self._cut(np.maximum(last, edge.high))
        falling = self._cut(np.minimum(first, edge.low)), self._cut(np.minimum(last, edge.high))
        found = [np.full(len(first), end) for end in (self._low, self._high)]
        for i in range(2):
            # What comes last takes precedence: an input that meets the constraint is kept.
            found[i] = np.where(a.low > 0.0, rising[i], found[i])
            found[i] = np.where(a.high < 0.0, falling[i], found[i])
            found[i] = np.where(met, (first, last)[i], found[i])
        return found[0], found[1]


def _constraint(problem: SafetyProblem, condition: Condition) -> IntervalFunction:
    if len(problem.barriers) != 1:
        raise ConfigurationError(
            f"{problem.name} has {len(problem.barriers)} barriers; closed loops with one are"
            " bounded"
        )
    found = condition.constraint(problem.model, problem.barriers[0])
    parts = (found.demand, found.change, found.uncertainty, found.terms)
    if any(part is not None for part in parts):
        raise ConfigurationError(
            f"the constraint of {condition.name} is not of the form a u + b >= 0 with known a and"
            " b, or has a margin of first order; its closed loop is not bounded"
        )
    known = [problem.model.numeric(e) for e in (found.coefficient[0], found.offset)]
    return interval_function(problem.plant.states, _known(known))


def _known(expressions: Sequence[sp.Expr]) -> list[sp.Expr]:
    found = [sp.sympify(e) for e in expressions]
    if any(TIME in e.free_symbols for e in found):
        raise ConfigurationError("a controller that depends on the time is not bounded")
    return found
