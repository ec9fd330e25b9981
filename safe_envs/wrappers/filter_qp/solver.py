"""Solves the QP of a filter for a state or a batch."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.wrappers.filter_qp.compiled import Bounds, CompiledQP
from safe_envs.wrappers.filter_qp.decision import FilterDecision
from safe_envs.wrappers.filter_qp.furthest import dot, furthest_active
from safe_envs.wrappers.filter_qp.period_constraints import PeriodConstraints
from safe_envs.wrappers.filter_qp.period_search import PeriodSearch, constraints_of_period
from safe_envs.wrappers.qp import one_constraint
from safe_envs.wrappers.qp.kernels.one_constraint import project_scalar

_FAR = 1e4
"""How many times further than the input bounds reach is far away."""


class FilterQPSolver(CompiledQP):
    """Solves a QP for states given component by component, as floats or as arrays of a batch."""

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
