"""The safety filter: from a state and a proposed input to the nearest input that is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Flavour, compile_function, finite, stacked
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionError, nearest
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import SafetyProblem
from safe_envs.validators import real_array
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.conditions.spec_text import Conditions, conditions_for
from safe_envs.wrappers.filter_qp import FilterDecision, FilterQP
from safe_envs.wrappers.filter_qp.component_filter import NO_VALUE, ComponentFilter
from safe_envs.wrappers.filter_qp.qp import control_period, input_bounds, positive_weights

_DOUBLE = np.dtype(np.float64)


class SafetyFilter(ComponentFilter):
    """Chooses the input nearest to a proposed one that every condition allows.

    It minimises 1/2 |u - u_nom|^2_W subject to a_i(x) u + b_i(x) >= 0 for every barrier and to the
    input bounds. Where the constraints cannot all be met, the sum of their squared slacks, weighted
    by the priorities, is as small as can be. A constraint counts as met where it is violated by no
    more than the rounding of its terms; see `safe_envs.wrappers.qp.rounding`.

    One constraint has a closed form for any number of inputs, and any number of constraints an
    exact solution for one and two inputs. Others go to ProxQP and an active-set method, whose
    answers are right to rounding for coefficients up to a million apart.

    With a control Lyapunov function the filter solves its joint QP instead: min w_u |u|^2 + w_d d^2
    subject to AV + rate V <= d, the constraints and the input bounds (thesis Sec. 4.3.1, 5.4.2).
    Then the filter pursues the goal by itself, whatever is proposed; the action that is best
    without constraints takes the place of the proposed one. A slack of a barrier is dearer than
    any d.

    Args:
        model: system that the filter knows.
        pairs: each barrier with its condition.
        box: (low, high) of each input, in physical units.
        weights: diagonal of W, one positive number for each input; ones by default.
        priorities: weights of the squared slacks, one positive number for each constraint; ones by
            default.
        dt: control period in s, for conditions with a sampling margin of first order.
        clf: goal of the joint QP, whose weights replace W.

    Raises:
        SystemDefinitionError: There is no constraint, or a barrier does not fit the model.
        RelativeDegreeError: A condition does not suit a barrier.
        ConfigurationError: The input bounds, a weight or a priority is not allowed, or dt is
            missing.
    """

    def __init__(
        self,
        model: ControlAffineSDE,
        pairs: Sequence[tuple[Barrier, Condition]],
        box: Sequence[tuple[float, float]],
        weights: Sequence[float] | None = None,
        *,
        priorities: Sequence[float] | None = None,
        dt: float | None = None,
        clf: CLF | None = None,
    ) -> None:
        if not pairs:
            raise SystemDefinitionError("a filter needs at least one (barrier, condition) pair")
        if clf is not None and weights is not None:
            raise ConfigurationError(
                "weights and clf were given; the weights of a joint QP are those of the clf"
            )
        self.model = model
        self.pairs = tuple(pairs)
        self.constraints = tuple(
            condition.constraint(model, barrier) for barrier, condition in self.pairs
        )
        low, high = input_bounds(model, box)
        weights = positive_weights("weights", weights, model.m)
        priorities = positive_weights("priorities", priorities, len(pairs))
        period = control_period(self.constraints, dt)
        qp = FilterQP(model, self.constraints, low, high, weights, priorities, period, clf)
        super().__init__(qp, [barrier.name for barrier, _ in self.pairs])
        self._state_shape, self._input_shape = (model.n,), (model.m,)

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        conditions: Conditions,
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
    ) -> SafetyFilter:
        """Return the filter for the barriers of a problem.

        Args:
            problem: problem whose model, barriers and box are taken.
            conditions: one for every barrier, one for all, or their text; see
                `SafetyFilterWrapper`.
            knowledge: "model" for what the designer believes, "plant" for the true system.
                Conditions that correct the model start from it in any case.
            objective: "nearest" to the proposed action, or "clf" for the joint QP with the
                problem's goal.
            priorities: see the class.

        Raises:
            ConfigurationError: A word is unknown, the number of conditions is wrong, a condition is
                made for another problem, one corrects the model and another knows the plant, or the
                problem has no clf.
        """
        for name, given, allowed in (
            ("knowledge", knowledge, ("model", "plant")),
            ("objective", objective, ("nearest", "clf")),
        ):
            if given not in allowed:
                raise ConfigurationError(f"{name} = {given!r}; {nearest(str(given), allowed)}")
        if objective == "clf" and problem.clf is None:
            raise ConfigurationError(
                f"objective = 'clf', but {problem.name} has no control Lyapunov function; use"
                " 'nearest'"
            )
        each = conditions_for(problem, conditions)
        correcting = [condition.name for condition in each if condition.corrects_model]
        if knowledge == "plant" and 0 < len(correcting) < len(each):
            raise ConfigurationError(
                f"{correcting[0]} corrects the model, and the other barriers' conditions know the"
                " plant; use knowledge='model'"
            )
        known = problem.model if knowledge == "model" or correcting else problem.plant
        clf = problem.clf if objective == "clf" else None
        return cls(
            known,
            list(zip(problem.barriers, each, strict=True)),
            problem.box,
            priorities=priorities,
            dt=problem.dt,
            clf=clf,
        )

    @cached_property
    def _barriers_floats(self) -> Any:
        return self._compile_barriers("floats")

    @cached_property
    def _barriers_arrays(self) -> Any:
        return self._compile_barriers("arrays")

    def _compile_barriers(self, flavour: Flavour) -> Any:
        return compile_function(
            self.model.states,
            [self.model.numeric(barrier.expression) for barrier, _ in self.pairs],
            flavour,
        )

    def filter(self, x: Any, u_nominal: Any) -> FilterDecision:
        """Decide for one state or a batch.

        Args:
            x: states, shape (n,) or (..., n).
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m).

        Returns:
            Arrays with the same leading axes.

        Raises:
            InvalidInputError: A shape does not fit, or an entry is no finite real number.
            NumericalError: The constraint has no finite value at a state.
        """
        x, u = _doubles("state", x), _doubles("nominal input", u_nominal)
        if x.shape == self._state_shape and u.shape == self._input_shape:
            return self._filter_one(x, u)
        n, m = self.model.n, self.model.m
        if x.shape[-1:] != (n,) or u.shape[-1:] != (m,) or x.shape[:-1] != u.shape[:-1]:
            raise InvalidInputError(
                f"state {x.shape} and input {u.shape} do not fit; give (..., {n}) and (..., {m})"
                " with the same leading axes"
            )
        batch = x.shape[:-1]
        states, inputs = (
            tuple(np.ascontiguousarray(part.reshape(-1, part.shape[-1]).T)) for part in (x, u)
        )
        with np.errstate(all="ignore"):
            _require_finite(x, u)
            decision = self._decide(states, inputs)
            barriers = self._barriers_arrays(*states)
            action, margin, active, feasible, slack, cause, proposed, _ = decision
            given = () if proposed is inputs else (proposed,)
            action, margin, active, slack, barrier, *goal = [
                stacked(part, len(inputs[0])).reshape(*batch, len(part))
                for part in (action, margin, active, slack, barriers, *given)
            ]
            if not finite(barrier.T):
                self._require_values(barrier.reshape(-1, len(barriers)), states)
        cause = np.broadcast_to(cause, len(inputs[0])).reshape(batch)
        cause, feasible = np.where(active.any(axis=-1), cause, -1), feasible.reshape(batch)
        return FilterDecision(
            action, margin, active > 0.0, feasible, slack, cause, goal[0] if goal else u, barrier
        )

    def _filter_one(self, x: np.ndarray, u: np.ndarray) -> FilterDecision:
        state, inputs = x.tolist(), u.tolist()
        if not math.isfinite(sum(state) + sum(inputs)):
            with np.errstate(over="ignore"):
                _require_finite(x, u)
        action, margin, active, feasible, slack, cause, proposed, _ = self.decide_floats(
            state, inputs
        )
        try:
            barrier = self._barriers_floats(*state)
        except NO_VALUE:
            barrier = (math.nan,)
        if not math.isfinite(sum(barrier)):
            with np.errstate(all="ignore"):
                barrier = stacked(self._barriers_arrays(*[np.array([c]) for c in state]), 1)[0]
            self._require_values(barrier[None], state)
        return FilterDecision(
            np.array(action),
            np.array(margin),
            np.array(active),
            feasible,
            np.array(slack),
            cause if True in active else -1,
            u if proposed is inputs else np.array(proposed),
            np.array(barrier),
        )

    def _require_values(self, barrier: np.ndarray, x: Sequence[Any]) -> None:
        """Raise NumericalError where a barrier (B, k) at states is not finite."""
        bad = np.flatnonzero(~np.isfinite(barrier).all(axis=1))
        if bad.size:
            raise self.undefined("the barrier", [float(np.atleast_1d(c)[bad[0]]) for c in x])


def _doubles(what: str, given: Any) -> np.ndarray:
    return (
        given
        if type(given) is np.ndarray and given.dtype is _DOUBLE
        else real_array(what, given).astype(np.float64)
    )


def _require_finite(x: np.ndarray, u: np.ndarray) -> None:
    for what, values in (("state", x), ("nominal input", u)):
        if not (finite(values) or np.isfinite(values).all()):
            where = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InvalidInputError(
                f"the {what} has the entry {values[tuple(where)]} at {where}; a filter needs finite"
                " numbers"
            )
