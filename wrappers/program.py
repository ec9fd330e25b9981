"""The quadratic program of a filter: its rows compiled from the conditions, and solved for a state or a batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.clf import CLF
from safe_envs.codegen import Components, Flavour, compile_function, constants, finite
from safe_envs.errors import ConfigurationError
from safe_envs.sde import ControlAffineSDE
from wrappers.conditions import AffineConstraint
from wrappers.qp import one_row, several_rows

_LEAST_SCALE = 1e-100
"""A slack scaled by less would have a weight that vanishes."""


class Decision(NamedTuple):
    """What the thin wrappers read, by components: floats, or arrays over the batch.

    Attributes:
        action: m components of the executed input.
        margin: of each row at the action.
        active: whether each row binds or cannot be met.
        feasible: whether the rows can be met together.
        slack: by how much each row is missed where they cannot.
        cause: index of the active row that lies furthest from the proposed input, -1 if no row is active.
    """

    action: Sequence[Any]
    margin: Sequence[Any]
    active: Sequence[Any]
    feasible: Any
    slack: Sequence[Any]
    cause: Any


class UndefinedRowError(ArithmeticError):
    """A row has no finite value.

    Attributes:
        index: of the state in the batch.
    """

    def __init__(self, index: int) -> None:
        super().__init__(index)
        self.index = index


@dataclass(frozen=True)
class Program:
    """Minimise over the box, subject to the rows; see `wrappers.safety_filter.SafetyFilter`."""

    model: ControlAffineSDE
    constraints: tuple[AffineConstraint, ...]
    low: list[float]
    high: list[float]
    weights: list[float]
    priorities: list[float]
    dt: float
    clf: CLF | None

    @property
    def plain(self) -> bool:
        """Whether the rows are all there is: no demand of a reciprocal condition, no sampling margin, no goal."""
        return self.clf is None and all(c.demand is None and c.change is None for c in self.constraints)


class Solver:
    """Solves a program for states given component by component, as floats or as arrays of a batch.

    The formulas are the same for both flavours; only the choice between two values and the QP differ.
    """

    def __init__(self, program: Program, flavour: Flavour) -> None:
        self._program = program
        self._flavour: Flavour = flavour
        self._m = program.model.m
        self._count = len(program.constraints)
        self._reciprocal = [i for i, c in enumerate(program.constraints) if c.demand is not None]
        self._sampled = [i for i, c in enumerate(program.constraints) if c.change is not None]
        arrays = flavour == "arrays"
        self._low: Sequence[Any] = constants(program.low) if arrays else program.low
        self._high: Sequence[Any] = constants(program.high) if arrays else program.high
        self._weights = program.weights
        self._choose: Any = np.where if arrays else _choose
        self._larger: Any = np.maximum if arrays else max
        self._project: Any = several_rows.project_arrays if arrays else several_rows.project_floats
        if program.clf is not None:
            input_weight, self._slack_weight = [
                float(program.model.numeric(sp.sympify(w))) for w in (program.clf.input_weight, program.clf.slack_weight)
            ]
            if not (0 < input_weight < math.inf and 0 < self._slack_weight < math.inf):
                raise ConfigurationError(
                    f"the goal weighs inputs by {input_weight} and slack by {self._slack_weight}; give positive numbers"
                )
            self._weights = [input_weight] * self._m

    def one_row(self, x: Sequence[Any], u: Sequence[Any]) -> Decision:
        """Solve a plain program of one row; raises as `solve`."""
        *a, b = self._rows(*x)
        p = self._program
        if self._flavour == "floats":
            action, margin, active, feasible = one_row.project_floats(a, b, u, p.low, p.high, p.weights)
            self._require_finite((margin,))
            return Decision(action, (margin,), (active,), feasible, (0.0 if feasible else -margin,), 0)
        action, margin, active, feasible = one_row.project_arrays(a, b, u, self._low, self._high, p.weights)
        self._require_finite((margin,))
        met = np.count_nonzero(feasible) == len(feasible)
        slack = np.zeros(len(margin)) if met else np.where(feasible, 0.0, -margin)
        return Decision(action, (margin,), (active,), feasible, (slack,), 0)

    def solve(self, x: Sequence[Any], u: Sequence[Any]) -> Decision:
        """Solve any program.

        Raises:
            UndefinedRowError: a row has no finite value.
        """
        a, b, goal, h = self._split(self._rows(*x))
        asked, inside = list(b), {}
        for i, value in zip(self._reciprocal, h, strict=True):
            inside[i] = value > 0.0
            asked[i] = self._ask(i, x, a[i], b[i], inside[i])
        self._require_finite([*asked, *[aj for ai in a for aj in ai], *goal])
        action, margin, active, feasible = self._minimise(a, asked, u, goal)
        if self._sampled:
            for i, change in zip(self._sampled, self._changes(*x, *action), strict=True):
                loss = self._program.dt * -self._larger(-change, 0.0)
                asked[i] = asked[i] + (self._choose(inside[i], loss, 0.0) if i in inside else loss)
            self._require_finite(asked)
            action, margin, active, feasible = self._minimise(a, asked, u, goal)
        for i, defined in inside.items():
            margin[i] = self._choose(defined, margin[i], _dot(a[i], action) + b[i])
            feasible = feasible & defined
            active[i] = active[i] | ~defined if self._flavour == "arrays" else active[i] or not defined
        slack = [self._choose(feasible, 0.0, self._larger(-value, 0.0)) for value in margin]
        return Decision(action, margin, active, feasible, slack, self._cause(a, asked, u, active))

    def _require_finite(self, values: Sequence[Any]) -> None:
        total: Any = sum(values)
        if self._flavour == "floats":
            if not math.isfinite(total):
                raise UndefinedRowError(0)
        elif not finite(total):
            bad = np.flatnonzero(~np.isfinite(total))
            if bad.size:
                raise UndefinedRowError(int(bad[0]))

    def _split(self, values: Components) -> tuple[list[Any], Sequence[Any], Sequence[Any], Sequence[Any]]:
        """The rows' a and b, the goal's offset and coefficients, and h of the reciprocal conditions."""
        width, count = self._m + 1, self._count
        rows = [values[i * width : (i + 1) * width] for i in range(count)]
        rest = values[count * width :]
        goal = rest[: len(rest) - len(self._reciprocal)]
        return [row[:-1] for row in rows], [row[-1] for row in rows], goal, rest[len(goal) :]

    def _ask(self, i: int, x: Sequence[Any], a: Sequence[Any], b: Any, inside: Any) -> Any:
        """Offset of a reciprocal row: less its demand inside C, and outside such that it asks for the largest a u."""
        most = -sum([self._larger(aj * lo, aj * hi) for aj, lo, hi in zip(a, self._low, self._high, strict=True)])
        if self._flavour == "floats" and not inside:
            return most
        return self._choose(inside, b - self._demands[i](*x)[0], most)

    def _minimise(self, a: Sequence[Any], b: Sequence[Any], u: Sequence[Any], goal: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
        p = self._program
        if not goal:
            return self._project(a, b, u, self._low, self._high, self._weights, p.priorities)
        # The goal's slack d = D e, with D the most that the box can make it, so that e in [0, 1] always meets the goal's row.
        growth, along = goal[0], goal[1:]
        most = growth + sum([self._larger(bj * lo, bj * hi) for bj, lo, hi in zip(along, self._low, self._high, strict=True)])
        scale = self._choose(most > _LEAST_SCALE, most, 1.0)
        rows = [*[(*ai, 0.0) for ai in a], (*[-bj for bj in along], scale)]
        nothing = 0.0 * u[0]
        low, high, w = (*self._low, 0.0), (*self._high, 1.0), (*self._weights, self._slack_weight * scale * scale)
        action, margin, active, feasible = self._project(rows, [*b, -growth], (*u, nothing), low, high, w, [*p.priorities, 1.0])
        return action[: self._m], margin[: self._count], active[: self._count], feasible

    def _cause(self, a: Sequence[Any], b: Sequence[Any], u: Sequence[Any], active: Sequence[Any]) -> Any:
        """The active row whose half-space is furthest from the proposed input."""
        cause, furthest = -1, -math.inf
        if self._count == 1:
            return self._choose(active[0], 0, -1)
        for i, (ai, bi, acts) in enumerate(zip(a, b, active, strict=True)):
            square = sum([aj * aj / wj for aj, wj in zip(ai, self._weights, strict=True)])
            some = self._choose(square > 0.0, square, 1.0)
            distance = self._choose(acts & (square > 0.0), -(_dot(ai, u) + bi) / some**0.5, -math.inf)
            cause = self._choose(distance > furthest, i, cause)
            furthest = self._larger(furthest, distance)
        return cause

    @cached_property
    def _rows(self) -> Any:
        """a_1, ..., a_m, b of each row, then the goal's offset and coefficients, then h of the reciprocal conditions."""
        p = self._program
        expressions = [e for c in p.constraints for e in (*c.coefficient, c.offset)]
        if p.clf is not None:
            growth, along = p.clf.growth(p.model)
            expressions += [growth, *along]
        return self._compiled([*expressions, *(p.constraints[i].chain[0] for i in self._reciprocal)])

    @cached_property
    def _demands(self) -> dict[int, Any]:
        """By themselves, since plain floats allow no division by h = 0 and no logarithm of a negative one."""
        return {i: self._compiled([self._program.constraints[i].demand]) for i in self._reciprocal}

    @cached_property
    def _changes(self) -> Any:
        return self._compiled([self._program.constraints[i].change for i in self._sampled], self._program.model.inputs)

    def _compiled(self, expressions: Sequence[Any], more: Sequence[sp.Symbol] = ()) -> Any:
        model = self._program.model
        return compile_function((*model.states, *more), [model.numeric(e) for e in expressions], self._flavour)


def _choose(condition: bool, chosen: Any, other: Any) -> Any:
    return chosen if condition else other


def _dot(a: Sequence[Any], u: Sequence[Any]) -> Any:
    return sum([aj * uj for aj, uj in zip(a, u, strict=True)])
