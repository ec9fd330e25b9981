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
from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.conditions.base import Condition
from safe_envs.wrappers.conditions.parts import with_parts

_SINGLE = 2.0**-23
"""Of a number: rounding of observations and actions to single precision, with room."""

_EXECUTED = 1e-6
"""Of the width of the input bounds: rounding of actions and of the filter."""

POLICIES = ("any", "nominal", "zero")

Ends = tuple[np.ndarray, np.ndarray]


class ExecutedInputs:
    """Which inputs a policy under a filter may execute, from boxes of the plant's states.

    Args:
        problem: with one input.
        condition: of the filter, on a problem with one barrier; None without a filter.
        policy: "any", "nominal" for the problem's own controller, or "zero".
        knowledge: of the filter, "model" or "plant".

    Attributes:
        described: all that determines the inputs, as JSON-able data.

    Raises:
        ConfigurationError: Such a closed loop is not bounded.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        condition: Condition | None,
        policy: str,
        knowledge: str = "model",
    ) -> None:
        if policy not in POLICIES:
            raise ConfigurationError(f"policy = {policy!r}; allowed: {', '.join(POLICIES)}")
        require_one_input(problem)
        self._low, self._high = map(float, problem.box[0])
        states = problem.plant.states
        self._law = self._features = self._constraint = None
        law, features, constraint = [], [], []
        if policy != "any":
            given = problem.nominal[0] if policy == "nominal" else 0
            law = _known([problem.model.numeric(sp.sympify(given))])
            features = _known([f.expression for f in problem.features])
            self._features = interval_function(states, features)
            self._law = interval_function([f.symbol for f in problem.features], law)
        if condition is not None:
            constraint = _constraint(problem, condition, knowledge)
            self._constraint = interval_function(states, constraint)
        self.described = [
            [list(map(sp.srepr, each)) for each in (states, features, law, constraint)],
            [sp.srepr(f.symbol) for f in problem.features],
            [self._low, self._high, _SINGLE, _EXECUTED],
        ]

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


def require_one_input(problem: SafetyProblem) -> None:
    """Check that what a filter executes in a problem is known here; raise ConfigurationError."""
    if len(problem.inputs) != 1:
        raise ConfigurationError(
            f"{problem.name} has {len(problem.inputs)} inputs; closed loops of one are bounded"
        )


def _constraint(problem: SafetyProblem, condition: Condition, knowledge: str) -> list[sp.Expr]:
    """Return a and b of the constraint a u + b >= 0."""
    if len(problem.barriers) == 1:
        problem, _ = with_parts(problem, (condition,))
    if len(problem.barriers) != 1:
        raise ConfigurationError(
            f"{problem.name} has {len(problem.barriers)} barriers; closed loops with one are"
            " bounded"
        )
    if condition.corrects_model:
        raise ConfigurationError(f"{condition.name} is learned; conditions of formulas are bounded")
    system = problem.plant if knowledge == "plant" else problem.model
    found = condition.constraint(system, problem.barriers[0])
    parts = (found.demand, found.change, found.uncertainty, found.terms)
    if found.domain or found.alternatives or any(part is not None for part in parts):
        raise ConfigurationError(
            f"the constraint of {condition.name} is not of the form a u + b >= 0 with known a and"
            " b, or has a margin of first order; its closed loop is not bounded"
        )
    return _known([system.numeric(e) for e in (found.coefficient[0], found.offset)])


def _known(expressions: Sequence[sp.Expr]) -> list[sp.Expr]:
    found = [sp.sympify(e) for e in expressions]
    if any(TIME in e.free_symbols for e in found):
        raise ConfigurationError("a controller that depends on the time is not bounded")
    return found
