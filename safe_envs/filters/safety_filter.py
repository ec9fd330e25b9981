"""The safety filter: from a state and a proposed input to the nearest input that is allowed."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Never

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import (
    Components,
    Flavour,
    compile_function,
    finite,
    stacked,
)
from safe_envs.dynamics.defined import NO_VALUE, defined_arrays
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.filters import arguments
from safe_envs.filters.arguments import (
    RuntimeArguments,
    doubles,
    known_for_problem,
    require_finite,
)
from safe_envs.filters.conditions.base import Condition, parts_of
from safe_envs.filters.conditions.estimates import (
    EstimateSettings,
    belief_places,
    constraint_at_estimate,
    with_belief_signals,
)
from safe_envs.filters.conditions.text import Conditions, spec_of
from safe_envs.filters.decisions import Bounds, FilterQPSolver
from safe_envs.filters.estimation.estimator import Estimator
from safe_envs.filters.estimation.registry import make_estimator
from safe_envs.filters.measurement_filter import MeasurementFilter, certain_states
from safe_envs.filters.qp import FilterDecision, FilterQP, UndefinedConstraintError
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import SafetyProblem


class SafetyFilter:
    """Chooses the input nearest to a proposed one that every condition allows.

    It minimises 1/2 |u - u_nom|^2_W subject to a_i(x) u + b_i(x) >= 0 for every barrier and to the
    input bounds. Where the constraints cannot all be met, the sum of their squared slacks, weighted
    by the priorities, is as small as can be. A constraint counts as met where it is violated by no
    more than the rounding of its terms; see `safe_envs.engine.qp`.

    One constraint and one input have closed forms, and for all else an active-set method finds the
    answer up to rounding; see `safe_envs.engine.qp`. With machine code each decision takes some
    microseconds, and a batch a fraction of one for each state.

    With a control Lyapunov function the filter solves its joint QP instead: min w_u |u|^2 + w_d d^2
    subject to AV + rate V <= d, the constraints and the input bounds (thesis Sec. 4.3.1, 5.4.2).
    Then the filter pursues the goal by itself, whatever is proposed; the action that is best
    without constraints takes the place of the proposed one. A slack of a barrier is dearer than
    any d.

    Conditions that are named without rates get ones, as many as each barrier's relative degree.

    What is measured just now comes in at each call; see `filter`: input bounds, the values of the
    system's `signals` and of the adjustable parameters, and the time. Their rates are part of the
    derivatives; see `ControlAffineSDE`. All else is imported and compiled here; see `warm_up`.

    Args:
        system: that the filter knows.
        barriers: h, safe where h >= 0: a `Barrier` or an expression of states, signals and
            `safe_envs.problem.signals.TIME`; several of them; or (barrier, condition) pairs.
        filters: a `Condition` for all barriers, one for each, or their text, like "hocbf:alpha=2,8"
            or "szcbf+hocbf"; see `parse_condition`. "szcbf" with noise and "hocbf" without by
            default. None with pairs.
        input_bounds: (low, high) of all inputs in physical units, or one such pair for each. An end
            may be infinite unless the filter has a goal, a reciprocal condition or certificate, or
            an uncertain constraint: these go as far as they can.
        weights: diagonal of W, one positive number for each input; ones by default.
        priorities: weights of the squared slacks, one positive number for each barrier; ones by
            default.
        dt: control period in s, for conditions with a sampling margin of first order.
        clf: goal of the joint QP, whose weights replace W.
        adjustable: names of the system's parameters whose values may be given at each call.
        estimator: of the state, for `filter_measurement`.
        instants: control instants of an episode, for conditions with `belief`.
        region: (low, high) of each state, for conditions with `measurement_error`.
        solver: of the QP, one of `qpsolvers.available_solvers`, such as "proxqp", for comparison:
            one state after the other, of affine constraints; ours by default.

    Attributes:
        model: the system, as given.
        pairs: each barrier with its condition.
        parts: the same for each constraint in `constraints`: a barrier that is a minimum has one
            for each of its pieces, see `Condition.parts`.
        qp: the QP, whose model has the adjustable parameters as signals.

    Raises:
        SystemDefinitionError: The system or a barrier is none, or they do not fit.
        RelativeDegreeError: A condition does not suit a barrier.
        ConfigurationError: A condition, a bound, a weight or a name is not allowed, or dt is
            missing.
    """

    def __init__(  # noqa: PLR0913  (what a user states, mostly by keyword)
        self,
        system: ControlAffineSDE,
        barriers: Any,
        filters: Conditions | Sequence[Condition | str] | None = None,
        input_bounds: Any = None,
        weights: Sequence[float] | None = None,
        *,
        priorities: Sequence[float] | None = None,
        dt: float | None = None,
        clf: CLF | None = None,
        adjustable: Sequence[str | sp.Symbol] = (),
        estimator: Estimator | None = None,
        instants: int | None = None,
        region: Sequence[tuple[float, float]] | None = None,
        solver: str | None = None,
        **unknown: Never,
    ) -> None:
        arguments.refuse_unknown(unknown, SafetyFilter.__init__)
        self.model = arguments.require_system(system)
        known = arguments.with_adjustable(system, adjustable)
        self.pairs = arguments.read_pairs(known, barriers, filters)
        arguments.require_goal(clf, weights)
        settings = EstimateSettings(dt, instants, region, certain_states(estimator))
        owners, self.parts = parts_of(self.pairs)
        self.constraints = tuple(
            constraint_at_estimate(c, known, barrier, settings, len(self.parts))
            for barrier, c in self.parts
        )
        known = with_belief_signals(known, self.constraints)
        endless = arguments.takes_endless(self.constraints, clf)
        weights_of = arguments.positive_weights("priorities", priorities, len(self.pairs))
        qp = FilterQP(
            known,
            self.constraints,
            *arguments.read_bounds(known.inputs, input_bounds, endless),
            arguments.positive_weights("weights", weights, known.m),
            [weights_of[i] for i in owners],
            arguments.control_period(self.constraints, dt),
            clf,
            arguments.runtime_symbols(known, self.pairs, self.constraints, clf),
            owners if len(owners) > len(self.pairs) else (),
        )
        self._solver = solver
        self._solve_by(qp, [barrier.name for barrier, _ in self.pairs])
        fixed = [p.name for p in known.parameters]
        self._given = RuntimeArguments(qp, system.parameters, fixed, endless)
        self._state_shape, self._input_shape = (system.n,), (system.m,)
        self.belief_places = belief_places(qp.runtime, system.n)
        self._measured = None if estimator is None else MeasurementFilter(self, estimator)
        self.warm_up()

    def __repr__(self) -> str:
        pairs = ", ".join(f"{spec_of(c)} of {barrier.name}" for barrier, c in self.pairs)
        ends = zip(self.model.inputs, self.qp.low, self.qp.high, strict=True)
        return f"SafetyFilter({pairs}; {', '.join(f'{u} in [{a:g}, {b:g}]' for u, a, b in ends)})"

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        filters: Conditions,
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
        adjustable: Sequence[str | sp.Symbol] = (),
        estimator: Estimator | str | None = None,
    ) -> SafetyFilter:
        """Return the filter for the barriers of a problem.

        Args:
            problem: problem whose model, barriers and input bounds are taken.
            filters: one for every barrier, one for all, or their text; see
                `SafetyFilterWrapper`.
            knowledge: "model" for what the designer believes, "plant" for the true system.
                Conditions that correct the model start from it in any case.
            objective: "nearest" to the proposed action, or "clf" for the joint QP with the
                problem's goal.
            priorities: see the class.
            adjustable: see the class.
            estimator: of a measured problem, or its text, like "ekf".

        Raises:
            SystemDefinitionError: What is given is no problem.
            ConfigurationError: A word is unknown, the number of conditions is wrong, a condition is
                made for another problem, one corrects the model and another knows the plant, or the
                problem has no clf.
        """
        known, each, clf = known_for_problem(problem, filters, knowledge, objective)
        return cls(
            known,
            problem.barriers,
            each,
            input_bounds=problem.input_bounds,
            priorities=priorities,
            dt=problem.dt,
            clf=clf,
            adjustable=adjustable,
            estimator=None if estimator is None else make_estimator(estimator, problem, knowledge),
            instants=problem.steps + 1,
            region=[(v.low, v.high) for v in problem.states],
        )

    def warm_up(self) -> SafetyFilter:
        """Import and compile all that any decision may need, as making one did; return itself."""
        self.compile()
        _ = self._barriers_floats, self._barriers_arrays
        return self

    def filter(
        self,
        x: Any,
        u_nominal: Any,
        *,
        input_bounds: Any = None,
        parameters: Mapping[Any, Any] | None = None,
        t: Any = None,
    ) -> FilterDecision:
        """Decide for one state or a batch.

        Args:
            x: states, shape (n,) or (..., n).
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m).
            input_bounds: bounds in place of the filter's own: (low, high) for all inputs, one such
                pair for each, (m, 2), or for each input of each state, (..., m, 2). An input whose
                bounds are equal is held there.
            parameters: values by name or symbol: of all signals of the system, and of adjustable
                parameters, which else have the system's. Numbers, or for a batch arrays (...,).
            t: time in s, likewise, where a barrier or the system depends on it.

        Returns:
            Arrays with the same leading axes.

        Raises:
            InvalidInputError: A shape does not fit, an entry is no finite real number, or a lower
                bound is above its upper one.
            ConfigurationError: A name is unknown, a value is missing, or a bound is infinite where
                it may not be.
            NumericalError: A constraint has no finite value at a state where its barrier has one.
        """
        x, u = doubles("state", x), doubles("nominal input", u_nominal)
        if x.shape == self._state_shape and u.shape == self._input_shape:
            return self._filter_one(x, u, input_bounds, parameters, t)
        n, m = self.model.n, self.model.m
        if x.shape[-1:] != (n,) or u.shape[-1:] != (m,) or x.shape[:-1] != u.shape[:-1]:
            raise InvalidInputError(
                f"state {x.shape} and input {u.shape} do not fit; give (..., {n}) and (..., {m})"
                " with the same leading axes"
            )
        batch = x.shape[:-1]
        own = None if input_bounds is None else self._given.bounds(input_bounds, batch)
        values = self._given.values(parameters, t, batch)
        states, inputs = (
            tuple(np.ascontiguousarray(part.reshape(-1, part.shape[-1]).T)) for part in (x, u)
        )
        states += tuple(values)
        with np.errstate(all="ignore"):
            require_finite(x, u)
            decision = self.decide_arrays(states, inputs, own)
            barriers = self._barriers_arrays(*states)
            action, margin, active, feasible, slack, cause, proposed, _ = decision
            given = () if proposed is inputs else (proposed,)
            action, margin, active, slack, barrier, *goal = [
                stacked(part, len(inputs[0])).reshape(*batch, len(part))
                for part in (action, margin, active, slack, barriers, *given)
            ]
            if not finite(barrier.T):
                table = self._defined(barrier.reshape(-1, len(barriers)), states)
                barrier = table.reshape(barrier.shape)
        cause = np.broadcast_to(cause, len(inputs[0])).reshape(batch)
        cause, feasible = np.where(active.any(axis=-1), cause, -1), feasible.reshape(batch)
        return FilterDecision(
            action,
            margin,
            active > 0.0,
            feasible,
            slack,
            cause,
            goal[0] if goal else np.array(u),
            barrier,
        )

    def _filter_one(
        self, x: np.ndarray, u: np.ndarray, bounds: Any, parameters: Any, t: Any
    ) -> FilterDecision:
        state, inputs = x.tolist(), u.tolist()
        if not math.isfinite(sum(state) + sum(inputs)):
            with np.errstate(over="ignore"):
                require_finite(x, u)
        own = None if bounds is None else self._given.bounds(bounds)
        if self.qp.runtime or parameters is not None:
            state += self._given.values(parameters, t)
        action, margin, active, feasible, slack, cause, proposed, _ = self.decide_floats(
            state, inputs, own
        )
        try:
            barrier = self._barriers_floats(*state)
        except NO_VALUE:
            barrier = (math.nan,)
        if not math.isfinite(sum(barrier)):
            with np.errstate(all="ignore"):
                barrier = stacked(self._barriers_arrays(*[np.array([c]) for c in state]), 1)[0]
            barrier = self._defined(np.asarray(barrier)[None], state)[0]
        return FilterDecision(
            np.array(action),
            np.array(margin),
            np.array(active),
            feasible,
            np.array(slack),
            cause if True in active else -1,
            u.copy() if proposed is inputs else np.array(proposed),
            np.array(barrier),
        )

    @property
    def measured(self) -> MeasurementFilter:
        """The filter of measurements, which remembers its belief.

        Raises:
            ConfigurationError: There is no estimator.
        """
        if self._measured is None:
            raise ConfigurationError(
                "the filter has no estimator; make it with estimator=..., or give filter() states"
            )
        return self._measured

    @property
    def of_measurements(self) -> str:
        """What of the filter goes with measurements, for errors; "" of a filter of states."""
        if self._measured is not None:
            return f"the estimator {self._measured.estimator.text}"
        return "conditions with belief" if self.belief_places else ""

    def filter_measurement(self, y: Any, u_nominal: Any, **given: Any) -> FilterDecision:
        """Decide at the estimate of the state; see `MeasurementFilter.filter`.

        Args:
            y: what was measured just now, shape (k,) or (..., k).
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m).
            **given: bounds, parameters and t as of `SafetyFilter.filter`.

        Returns:
            The decision; its barriers are those of the estimate, or of the belief.
        """
        return self.measured.filter(y, u_nominal, **given)

    def _solve_by(self, qp: FilterQP, names: Sequence[str]) -> None:
        """Solve a QP; the barriers' names are for messages."""
        self.qp, self._names = qp, names
        self._qp_solver = FilterQPSolver(qp, self._solver)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        # Another process has not imported yet what decisions may need.
        self.compile()

    def compile(self) -> None:
        """Import and compile all that any decision may need."""
        self._qp_solver.compile()

    def decide_floats(
        self, x: Sequence[float], u: Sequence[float], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Decide for one state.

        Args:
            x: finite components of the state, followed by those of `FilterQP.runtime`.
            u: m finite components of the proposed input.
            bounds: m lower and m upper input bounds; by default those of the QP.

        Returns:
            The decision in components.

        Raises:
            NumericalError: The constraint has no finite value.
        """
        try:
            return self._qp_solver.floats(x, u, bounds)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, x) from error

    def decide_arrays(
        self, x: Components, u: Components, bounds: Bounds | None = None
    ) -> FilterDecision:
        """Decide for a batch; as `decide_floats`, with an array (B,) for each component.

        Args:
            x: components of the states, followed by those of `FilterQP.runtime`.
            u: m components of the proposed inputs.
            bounds: m lower and m upper input bounds, each a float or an array (B,); by default
                those of the QP.

        Returns:
            The decisions in components.
        """
        try:
            return self._qp_solver.arrays(x, u, bounds)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, [float(c[error.index]) for c in x]) from error

    def undefined(
        self, what: str, x: Sequence[float], which: Sequence[int] | None = None
    ) -> NumericalError:
        """Return the error of something without a finite value.

        Args:
            what: the constraint, the goal or the barrier.
            x: components of the state, followed by those of `FilterQP.runtime`.
            which: of the barriers; None to find out.
        """
        at = ", ".join(f"{s} = {value:.6g}" for s, value in zip(self.qp.symbols, x, strict=True))
        if which is None and "goal" not in what:
            owners = self.qp.owner_of_each
            which = list(dict.fromkeys(owners[i] for i in self._qp_solver.undefined_at(x)))
        names = f" on {', '.join([self._names[i] for i in which])}" if which else ""
        return NumericalError(
            f"{what}{names} has no finite value at {at}; check it and the model there"
        )

    def by_constraint(self) -> Any:
        """Return the filter with an entry for each constraint in its decisions.

        Of itself, decisions have one for each barrier, which may have several constraints.
        """
        if not self.qp.owners:
            return self
        found: Any = copy.copy(self)
        found.pairs = self.parts
        names = [barrier.name for barrier, _ in self.parts]
        found._solve_by(replace(self.qp, owners=()), names)
        for name in ("_barriers_floats", "_barriers_arrays"):
            vars(found).pop(name, None)
        return found.warm_up()

    @cached_property
    def _barriers_floats(self) -> Any:
        return self._compile_barriers("floats")

    @cached_property
    def _barriers_arrays(self) -> Any:
        return self._compile_barriers("arrays")

    def _compile_barriers(self, flavour: Flavour) -> Any:
        # A condition with a belief keeps the barrier of that.
        kept = [
            barrier.expression
            if c.belief is None
            else sp.Min(*[self.constraints[i].chain[0] for i in members])
            for (barrier, c), members in zip(self.pairs, self.qp.members, strict=True)
        ]
        expressions = [self.qp.model.numeric(h) for h in kept]
        return compile_function(self.qp.symbols, expressions, flavour)

    def barriers_at(self, values: Sequence[Any]) -> Sequence[Any]:
        """Return the barriers at a batch, as numbers or arrays (B,).

        Args:
            values: of the symbols of `qp`, arrays (B,).
        """
        return defined_arrays(self._barriers_arrays(*values))

    def _defined(self, barrier: np.ndarray, x: Sequence[Any]) -> np.ndarray:
        """Return barriers (B, k) at states, -inf where one has no value; raise on overflow."""
        bad = ~np.isfinite(barrier)
        partial = self.qp.partial_barriers
        lost = [i for i in range(bad.shape[1]) if i not in partial and bad[:, i].any()]
        if lost:
            at = int(bad[:, lost[0]].argmax())
            raise self.undefined("the barrier", [float(np.atleast_1d(c)[at]) for c in x], lost[:1])
        return np.where(bad, -np.inf, barrier)
