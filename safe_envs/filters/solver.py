"""Solves the QP of a filter for a state or a batch.

A constraint has the coefficients of 1, of the m inputs u_j and, if it is quadratic, of u_j u_n, j
<= n.

A constraint a u + b >= 0 with a margin of first order changes at a rate that is quadratic in the
held input. To first order its value at the end of the period dt is

    q(u) = a u + b + dt (c_0 + c u + u' C u),

so that it holds all along the period where a u + b >= 0 and q(u) >= 0: two constraints, of which
one is quadratic. Where the input that the constraints allow at its beginning violates one of them,
each round takes one step of Newton's method: they are linearised there, and the QP proposes another
input. On the line through both inputs all constraints are known in closed form, and the step ends
at the nearest input at which all of them hold. Where there is none on the line, it ends where their
squared violations are least among their roots and vertices and what the QP proposed; where that
helps little, lines along each input are tried. So for one input one step finds the nearest one,
whatever the curvatures; several inputs end at one that has been checked, which need not be the
nearest.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from operator import mul, truediv
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import (
    Components,
    Flavour,
    compile_function,
    constants,
    finite,
)
from safe_envs.engine.qp import dispatch, one_constraint, second_order
from safe_envs.engine.qp.kernels.one_constraint import project_scalar
from safe_envs.engine.qp.rounding import ROUNDING, tolerance, tolerances
from safe_envs.engine.qp.second_order import majorant
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.base import AffineConstraint
from safe_envs.filters.qp import FilterDecision, FilterQP, UndefinedConstraintError


def furthest_active(
    a: Sequence[Sequence[float]],
    b: Sequence[float],
    u: Sequence[float],
    active: Sequence[bool],
    weights: Sequence[float],
) -> int:
    """Return the active constraint whose half-space is furthest from the proposed input, else -1.

    One that says nothing of the input is nearer than any; of several such, the first counts.

    Args:
        a: coefficients of k constraints on m inputs.
        b: their offsets.
        u: the proposed input.
        active: which constraints are active.
        weights: of the inputs.
    """
    acting = [i for i, acts in enumerate(active) if acts]
    if len(acting) < 2:
        return acting[0] if acting else -1
    cause, furthest = acting[0], -math.inf
    for i in acting:
        if not any(a[i]):
            continue
        unit = max(map(abs, a[i]))  # so that squares neither overflow nor vanish
        parts = [aj / unit for aj in a[i]]
        square = sum(map(truediv, map(mul, parts, parts), weights))
        distance = -(sum(map(mul, a[i], u)) + b[i]) / unit / square**0.5
        if distance > furthest:
            cause, furthest = i, distance
    return cause


def dot(a: Sequence[Any], u: Sequence[Any]) -> Any:
    """Return a . u.

    Args:
        a: m entries, floats or arrays (B,).
        u: m entries, likewise.
    """
    return sum([aj * uj for aj, uj in zip(a, u, strict=True)])


Bounds = tuple[Sequence[Any], Sequence[Any]]
"""m lower and m upper input bounds, floats or arrays (B,)."""


class FilterQPSolver:
    """Solves a QP for states given component by component, as floats or as arrays of a batch.

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
            second_order.project_arrays if arrays else second_order.project_floats
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
        with np.errstate(all="ignore"):
            at = self._with_terms([np.array([c]) for c in x])
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

    def solve_single(
        self, x: Sequence[Any], u: Sequence[Any], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Solve a plain QP of one constraint; see `solve`."""
        low, high = bounds or self.bounds
        values = self._values(*self._with_terms(x))
        if self._uncertain:
            return self._solve_uncertain(values, u, low[0], high[0])
        *a, b = values
        p = self._qp
        if self._flavour == "floats":
            if self._m == 1:
                v, margin, active, feasible = project_scalar(a[0], b, u[0], low[0], high[0])
                action = [v]
            else:
                action, margin, active, feasible = one_constraint.project_floats(
                    a, b, u, low, high, p.weights
                )
            self._require_finite((margin,))
            return FilterDecision(
                action, (margin,), (active,), feasible, (0.0 if feasible else -margin,), 0, u
            )
        action, margin, active, feasible = one_constraint.project_arrays(
            a, b, u, low, high, p.weights
        )
        self._require_finite((margin,))
        met = np.count_nonzero(feasible) == len(feasible)
        slack = np.zeros(len(margin)) if met else np.where(feasible, 0.0, -margin)
        return FilterDecision(action, (margin,), (active,), feasible, (slack,), 0, u)

    def _solve_uncertain(
        self, values: Components, u: Sequence[Any], low: Any, high: Any
    ) -> FilterDecision:
        a, b, *form = values
        action, margin, active, feasible = self._project_uncertain(
            (a,), (b,), (form,), u[0], low, high, self._qp.priorities
        )
        self._require_finite((margin[0], *form))
        return FilterDecision(
            (action,),
            tuple(margin),
            tuple(active),
            feasible,
            (self._choose(feasible, 0.0, -margin[0]),),
            0,
            u,
        )

    def solve_plain(
        self, x: Sequence[Any], u: Sequence[Any], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Solve a plain QP without uncertainty for one state; see `solve`, which this shortens."""
        low, high = bounds or self.bounds
        values, m, width = self._values(*self._with_terms(x)), self._m, self._m + 1
        self._require_finite(values)
        a, b = [values[i : i + m] for i in range(0, len(values), width)], values[m::width]
        action, margin, active, feasible = self._project(
            a, b, u, low, high, self.weights, self._qp.priorities
        )
        self._require_finite((*action, *margin))
        slack = [0.0] * len(b) if feasible else [max(-g, 0.0) for g in margin]
        cause = furthest_active(a, b, u, active, self.weights) if True in active else -1
        return FilterDecision(action, margin, active, feasible, slack, cause, u)

    def solve(
        self, x: Sequence[Any], u: Sequence[Any], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Solve any QP.

        Args:
            x: components of the state, followed by those of `FilterQP.runtime`.
            u: m components of the proposed input.
            bounds: input bounds; by default those of the QP.

        Returns:
            The decision in components.

        Raises:
            UndefinedConstraintError: A constraint or the goal has no finite value.
        """
        bounds = bounds or self.bounds
        x = self._with_terms(x)
        a, b, goal, inside, forms, known = self._split(self._values(*x))
        target = u
        if goal:
            target = [0.0 * uj for uj in u]
            u = self._best(goal, target, bounds)
        for i in self._maxima:
            functions = self._functions[i](*x)
            if i in known:
                known[i] = known[i] & self._isfinite(sum(functions))
                functions = [self._choose(known[i], entry, 0.0) for entry in functions]
            *a[i], b[i] = self.nearest(functions, u, bounds)
        self._require_finite([*b, *[aj for ai in a for aj in ai]])
        counts = [inside.get(i, True) & known.get(i, True) for i in range(self._count)]
        asked = [
            (
                self._choose(inside[i], b[i] - self._demand(i, x, counts[i]), 0.0)
                if i in inside
                else b[i]
            )
            for i in range(self._count)
        ]
        held = [
            [self._choose(inside[i], aj, 0.0) for aj in a[i]] if i in inside else a[i]
            for i in range(self._count)
        ]
        aim = self._outwards(a, inside, target, bounds)
        rows = self._on_the_safe_side(held, asked, forms, bounds)
        exact = forms if self._exact else {}
        action, margin, active, feasible = self._minimise(*rows, aim, bounds, goal, exact)
        if self._sampled:
            falls = {i: self._fall(i, x, counts[i]) for i in self._sampled}
            period, owners = constraints_of_period(*rows, falls)
            weights = [self._qp.priorities[i] for i in owners]
            held = PeriodSearch(
                PeriodConstraints(period, exact, weights, self._flavour, self._m),
                owners,
                self._project,
                bounds,
                self.weights,
            )
            action, margin, active, feasible = held.hold(action, active, margin)
        for i, defined in inside.items():
            margin[i] = self._choose(defined, margin[i], dot(a[i], action) + b[i])
            active[i] = self._choose(defined, active[i], True)
            feasible = feasible & defined
        # A demand or a loss without a value shows here, and so does what overflows on the way to
        # the action.
        self._require_finite([*action, *margin])
        for i, has_value in known.items():
            margin[i] = self._choose(has_value, margin[i], -math.inf)
            active[i] = self._choose(has_value, active[i], True)
            feasible = feasible & has_value
        slack = [self._choose(feasible, 0.0, self._larger(-value, 0.0)) for value in margin]
        return FilterDecision(
            action, margin, active, feasible, slack, self._cause(a, asked, u, active, inside), u
        )

    def best(self, x: Sequence[Any], nothing: Sequence[Any]) -> Sequence[Any]:
        """Return the input that is best for the goal, without constraints; raises as `solve`.

        Args:
            x: components of the state, followed by those of `FilterQP.runtime`.
            nothing: m components of the input 0.
        """
        goal = self._split(self._values(*self._with_terms(x)))[2]
        return self._best(goal, nothing, self.bounds)

    def _best(self, goal: Sequence[Any], nothing: Sequence[Any], bounds: Bounds) -> Sequence[Any]:
        self._require_finite(goal, "the goal")
        return self._minimise((), (), nothing, bounds, goal)[0]

    def _outwards(
        self, a: Sequence[Any], inside: dict[int, Any], u: Sequence[Any], bounds: Bounds
    ) -> Sequence[Any]:
        """Return the proposed input, or one far away where h of a reciprocal condition rises most.

        The latter is for states outside its domain. The allowed point nearest to an input so far
        off is where h rises most among those that the other constraints allow: these are not to
        suffer from a condition that is undefined.
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
        steepness = sum([rj * rj / wj for rj, wj in zip(rise, self.weights, strict=True)])
        ends = list(zip(*bounds, strict=True))
        span = sum([abs(rj) * (hi - lo) for rj, (lo, hi) in zip(rise, ends, strict=True)])
        far = _FAR * span / self._choose(steepness > 0.0, steepness, 1.0)
        corner = [
            self._choose(rj > 0.0, hi, self._choose(rj < 0.0, lo, uj))
            for rj, (lo, hi), uj in zip(rise, ends, u, strict=True)
        ]
        return [c + far * rj / wj for c, rj, wj in zip(corner, rise, self.weights, strict=True)]

    def _over_largest(self, entries: Sequence[Any]) -> list[Any]:
        """Return entries over the largest of their sizes, whose inverse may overflow."""
        size = functools.reduce(self._larger, [abs(entry) for entry in entries])
        return [entry / self._choose(size > 0.0, size, 1.0) for entry in entries]

    def _minimise(
        self,
        a: Sequence[Any],
        b: Sequence[Any],
        u: Sequence[Any],
        bounds: Bounds,
        goal: Sequence[Any],
        forms: dict[int, Components] | None = None,
    ) -> tuple[Any, Any, Any, Any]:
        p, (low, high) = self._qp, bounds
        if forms:
            q = [forms.get(i, (0.0, 0.0, 0.0)) for i in range(self._count)]
            action, margin, active, feasible = self._project_uncertain(
                [ai[0] for ai in a], b, q, u[0], low[0], high[0], p.priorities
            )
            return [action], list(margin), list(active), feasible
        if not goal:
            return self._project(a, b, u, low, high, self.weights, p.priorities)
        # The goal's slack is d = unit e, since the square of d would overflow before d does. Twice
        # the most that the input bounds can make d always meets the goal's constraint, also after
        # rounding.
        growth, along = goal[0], goal[1:]
        most = growth + sum(
            [self._larger(bj * lo, bj * hi) for bj, lo, hi in zip(along, low, high, strict=True)]
        )
        unit = self.goal_unit
        rows = [*[(*ai, 0.0) for ai in a], (*[-bj for bj in along], unit)]
        low = (*low, 0.0)
        high = (*high, self._choose(most > 0.0, 2.0 * most / unit, 1.0))
        w, priorities = (*self.weights, self.weights[0]), [*p.priorities[: len(a)], 1.0]
        action, margin, active, _ = self._project(
            rows, [*b, -growth], (*u, 0.0 * u[0]), low, high, w, priorities
        )
        action, margin, active = action[: self._m], margin[: len(a)], active[: len(a)]
        # The goal's constraint, which can always be met, has no say in that, nor has its rounding.
        feasible: Any = True
        for ai, bi, g in zip(a, b, margin, strict=True):
            feasible = feasible & (g >= -self._tolerance(ai, bi, action))
        return action, margin, active, feasible

    def _on_the_safe_side(
        self, a: Sequence[Any], b: Sequence[Any], forms: dict[int, Components], bounds: Bounds
    ) -> tuple[list[Any], list[Any]]:
        """Return affine constraints that are met only where the uncertain ones are.

        Those that are solved as they are stay as they are.
        """
        a, b = list(a), list(b)
        for i, form in forms.items():
            self._require_finite(form)
            if self._exact:
                continue
            known = bounds is self.bounds and i in self.planes
            slopes, constant = self.planes[i] if known else self._plane(form, bounds)
            a[i] = [aj - cj for aj, cj in zip(a[i], slopes, strict=True)]
            b[i] = b[i] - constant
        return a, b

    def _cause(
        self,
        a: Sequence[Any],
        b: Sequence[Any],
        u: Sequence[Any],
        active: Sequence[Any],
        inside: dict[int, Any],
    ) -> Any:
        """Return the active constraint whose half-space is furthest from the proposed input.

        A reciprocal one outside its domain is further than any, and one that says nothing of the
        input nearer than any; of several such, the first counts.
        """
        cause, furthest = -1, -math.inf
        for i, (ai, bi, acts) in enumerate(zip(a, b, active, strict=True)):
            if acts is False or (acts is not True and not np.count_nonzero(acts)):
                continue
            distance = self._distance(ai, bi, u)
            if i in inside:
                distance = self._choose(inside[i], distance, math.inf)
            size = functools.reduce(self._larger, [abs(aj) for aj in ai])
            distance = self._choose(acts & (size > 0.0), distance, -math.inf)
            first: Any = acts & (cause < 0)
            cause = self._choose(first | (distance > furthest), i, cause)
            furthest = self._larger(furthest, distance)
        return cause


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


FAR = 1e37
"""No point of a line is further away; it is a number in single precision as well."""
BETTER = 0.999999999
"""Share of the squared violations that is left by a step that helps, beyond rounding."""


class PeriodConstraints:
    """Constraints of one state, or of a batch.

    Args:
        coefficients: of each constraint, more of quadratic ones.
        forms: of those on one input with an uncertainty q_0, q_1, q_2, which ask for a u + b >=
            sqrt(q_0 + 2 q_1 u + q_2 u^2), by their number.
        priorities: weights of the squared violations.
        flavour: "floats" of one state, or "arrays" of a batch.
        m: number of inputs.
    """

    def __init__(
        self,
        coefficients: Sequence[Sequence[Any]],
        forms: Mapping[int, Sequence[Any]],
        priorities: Sequence[float],
        flavour: Flavour,
        m: int,
    ) -> None:
        self.coefficients, self.forms, self.priorities, self.m = coefficients, forms, priorities, m
        places = [(j, n) for j in range(m) for n in range(j, m)]
        self.bends = [
            [(c, j, n) for c, (j, n) in zip(constraint[1 + m :], places, strict=False)]
            for constraint in coefficients
        ]
        self.flavour: Flavour = flavour
        self.alone = flavour == "floats"
        self.choose: Any = choose if self.alone else np.where
        self.larger: Any = max if self.alone else np.maximum
        self.square_root: Any = math.sqrt if self.alone else np.sqrt

    def ratio(self, numerator: Any, denominator: Any, other: float = 0.0) -> Any:
        """Return a quotient.

        Args:
            numerator: of it.
            denominator: of it.
            other: what is returned where there is none.
        """
        some = denominator != 0.0
        return self.choose(some, numerator / self.choose(some, denominator, 1.0), other)

    def step(
        self, u: Sequence[Any], v: Sequence[Any], low: Sequence[Any], high: Sequence[Any]
    ) -> tuple[list[Any], Any]:
        """Move along a line to where constraints are violated least.

        Args:
            u: m inputs.
            v: m others, on the line.
            low: m lower bounds.
            high: m upper bounds.

        Returns:
            The inputs, and which share of the squared violations is left.
        """
        choose = self.choose
        d, proposed = [vj - uj for vj, uj in zip(v, u, strict=True)], 1.0
        if self.m == 1:  # there is one line, whatever is proposed
            d, proposed = [1.0], d[0]
        first, last = -FAR, FAR
        for dj, uj, lo, hi in zip(d, u, low, high, strict=True):
            unit = choose(dj == 0.0, 1.0, dj)
            ends = (lo - uj) / unit, (hi - uj) / unit
            near, far = choose(dj > 0.0, ends[0], ends[1]), choose(dj > 0.0, ends[1], ends[0])
            first = choose(dj == 0.0, first, self.larger(first, near))
            last = choose(dj == 0.0, last, -self.larger(-last, -far))
        lines = [self._line(i, u, d) for i in range(len(self.coefficients))]
        before = self._violation(lines, 0.0)
        best, least = 0.0, before
        for point in (*[t for line in lines for t in self._points(line)], proposed):
            t = choose(point < first, first, choose(point > last, last, point))
            missed = self._violation(lines, t, least)
            better = (missed < BETTER * least) | ((missed == least) & (abs(t) < abs(best)))
            best, least = choose(better, t, best), choose(better, missed, least)
        ends = zip(u, d, low, high, strict=True)
        moved = [(uj + best * dj, lo, hi) for uj, dj, lo, hi in ends]
        inside = [choose(z < lo, lo, choose(z > hi, hi, z)) for z, lo, hi in moved]
        return inside, self.ratio(least, before, 1.0)

    def _line(self, i: int, u: Sequence[Any], d: Sequence[Any]) -> _Line:
        constraint, bends = self.coefficients[i], self.bends[i]
        constant, rate, bend, size = constraint[0], 0.0, 0.0, abs(constraint[0])
        for j, (cj, uj, dj) in enumerate(zip(constraint[1:], u, d, strict=False)):
            constant, rate, size = constant + cj * uj, rate + cj * dj, size + abs(cj * uj)
            for c, first, n in bends:
                if first == j:
                    constant = constant + c * uj * u[n]
                    rate = rate + c * (uj * d[n] + dj * u[n])
                    bend = bend + c * dj * d[n]
                    size = size + abs(c * uj * u[n])
        form = None
        if i in self.forms:
            q0, q1, q2 = self.forms[i]
            at = q0 + 2.0 * q1 * u[0] + q2 * u[0] * u[0]
            form = at, 2.0 * (q1 + q2 * u[0]) * d[0], q2 * d[0] * d[0]
        return _Line(constant, rate, bend, size, form)

    def _violation(self, lines: Sequence[_Line], t: Any, least: Any = math.inf) -> Any:
        """Return the sum of the squared violations at a point of a line, or more than the least."""
        total = 0.0
        for line, priority in zip(lines, self.priorities, strict=True):
            linear, square = line.rate * t, line.bend * t * t
            value = line.constant + linear + square
            if line.form:
                inside = line.form[0] + line.form[1] * t + line.form[2] * t * t
                value = value - self.square_root(self.larger(inside, 0.0))
            if self.alone and value >= 0.0:
                continue
            met = value >= -ROUNDING * (line.size + abs(linear) + abs(square))
            total = self.choose(met, total, total + priority * value * value)
            if self.alone and total > least:
                break
        return total

    def _points(self, line: _Line) -> list[Any]:
        """Return where on a line a constraint may begin to hold, or is violated least.

        These are its roots, a little beyond, so that it holds, and the vertex between them.
        """
        constant, rate, bend = line.constant, line.rate, line.bend
        found = [self.ratio(-0.5 * rate, bend), *self._roots(constant, rate, bend)]
        if line.form:
            found += self._roots(
                constant * constant - line.form[0],
                2.0 * constant * rate - line.form[1],
                rate * rate - line.form[2],
            )
        return found

    def _roots(self, constant: Any, rate: Any, bend: Any) -> tuple[Any, Any]:
        square = rate * rate - 4.0 * bend * constant
        root = self.square_root(self.choose(square < 0.0, 0.0, square))
        half = -0.5 * (rate + self.choose(rate > 0.0, root, -root))
        found = self.ratio(half, bend), self.ratio(constant, half)
        return found[0] + ROUNDING * found[0], found[1] + ROUNDING * found[1]


class _Line(NamedTuple):
    """A constraint on a line: constant + rate t + bend t^2, and the size of its terms.

    Of an uncertain one, the form has the coefficients of 1, t and t^2.
    """

    constant: Any
    rate: Any
    bend: Any
    size: Any
    form: tuple[Any, Any, Any] | None


ROUNDS = 12
"""Of Newton's method; it stops where all constraints hold, or where a round does not help."""
ENOUGH = 0.9
"""Share of the squared violations that is left by a round after which another one is tried."""
SLOW = 0.25
"""Share of them that is left by a step after which lines along each input are tried."""
INWARDS = 1e-8
"""Share of its terms without input by which a constraint at the end of the period has to exceed 0.
A filter that rides the edge would else be carried beyond it by the errors of integrators."""


def constraints_of_period(
    a: Sequence[Sequence[Any]], b: Sequence[Any], falls: Mapping[int, Sequence[Any]]
) -> tuple[list[list[Any]], list[int]]:
    """Return constraints at the beginning of a period and at its end, and of which each is.

    Args:
        a: m coefficients of each of k constraints.
        b: k offsets.
        falls: by the number of the constraint, the coefficients of its change within the period.
    """
    constraints = [[bi, *ai] for ai, bi in zip(a, b, strict=True)]
    for i, fall in falls.items():
        offset = b[i] + fall[0] - INWARDS * (abs(b[i]) + abs(fall[0]))
        slopes = [aj + cj for aj, cj in zip(a[i], fall[1:], strict=False)]
        constraints.append([offset, *slopes, *fall[1 + len(slopes) :]])
    return constraints, [*range(len(b)), *falls]


class PeriodSearch:
    """Moves inputs to where constraints hold.

    Args:
        constraints: the constraints.
        owners: of which constraint each is at the beginning or at the end, which come last.
        project: projects inputs; see `safe_envs.engine.qp.dispatch`.
        bounds: m lower and m upper bounds.
        w: m weights of the inputs.
    """

    def __init__(
        self,
        constraints: PeriodConstraints,
        owners: Sequence[int],
        project: Callable[..., Any],
        bounds: Sequence[Sequence[Any]],
        w: Sequence[float],
    ) -> None:
        self._constraints, self._owners, self._project = constraints, owners, project
        self._bounds, self._w = bounds, w

    def hold(
        self, u: Sequence[Any], active: Sequence[Any], known: Sequence[Any], rounds: int = ROUNDS
    ) -> tuple[list[Any], list[Any], list[Any], Any]:
        """Move an input to where the constraints hold.

        Args:
            u: m components of the input.
            active: which constraints have changed it so far.
            known: values of the constraints there, as far as they are known.
            rounds: how many there may be.

        Returns:
            The input, the lesser value of each constraint, which have changed the input, and
            whether all constraints hold.
        """
        alone = self._constraints.alone
        u, active, margin, kept = list(u), list(active), list(known), []
        for n, i in enumerate(self._owners):
            value = known[n] if n < len(known) else self._value(n, u)
            some = (value < 0.0) if alone else np.any(~(value >= 0.0))
            kept.append(value >= -self._allowed(n, u) if some else value >= 0.0)
            if i < n:
                margin[i] = self._constraints.choose(value < margin[i], value, margin[i])
            elif n >= len(known):
                margin.append(value)
            active[i] = self._constraints.choose(kept[n], active[i], True)
        met: Any = all(kept) if alone else functools.reduce(operator.and_, kept)
        if not rounds or (met if alone else met.all()):
            return u, margin, active, met
        if alone:
            u, left = self._round(u)
            return self.hold(u, active, (), rounds - 1 if left < ENOUGH else 0)
        # Each state has the rounds that it would have alone.
        lost = np.flatnonzero(~met)
        part, inputs = self._of(lost), _take(u, lost)
        inputs, left = part._round(inputs)
        for going in (True, False):
            which = np.flatnonzero((left < ENOUGH) == going)
            if which.size:
                place, some = lost[which], (_take(inputs, which), _take(active, lost[which]))
                found = part._of(which).hold(*some, (), rounds - 1 if going else 0)
                for whole, entries in zip((u, margin, active), found[:3], strict=True):
                    for n, entry in enumerate(entries):
                        whole[n] = _put(whole[n], place, entry, len(met))
                met[place] = found[3]
        return u, margin, active, met

    def _of(self, which: np.ndarray) -> PeriodSearch:
        """Return the constraints of some states of a batch."""
        constraints = self._constraints
        forms = {i: _take(form, which) for i, form in constraints.forms.items()}
        some = PeriodConstraints(
            [_take(constraint, which) for constraint in constraints.coefficients],
            forms,
            constraints.priorities,
            constraints.flavour,
            constraints.m,
        )
        bounds = [_take(end, which) for end in self._bounds]
        return PeriodSearch(some, self._owners, self._project, bounds, self._w)

    def _value(self, i: int, u: Sequence[Any]) -> Any:
        """Return the value of a constraint."""
        value = self._constraints.coefficients[i][0]
        for cj, uj in zip(self._constraints.coefficients[i][1:], u, strict=False):
            value = value + cj * uj
        for c, j, n in self._constraints.bends[i]:
            value = value + c * u[j] * u[n]
        return value - self._root(i, u[0])[0] if i in self._constraints.forms else value

    def _allowed(self, i: int, u: Sequence[Any]) -> Any:
        """Return by how much a constraint may be violated and count as met."""
        size = abs(self._constraints.coefficients[i][0])
        for cj, uj in zip(self._constraints.coefficients[i][1:], u, strict=False):
            size = size + abs(cj * uj)
        for c, j, n in self._constraints.bends[i]:
            size = size + abs(c * u[j] * u[n])
        blur = self._root(i, u[0])[2] if i in self._constraints.forms else 0.0
        return ROUNDING * size + blur

    def _root(self, i: int, u: Any) -> tuple[Any, Any, Any]:
        """Return the root of an uncertainty, its slope, and the error of its rounding."""
        constraints, (q0, q1, q2) = self._constraints, self._constraints.forms[i]
        linear, square = 2.0 * q1 * u, q2 * u * u
        inside = constraints.larger(q0 + linear + square, 0.0)
        root, error = constraints.square_root(inside), ROUNDING * (abs(q0) + abs(linear) + square)
        blur = constraints.choose(inside > 0.0, constraints.square_root(inside + error) - root, 0.0)
        return root, constraints.ratio(q1 + q2 * u, root), blur

    def _linear(self, u: Sequence[Any]) -> tuple[list[list[Any]], list[Any]]:
        """Return the slopes and offsets of the constraints, linearised at an input."""
        slopes, offsets = [], []
        for i, constraint in enumerate(self._constraints.coefficients):
            offset, along = constraint[0], list(constraint[1 : 1 + len(u)])
            for c, j, n in self._constraints.bends[i]:
                offset = offset - c * u[j] * u[n]
                along[j] = along[j] + c * u[n]
                along[n] = along[n] + c * u[j]
            if i in self._constraints.forms:
                root, steepness, _ = self._root(i, u[0])
                along, offset = [along[0] - steepness], offset + (steepness * u[0] - root)
            slopes.append(along)
            offsets.append(offset)
        return slopes, offsets

    def _round(self, u: Sequence[Any]) -> tuple[list[Any], Any]:
        """Take a step, and others where it helps little; return the input and what is left."""
        constraints = self._constraints
        v = self._project(*self._linear(u), u, *self._bounds, self._w, constraints.priorities)[0]
        u, left = constraints.step(u, v, *self._bounds)
        slow = constraints.choose(left > SLOW, 1.0, 0.0)
        for j in range(constraints.m if constraints.m > 1 and np.any(slow) else 0):
            axis = [uj + slow * (n == j) for n, uj in enumerate(u)]
            u, more = constraints.step(u, axis, *self._bounds)
            left = left * more
        return u, left


def _take(entries: Sequence[Any], which: np.ndarray) -> list[Any]:
    """Return the numbers of some states; those of all have no axis."""
    return [entry[which] if np.ndim(entry) else entry for entry in entries]


def _put(entry: Any, place: np.ndarray, some: Any, count: int) -> np.ndarray:
    """Return numbers of a batch with other ones in the place of some."""
    found = np.array(np.broadcast_to(entry, count))
    found[place] = some
    return found


_FAR = 1e4
"""How many times further than the input bounds reach is far away."""


class PerBarrier:
    """Solves a QP: of the constraints of a barrier, the one that is violated most counts.

    Args:
        solve: returns the decision in components, with an entry for each constraint.
        qp: the QP.
        flavour: of the components.
    """

    def __init__(
        self, solve: Callable[..., FilterDecision], qp: FilterQP, flavour: Flavour
    ) -> None:
        self._solve, self._members = solve, qp.members
        self._owners = np.array([*qp.owners, -1])
        arrays = flavour == "arrays"
        self._smaller: Any = np.minimum if arrays else min
        self._larger: Any = np.maximum if arrays else max

    def __call__(self, *given: Any) -> FilterDecision:
        """Return the decision; see `FilterQPSolver.solve`."""
        found = self._solve(*given)
        cause: Any = self._owners[found.cause]
        return found._replace(
            margin=self._reduced(self._smaller, found.margin),
            active=self._reduced(self._larger, found.active),
            slack=self._reduced(self._larger, found.slack),
            cause=cause if isinstance(found.cause, np.ndarray) else int(cause),
        )

    def _reduced(self, of_two: Callable[..., Any], entries: Sequence[Any]) -> list[Any]:
        return [functools.reduce(of_two, [entries[i] for i in each]) for each in self._members]
