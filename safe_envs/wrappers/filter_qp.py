"""The quadratic program of a filter: its rows compiled from the conditions, and solved for a state
or a batch."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, constants, finite
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.clf import CLF
from safe_envs.wrappers.conditions import AffineConstraint
from safe_envs.wrappers.conditions.constraint import Terms
from safe_envs.wrappers.qp import dispatch, one_row, second_order_row
from safe_envs.wrappers.qp.rows import ROUNDING, tolerance, tolerances

_FAR = 1e4
"""How many times further than the box reaches is far away."""


class Decision(NamedTuple):
    """What the thin wrappers read, by components: floats, or arrays over the batch.

    Attributes:
        action: m components of the executed input.
        margin: of each row at the action.
        active: whether each row binds or cannot be met.
        feasible: whether the rows can be met together.
        slack: by how much each row is missed where they cannot.
        cause: index of the active row that lies furthest from the proposed input; means something
            where a row is active.
        proposed: the input that the rows changed: the given one, or with a goal that which is best
            without rows.
    """

    action: Sequence[Any]
    margin: Sequence[Any]
    active: Sequence[Any]
    feasible: Any
    slack: Sequence[Any]
    cause: Any
    proposed: Sequence[Any]


class UndefinedRowError(ArithmeticError):
    """A row has no finite value.

    Attributes:
        index: of the state in the batch.
        what: the constraint or the goal.
    """

    def __init__(self, index: int, what: str) -> None:
        super().__init__(index, what)
        self.index, self.what = index, what


@dataclass(frozen=True)
class Program:
    """Minimise over the box, subject to the rows; see
    `safe_envs.wrappers.safety_filter.SafetyFilter`."""

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
        """Whether the rows are all there is: no demand of a reciprocal condition, no margin, no
        goal; uncertain only for one input."""
        return self.clf is None and all(
            c.demand is None and c.change is None and (c.uncertainty is None or self.model.m == 1)
            for c in self.constraints
        )

    @property
    def terms(self) -> list[Terms]:
        """The learned terms of the rows, each once."""
        return list(
            {id(c.terms): c.terms for c in self.constraints if c.terms is not None}.values()
        )


class Solver:
    """Solves a program for states given component by component, as floats or as arrays of a batch.

    The formulas are the same for both flavours; only the choice between two values and the QP
    differ.
    """

    def __init__(self, program: Program, flavour: Flavour) -> None:
        self._program = program
        self._flavour: Flavour = flavour
        self._m = program.model.m
        self._count = len(program.constraints)
        self._reciprocal = [i for i, c in enumerate(program.constraints) if c.demand is not None]
        self._sampled = [i for i, c in enumerate(program.constraints) if c.change is not None]
        self._uncertain = [
            i for i, c in enumerate(program.constraints) if c.uncertainty is not None
        ]
        arrays = flavour == "arrays"
        self._terms = [term.arrays if arrays else term.floats for term in program.terms]
        self._symbols = (
            *program.model.states,
            *(s for term in program.terms for s in term.symbols),
        )
        self._low: Sequence[Any] = constants(program.low) if arrays else program.low
        self._high: Sequence[Any] = constants(program.high) if arrays else program.high
        self._weights = program.weights
        self._choose: Any = np.where if arrays else _choose
        self._larger: Any = np.maximum if arrays else max
        self._tolerance: Any = tolerances if arrays else tolerance
        self._project: Any = dispatch.project_arrays if arrays else dispatch.project_floats
        if program.clf is not None:
            program.clf.require_known(program.model)
            weights = (program.clf.input_weight, program.clf.slack_weight)
            input_weight, self._slack_weight = [float(program.model.numeric(w)) for w in weights]
            if not (0 < input_weight < math.inf and 0 < self._slack_weight < math.inf):
                raise ConfigurationError(
                    f"the goal weighs inputs by {input_weight} and slack by {self._slack_weight};"
                    " give positive numbers"
                )
            self._weights = [input_weight] * self._m

    def one_row(self, x: Sequence[Any], u: Sequence[Any]) -> Decision:
        """Solve a plain program of one row; raises as `solve`."""
        values = self._rows(*self._with_terms(x))
        if self._uncertain:
            return self._one_uncertain_row(values, u)
        *a, b = values
        p = self._program
        if self._flavour == "floats":
            action, margin, active, feasible = one_row.project_floats(
                a, b, u, p.low, p.high, p.weights
            )
            self._require_finite((margin,))
            return Decision(
                action, (margin,), (active,), feasible, (0.0 if feasible else -margin,), 0, u
            )
        action, margin, active, feasible = one_row.project_arrays(
            a, b, u, self._low, self._high, p.weights
        )
        self._require_finite((margin,))
        met = np.count_nonzero(feasible) == len(feasible)
        slack = np.zeros(len(margin)) if met else np.where(feasible, 0.0, -margin)
        return Decision(action, (margin,), (active,), feasible, (slack,), 0, u)

    def _one_uncertain_row(self, values: Components, u: Sequence[Any]) -> Decision:
        a, b, *form = values
        p = self._program
        project = (
            second_order_row.project_floats
            if self._flavour == "floats"
            else second_order_row.project_arrays
        )
        action, margin, active, feasible = project(
            (a,), (b,), (form,), u[0], p.low[0], p.high[0], p.priorities
        )
        self._require_finite((margin[0], *form))
        return Decision(
            (action,),
            tuple(margin),
            tuple(active),
            feasible,
            (self._choose(feasible, 0.0, -margin[0]),),
            0,
            u,
        )

    def solve(self, x: Sequence[Any], u: Sequence[Any]) -> Decision:
        """Solve any program.

        Raises:
            UndefinedRowError: a row or the goal has no finite value.
        """
        x = self._with_terms(x)
        a, b, goal, h, forms = self._split(self._rows(*x))
        target = u
        if goal:
            target = [0.0 * uj for uj in u]
            u = self._best(goal, target)
        inside = dict(zip(self._reciprocal, [value > 0.0 for value in h], strict=True))
        self._require_finite([*b, *[aj for ai in a for aj in ai]])
        asked = [
            (
                self._choose(inside[i], b[i] - self._demand(i, x, inside[i]), 0.0)
                if i in inside
                else b[i]
            )
            for i in range(self._count)
        ]
        held = [
            [self._choose(inside[i], aj, 0.0) for aj in a[i]] if i in inside else a[i]
            for i in range(self._count)
        ]
        aim = self._outwards(a, inside, target)
        action, margin, active, feasible = self._minimise(held, asked, aim, goal, forms)
        if self._sampled:
            for i in self._sampled:
                asked[i] = asked[i] - self._program.dt * self._loss(i, x, action, inside.get(i))
            action, margin, active, feasible = self._minimise(held, asked, aim, goal, forms)
        for i, defined in inside.items():
            margin[i] = self._choose(defined, margin[i], _dot(a[i], action) + b[i])
            active[i] = self._choose(defined, active[i], True)
            feasible = feasible & defined
        # A demand or a loss without a value shows here, and so does what overflows on the way to
        # the action.
        self._require_finite([*action, *margin])
        slack = [self._choose(feasible, 0.0, self._larger(-value, 0.0)) for value in margin]
        return Decision(
            action, margin, active, feasible, slack, self._cause(a, asked, u, active, inside), u
        )

    def best(self, x: Sequence[Any], nothing: Sequence[Any]) -> Sequence[Any]:
        """The input that is best for the goal, without rows; `nothing` is the input 0. Raises as
        `solve`."""
        return self._best(self._split(self._rows(*self._with_terms(x)))[2], nothing)

    def _with_terms(self, x: Sequence[Any]) -> Sequence[Any]:
        """The state, and after it what the learned terms are there."""
        return (
            (*x, *[value for term in self._terms for value in term(tuple(x))]) if self._terms else x
        )

    def _best(self, goal: Sequence[Any], nothing: Sequence[Any]) -> Sequence[Any]:
        self._require_finite(goal, "the goal")
        return self._minimise((), (), nothing, goal)[0]

    def _require_finite(self, values: Sequence[Any], what: str = "the constraint") -> None:
        total: Any = sum(values)
        if self._flavour == "floats":
            if not math.isfinite(total):
                raise UndefinedRowError(0, what)
        elif not finite(np.atleast_1d(total)):
            bad = np.flatnonzero(~np.isfinite(total))
            if bad.size:
                raise UndefinedRowError(int(bad[0]), what)

    def _split(
        self, values: Components
    ) -> tuple[list[Any], list[Any], Sequence[Any], Sequence[Any], dict[int, Components]]:
        """The rows' a and b, the goal's offset and coefficients, h of reciprocal conditions less
        its rounding, Q of uncertain rows."""
        width, count, entries = self._m + 1, self._count, (self._m + 1) * (self._m + 2) // 2
        rows = [values[i * width : (i + 1) * width] for i in range(count)]
        forms_at = len(values) - entries * len(self._uncertain)
        goal_end = forms_at - len(self._reciprocal)
        forms = {
            i: values[forms_at + k * entries : forms_at + (k + 1) * entries]
            for k, i in enumerate(self._uncertain)
        }
        goal, h = values[count * width : goal_end], values[goal_end:forms_at]
        return [row[:-1] for row in rows], [row[-1] for row in rows], goal, h, forms

    def _demand(self, i: int, x: Sequence[Any], inside: Any) -> Any:
        """What a reciprocal row asks for, where it means something; plain floats have no 1/h or
        logarithm elsewhere."""
        return 0.0 if inside is False else self._demands[i](*x)[0]

    def _loss(self, i: int, x: Sequence[Any], action: Sequence[Any], inside: Any) -> Any:
        """Rate at which a row falls under an action, 0 where it rises or means nothing."""
        if inside is False:
            return 0.0
        loss = self._larger(-self._changes[i](*x, *action)[0], 0.0)
        return loss if inside is None else self._choose(inside, loss, 0.0)

    def _outwards(
        self, a: Sequence[Any], inside: dict[int, Any], u: Sequence[Any]
    ) -> Sequence[Any]:
        """The proposed input, and far away where h of a reciprocal condition rises most, if that is
        not positive.

        The point of the box and of the rows nearest to one so far off is where h rises most among
        those that the other rows allow: these are not to suffer from a condition that means
        nothing.
        """
        if all(
            defined is True or (defined is not False and defined.all())
            for defined in inside.values()
        ):
            return u
        rise = [0.0] * self._m
        for i, defined in inside.items():
            rise = [
                rj + self._choose(defined, 0.0, aj)
                for rj, aj in zip(rise, self._over_largest(a[i]), strict=True)
            ]
        rise = self._over_largest(rise)
        steepness = sum([rj * rj / wj for rj, wj in zip(rise, self._weights, strict=True)])
        ends = list(zip(self._low, self._high, strict=True))
        span = sum([abs(rj) * (hi - lo) for rj, (lo, hi) in zip(rise, ends, strict=True)])
        far = _FAR * span / self._choose(steepness > 0.0, steepness, 1.0)
        corner = [
            self._choose(rj > 0.0, hi, self._choose(rj < 0.0, lo, uj))
            for rj, (lo, hi), uj in zip(rise, ends, u, strict=True)
        ]
        return [c + far * rj / wj for c, rj, wj in zip(corner, rise, self._weights, strict=True)]

    def _over_largest(self, entries: Sequence[Any]) -> list[Any]:
        """Entries over the largest of their sizes, whose inverse may overflow."""
        size = functools.reduce(self._larger, [abs(entry) for entry in entries])
        return [entry / self._choose(size > 0.0, size, 1.0) for entry in entries]

    def _minimise(
        self,
        a: Sequence[Any],
        b: Sequence[Any],
        u: Sequence[Any],
        goal: Sequence[Any],
        forms: dict[int, Components] | None = None,
    ) -> tuple[Any, Any, Any, Any]:
        p = self._program
        if forms:
            for form in forms.values():
                self._require_finite(form)
            if self._m == 1 and not goal:
                q = [forms.get(i, (0.0, 0.0, 0.0)) for i in range(self._count)]
                project = (
                    second_order_row.project_arrays
                    if self._flavour == "arrays"
                    else second_order_row.project_floats
                )
                action, margin, active, feasible = project(
                    [ai[0] for ai in a], b, q, u[0], p.low[0], p.high[0], p.priorities
                )
                return [action], list(margin), list(active), feasible
            a, b = self._on_the_safe_side(a, b, forms)
        if not goal:
            return self._project(a, b, u, self._low, self._high, self._weights, p.priorities)
        # The goal's slack d = unit e, in a unit in which it weighs as much as an input: its square
        # would overflow before d does. Twice the most that the box can make d always meets the
        # goal's row, also after rounding.
        growth, along = goal[0], goal[1:]
        most = growth + sum(
            [
                self._larger(bj * lo, bj * hi)
                for bj, lo, hi in zip(along, self._low, self._high, strict=True)
            ]
        )
        unit = math.sqrt(self._weights[0] / self._slack_weight)
        rows = [*[(*ai, 0.0) for ai in a], (*[-bj for bj in along], unit)]
        low, high = (
            (*self._low, 0.0),
            (*self._high, self._choose(most > 0.0, 2.0 * most / unit, 1.0)),
        )
        w = (*self._weights, self._weights[0])
        priorities = [*p.priorities[: len(a)], 1.0]
        action, margin, active, _ = self._project(
            rows, [*b, -growth], (*u, 0.0 * u[0]), low, high, w, priorities
        )
        action, margin, active = action[: self._m], margin[: len(a)], active[: len(a)]
        # The goal's row, which can always be met, has no say in that, nor has its rounding.
        feasible: Any = True
        for ai, bi, g in zip(a, b, margin, strict=True):
            feasible = feasible & (g >= -self._tolerance(ai, bi, action))
        return action, margin, active, feasible

    def _on_the_safe_side(
        self, a: Sequence[Any], b: Sequence[Any], forms: dict[int, Components]
    ) -> tuple[list[Any], list[Any]]:
        """Affine rows that are met only where the uncertain ones are, in the box."""
        a, b = list(a), list(b)
        for i, form in forms.items():
            slopes, constant = self._planes[i] if i in self._planes else self._plane(form)
            a[i] = [aj - cj for aj, cj in zip(a[i], slopes, strict=True)]
            b[i] = b[i] - constant
        return a, b

    def _plane(self, form: Components) -> tuple[list[Any], Any]:
        """What `safe_envs.wrappers.qp.second_order_row.majorant` puts above the uncertainty of a
        row."""
        width = self._m + 1
        place = {
            pair: k
            for k, pair in enumerate(itertools.combinations_with_replacement(range(width), 2))
        }
        q = [[form[place[min(j, k), max(j, k)]] for k in range(width)] for j in range(width)]
        return second_order_row.majorant(q, self._program.low, self._program.high)

    @cached_property
    def _planes(self) -> dict[int, tuple[list[Any], Any]]:
        """Those that are the same at every state."""
        forms = {i: self._program.constraints[i].uncertainty or () for i in self._uncertain}
        return {
            i: self._plane(tuple(map(float, form)))
            for i, form in forms.items()
            if all(e.is_number for e in form)
        }

    def _cause(
        self,
        a: Sequence[Any],
        b: Sequence[Any],
        u: Sequence[Any],
        active: Sequence[Any],
        inside: dict[int, Any],
    ) -> Any:
        """The active row whose half-space is furthest from the proposed input; one that means
        nothing is further than any."""
        cause, furthest = -1, -math.inf
        for i, (ai, bi, acts) in enumerate(zip(a, b, active, strict=True)):
            if acts is False or (acts is not True and not np.count_nonzero(acts)):
                continue
            size = functools.reduce(self._larger, [abs(aj) for aj in ai])
            unit = self._choose(
                size > 0.0, size, 1.0
            )  # so that squares neither overflow nor vanish
            square = sum(
                [p * p / wj for p, wj in zip([aj / unit for aj in ai], self._weights, strict=True)]
            )
            distance = -(_dot(ai, u) + bi) / unit / self._choose(size > 0.0, square, 1.0) ** 0.5
            if i in inside:
                distance = self._choose(inside[i], distance, math.inf)
            distance = self._choose(acts & (size > 0.0), distance, -math.inf)
            cause = self._choose(distance > furthest, i, cause)
            furthest = self._larger(furthest, distance)
        return cause

    @cached_property
    def _rows(self) -> Any:
        """What `_split` takes apart again."""
        p = self._program
        expressions = [e for c in p.constraints for e in (*c.coefficient, c.offset)]
        if p.clf is not None:
            growth, along = p.clf.growth(p.model)
            expressions += [growth, *along]
        expressions += [_beyond_rounding(p.constraints[i].chain[0]) for i in self._reciprocal]
        return self._compiled(
            [
                *expressions,
                *(e for i in self._uncertain for e in p.constraints[i].uncertainty or ()),
            ]
        )

    @cached_property
    def _demands(self) -> dict[int, Any]:
        return {i: self._compiled([self._program.constraints[i].demand]) for i in self._reciprocal}

    @cached_property
    def _changes(self) -> dict[int, Any]:
        return {
            i: self._compiled([self._program.constraints[i].change], self._program.model.inputs)
            for i in self._sampled
        }

    def _compiled(self, expressions: Sequence[Any], more: Sequence[sp.Symbol] = ()) -> Any:
        model = self._program.model
        return compile_function(
            (*self._symbols, *more), [model.numeric(e) for e in expressions], self._flavour
        )


def _beyond_rounding(h: sp.Expr) -> sp.Expr:
    """What h is more than its own rounding: where that is not positive, a state and a batch may
    find h on either side of 0."""
    return h - sp.Float(ROUNDING, 17) * _size(h)


def _size(expression: sp.Expr) -> sp.Expr:
    """The sum of the sizes of an expression's terms."""
    parts: Any = expression.args
    if expression.is_Add or expression.is_Mul:
        return expression.func(*map(_size, parts))
    if isinstance(expression, sp.Max | sp.Min):
        return sp.Max(*map(_size, parts))
    return sp.Abs(expression)


def _choose(condition: bool, chosen: Any, other: Any) -> Any:
    return chosen if condition else other


def _dot(a: Sequence[Any], u: Sequence[Any]) -> Any:
    return sum([aj * uj for aj, uj in zip(a, u, strict=True)])
