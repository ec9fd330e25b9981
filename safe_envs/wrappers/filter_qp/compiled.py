"""The constraints of a QP as functions of a state, or of a batch of them."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import operator
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, constants, finite
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.conditions.constraint import AffineConstraint
from safe_envs.wrappers.filter_qp.decision import UndefinedConstraintError
from safe_envs.wrappers.filter_qp.furthest import dot
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.qp import dispatch, second_order_batch, second_order_constraint
from safe_envs.wrappers.qp.majorant import majorant
from safe_envs.wrappers.qp.rounding import ROUNDING, tolerance, tolerances

Bounds = tuple[Sequence[Any], Sequence[Any]]
"""m lower and m upper input bounds, floats or arrays (B,)."""


class CompiledQP:
    """A QP compiled for states given component by component, as floats or as arrays of a batch.

    The formulas are the same for both flavours; only the choice between two values and the solver
    differ.

    Attributes:
        bounds: the lower and the upper input bounds where no others are given at run time.
        weights: of the inputs, those of the goal where there is one.
        goal_unit: of the goal's slack, in which it weighs as much as an input.
    """

    def __init__(self, qp: FilterQP, flavour: Flavour) -> None:
        self._qp = qp
        self._flavour: Flavour = flavour
        self._m = qp.model.m
        self._count = len(qp.constraints)
        self._reciprocal = [i for i, c in enumerate(qp.constraints) if c.demand is not None]
        self._domains = [domain_of(qp.constraints[i]) for i in self._reciprocal]
        self._sampled = [i for i, c in enumerate(qp.constraints) if c.change is not None]
        self._uncertain = [i for i, c in enumerate(qp.constraints) if c.uncertainty is not None]
        self._maxima = [i for i, c in enumerate(qp.constraints) if c.alternatives]
        self._exact = solved_as_cones(qp)
        arrays = flavour == "arrays"
        self._terms = [term.arrays if arrays else term.floats for term in qp.terms]
        self._symbols = (*qp.symbols, *(s for term in qp.terms for s in term.symbols))
        self.bounds: Bounds = (
            (constants(qp.low), constants(qp.high)) if arrays else (qp.low, qp.high)
        )
        self.weights = qp.weights
        self._choose: Any = np.where if arrays else choose
        self._isfinite: Any = np.isfinite if arrays else math.isfinite
        self._larger: Any = np.maximum if arrays else max
        self._tolerance: Any = tolerances if arrays else tolerance
        self._project: Any = dispatch.project_arrays if arrays else dispatch.project_floats
        self._project_uncertain: Any = (
            second_order_batch.project_arrays if arrays else second_order_constraint.project_floats
        )
        if qp.clf is not None:
            qp.clf.require_known(qp.model, qp.symbols)
            weights = (qp.clf.input_weight, qp.clf.slack_weight)
            input_weight, slack_weight = [float(qp.model.numeric(w)) for w in weights]
            if not (0 < input_weight < math.inf and 0 < slack_weight < math.inf):
                raise ConfigurationError(
                    f"the goal weighs inputs by {input_weight} and slack by {slack_weight};"
                    " give positive numbers"
                )
            self.weights = [input_weight] * self._m
            self.goal_unit = math.sqrt(input_weight / slack_weight)

    def compile(self) -> None:
        """Compile all functions that a decision may call; else each is at its first call."""
        _ = self._values, self._demands, self._changes, self._functions, self.planes
        zero: Any = np.zeros(1) if self._flavour == "arrays" else 0.0
        for term in self._terms:
            # Learned terms compile themselves when they are first read, wherever that is.
            with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
                term((zero,) * self._qp.model.n)

    @cached_property
    def planes(self) -> dict[int, tuple[list[Any], Any]]:
        """Planes above uncertainties that are the same at every state, for the QP's own bounds."""
        forms = {i: self._qp.constraints[i].uncertainty or () for i in self._uncertain}
        return {
            i: self._plane(tuple(map(float, form)), (self._qp.low, self._qp.high))
            for i, form in forms.items()
            if all(e.is_number for e in form)
        }

    def _plane(self, form: Components, bounds: Bounds) -> tuple[list[Any], Any]:
        """Return the plane above the uncertainty of a constraint; see `majorant`."""
        width = self._m + 1
        place = {
            pair: k
            for k, pair in enumerate(itertools.combinations_with_replacement(range(width), 2))
        }
        q = [[form[place[min(j, k), max(j, k)]] for k in range(width)] for j in range(width)]
        return majorant(q, *bounds)

    def _with_terms(self, x: Sequence[Any]) -> Sequence[Any]:
        """Return the state and what follows it, and then the learned terms of the state."""
        if not self._terms:
            return x
        state = tuple(x[: self._qp.model.n])
        return (*x, *[value for term in self._terms for value in term(state)])

    def _require_finite(self, values: Sequence[Any], what: str = "the constraint") -> None:
        total: Any = sum(values)
        if self._flavour == "floats":
            if not math.isfinite(total):
                raise UndefinedConstraintError(0, what)
        elif not finite(np.atleast_1d(total)):
            bad = np.flatnonzero(~np.isfinite(total))
            if bad.size:
                raise UndefinedConstraintError(int(bad[0]), what)

    def _split(
        self, values: Components
    ) -> tuple[list[Any], list[Any], Sequence[Any], dict[int, Any], dict[int, Any], dict[int, Any]]:
        """Take values apart.

        A constraint whose barrier has no value is 0, which every input meets.

        Returns:
            a and b of each constraint, the goal's offset and coefficients, whether each reciprocal
            condition is inside its domain, Q of uncertain constraints, and whether each barrier and
            its constraint have values that may have none, by their numbers.
        """
        width, count, entries = self._m + 1, self._count, (self._m + 1) * (self._m + 2) // 2
        rows: list[Any] = [values[i * width : (i + 1) * width] for i in range(count)]
        forms_at = len(values) - entries * len(self._uncertain)
        levels_end = forms_at - len(self._qp.partial)
        goal_end = levels_end - sum(map(len, self._domains))
        forms: dict[int, Any] = {
            i: values[forms_at + k * entries : forms_at + (k + 1) * entries]
            for k, i in enumerate(self._uncertain)
        }
        goal, levels = values[count * width : goal_end], values[goal_end:levels_end]
        inside = self._inside(levels)
        heights = zip(self._qp.partial, values[levels_end:forms_at], strict=True)
        # At the end of where it has a value, its derivatives may have none.
        known = {i: self._isfinite(h + sum(rows[i])) for i, h in heights}
        for i, has_value in known.items():
            rows[i] = [self._choose(has_value, entry, 0.0) for entry in rows[i]]
            if i in forms:
                forms[i] = [self._choose(has_value, entry, 0.0) for entry in forms[i]]
            if i in inside:
                inside[i] = self._choose(has_value, inside[i], True)
        a, b = [row[:-1] for row in rows], [row[-1] for row in rows]
        return a, b, goal, inside, forms, known

    def undefined_at(self, x: Sequence[float]) -> list[int]:
        """Return the constraints that have no finite value at a state; all where that is unclear.

        Args:
            x: components of the state, followed by those of `FilterQP.runtime`.
        """
        at = self._with_terms([np.array([c]) for c in x])
        with np.errstate(all="ignore"):
            a, b, _, inside, forms, known = self._split(self._values(*at))
            found = []
            for i in range(self._count):
                counts = inside.get(i, np.True_) & known.get(i, np.True_)
                parts = [*a[i], b[i], *forms.get(i, ())]
                parts += [self._demand(i, at, counts)] if i in self._reciprocal else []
                parts += self._changes[i](*at) if i in self._sampled and np.all(counts) else []
                found += [] if np.isfinite(sum(parts)).all() else [i]
        return found or list(range(self._count))

    def _inside(self, levels: Sequence[Any]) -> dict[int, Any]:
        """Return whether each reciprocal condition is inside its domain, by its number."""
        found, start = {}, 0
        for i, domain in zip(self._reciprocal, self._domains, strict=True):
            above = [level > 0.0 for level in levels[start : start + len(domain)]]
            found[i] = functools.reduce(operator.and_, above)
            start += len(domain)
        return found

    def _demand(self, i: int, x: Sequence[Any], counts: Any) -> Any:
        """Return what a reciprocal condition demands; floats have no 1/h outside its domain."""
        return 0.0 if counts is False else self._choose(counts, self._demands[i](*x)[0], 0.0)

    def _fall(self, i: int, x: Sequence[Any], counts: Any) -> Sequence[Any]:
        """Return the coefficients of a constraint's change within a period, 0 where none counts."""
        if counts is False:
            return [0.0] * (self._m + 1 + self._m * (self._m + 1) // 2)
        fall = [self._qp.dt * entry for entry in self._changes[i](*x)]
        if counts is not True:
            fall = [self._choose(counts, entry, 0.0) for entry in fall]
        self._require_finite(fall)
        return fall

    def nearest(self, values: Components, u: Sequence[Any], bounds: Bounds) -> Sequence[Any]:
        """Return a and b of the function of a maximum whose constraint is nearest to an input.

        It is one whose set holds the state: the constraint of another would not keep the maximum.
        Where none of these can be met, and outside of all sets, it is the largest one's.

        Args:
            values: a, b and the level of each function.
            u: m components of the proposed input.
            bounds: of the inputs.
        """
        width = self._m + 2
        functions = [values[k : k + width] for k in range(0, len(values), width)]
        self._require_finite([f[-1] for f in functions])
        *chosen, top = functions[0]
        for *each, level in functions[1:]:
            chosen = self._chosen(level > top, each, chosen)
            top = self._larger(top, level)
        least: Any = math.inf
        for *a, b, level in functions:
            ends = zip(a, *bounds, strict=True)
            most = b + sum([self._larger(aj * lo, aj * hi) for aj, lo, hi in ends])
            keeps = (most >= 0.0) & ((level >= 0.0) | (level == top))
            distance = self._larger(self._distance(a, b, u), 0.0)
            closer = keeps & (distance < least)
            chosen = self._chosen(closer, (*a, b), chosen)
            least = self._choose(closer, distance, least)
        return chosen

    def _chosen(self, first: Any, entries: Sequence[Any], others: Sequence[Any]) -> list[Any]:
        return [self._choose(first, a, b) for a, b in zip(entries, others, strict=True)]

    def _distance(self, a: Sequence[Any], b: Any, u: Sequence[Any]) -> Any:
        """Return how far an input is from the half-space of a constraint; -b where a is 0."""
        size = functools.reduce(self._larger, [abs(aj) for aj in a])
        # So that squares neither overflow nor vanish.
        unit = self._choose(size > 0.0, size, 1.0)
        square = sum(
            [p * p / wj for p, wj in zip([aj / unit for aj in a], self.weights, strict=True)]
        )
        return -(dot(a, u) + b) / unit / self._choose(size > 0.0, square, 1.0) ** 0.5

    @cached_property
    def _values(self) -> Any:
        """Values that `_split` takes apart again."""
        return self._compiled(self.expressions)

    @property
    def expressions(self) -> list[Any]:
        """Expressions of the values that `_split` takes apart."""
        p = self._qp
        expressions = [e for c in p.constraints for e in (*c.coefficient, c.offset)]
        if p.clf is not None:
            growth, along = p.clf.growth(p.model)
            expressions += [growth, *along]
        expressions += [level for domain in self._domains for level in domain]
        expressions += [sp.Add(*p.constraints[i].functions) for i in p.partial]
        return [
            *expressions,
            *(e for i in self._uncertain for e in p.constraints[i].uncertainty or ()),
        ]

    @cached_property
    def _demands(self) -> dict[int, Any]:
        return {i: self._compiled([self._qp.constraints[i].demand]) for i in self._reciprocal}

    @cached_property
    def _changes(self) -> dict[int, Any]:
        return {i: self._compiled(change_coefficients(self._qp, i)) for i in self._sampled}

    @cached_property
    def _functions(self) -> dict[int, Any]:
        return {i: self._compiled(functions_of(self._qp.constraints[i])) for i in self._maxima}

    def _compiled(self, expressions: Sequence[Any]) -> Any:
        numbers = [self._qp.model.numeric(e) for e in expressions]
        return compile_function(self._symbols, numbers, self._flavour)


def solved_as_cones(qp: FilterQP) -> bool:
    """Return whether uncertain constraints are solved as they are, not by planes above them."""
    uncertain = any(c.uncertainty is not None for c in qp.constraints)
    return uncertain and qp.model.m == 1 and qp.clf is None


def domain_of(constraint: AffineConstraint) -> tuple[sp.Expr, ...]:
    """Return what is positive where a constraint's demand has a meaning."""
    return constraint.domain or (_beyond_rounding(constraint.chain[0]),)


def functions_of(constraint: AffineConstraint) -> list[sp.Expr]:
    """Return a, b and the level of each function of a barrier that is their maximum.

    The level is not negative in the set that the function's own condition keeps.
    """
    return [
        e for c in constraint.alternatives for e in (*c.coefficient, c.offset, sp.Min(*c.chain))
    ]


def _beyond_rounding(h: sp.Expr) -> sp.Expr:
    """Return h less its own rounding.

    Where that is not positive, a state and a batch may find h on either side of 0.
    """
    return h - sp.Float(ROUNDING, 17) * _size(h)


def _size(expression: sp.Expr) -> sp.Expr:
    """Return the sum of the sizes of an expression's terms."""
    parts: Any = expression.args
    if expression.is_Add or expression.is_Mul:
        return expression.func(*map(_size, parts))
    if isinstance(expression, sp.Max | sp.Min):
        return sp.Max(*map(_size, parts))
    return sp.Abs(expression)


def change_coefficients(qp: FilterQP, i: int) -> list[sp.Expr]:
    """Return the coefficients of a constraint's change: of 1, of u_j, and of u_j u_n, j <= n.

    Args:
        qp: of the constraint.
        i: its number.
    """
    change: Any = sp.sympify(qp.constraints[i].change)
    inputs = qp.model.inputs
    at_zero = dict.fromkeys(inputs, sp.Integer(0))
    slopes: list[Any] = [sp.diff(change, u) for u in inputs]
    bends = [
        sp.diff(slope, other) / (2 if u == other else 1)
        for j, (u, slope) in enumerate(zip(inputs, slopes, strict=True))
        for other in inputs[j:]
    ]
    return [*(e.xreplace(at_zero) for e in (change, *slopes)), *bends]


def choose(condition: bool, chosen: Any, other: Any) -> Any:
    """Return one of two values, as `numpy.where` does.

    Args:
        condition: whether it is the first.
        chosen: the first.
        other: the second.
    """
    return chosen if condition else other
