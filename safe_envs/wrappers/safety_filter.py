"""A safety filter: from a state and a proposed input to the nearest input that the conditions
allow. Free of gym.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import (
    Components,
    Flavour,
    compile_function,
    filled,
    finite,
    stacked,
)
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    NumericalError,
    SystemDefinitionError,
    nearest,
)
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import SafetyProblem
from safe_envs.validators import real_array
from safe_envs.wrappers.conditions import AffineConstraint, Condition, parse_conditions
from safe_envs.wrappers.filter_qp import Decision, Program, Solver, UndefinedRowError

_DOUBLE = np.dtype(np.float64)
_NO_VALUE = (ArithmeticError, ValueError, TypeError)
"""What formulas in plain floats raise: by overflow, beyond a function's domain, or comparing a root
that is complex there."""


class FilterResult(NamedTuple):
    """What a filter decides, for one state or a batch (leading axes `...`), with m inputs and k
    barriers.

    Attributes:
        action: executed input, shape (..., m), inside the box.
        barrier: value of each barrier, shape (..., k).
        margin: of each row at the action, less what a sampling margin or a reciprocal condition
            demand, shape (..., k); where a reciprocal condition means nothing, the rate of h.
        active: rows that bind or cannot be met, shape (..., k).
        feasible: whether some action in the box meets every row, shape (...). Where it is False,
            the action is the least-violating one.
        slack: by how much the action misses each row where the rows cannot be met, 0 elsewhere,
            shape (..., k).
        cause: index of the active row that lies furthest from the proposed input, shape (...); -1
            if no row is active.
    """

    action: np.ndarray
    barrier: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: Any
    slack: np.ndarray
    cause: Any


class SafetyFilter:
    """min 1/2 |u - u_nom|^2_W subject to a_i(x) u + b_i(x) >= 0 for every barrier, and the box.

    Where the rows cannot all be met, the sum of their squared slacks is as small as can be,
    weighted by the priorities.

    One row has a closed form for any number of inputs, and any number of rows an exact solution for
    one and two inputs; others go to ProxQP and an active-set method, whose answers are right to
    rounding for rows and inputs up to a million apart.

    A row counts as met where it misses by no more than the rounding of its terms; see
    `safe_envs.wrappers.qp.rows`.

    With a control Lyapunov function the objective is its joint program instead, min w_u |u|^2 + w_d
    d^2 subject to AV + rate V <= d, the rows and the box (thesis Sec. 4.3.1, 5.4.2): the filter
    pursues the goal by itself, and whatever is proposed does not matter. What takes its place is
    the action that is best without rows. The slack d is the goal's; that of a barrier is dearer
    than any goal, and flagged.

    Args:
        model: the system that the filter believes in.
        rows: (barrier, condition) pairs.
        box: (low, high) of each input, in physical units.
        weights: diagonal of W, one positive number for each input; ones by default.
        priorities: weights of the squared slacks, one positive number for each row; ones by
            default.
        dt: control period in s, for conditions with a margin of first order.
        clf: goal of the joint program, whose weights replace W.

    Raises:
        SystemDefinitionError: there is no row, or a barrier does not fit the model.
        RelativeDegreeError: a condition does not suit a barrier.
        ConfigurationError: the box, a weight or a priority is not allowed, or dt is missing.
    """

    def __init__(
        self,
        model: ControlAffineSDE,
        rows: Sequence[tuple[Barrier, Condition]],
        box: Sequence[tuple[float, float]],
        weights: Sequence[float] | None = None,
        *,
        priorities: Sequence[float] | None = None,
        dt: float | None = None,
        clf: CLF | None = None,
    ) -> None:
        if not rows:
            raise SystemDefinitionError("a filter needs at least one (barrier, condition) pair")
        if clf is not None and weights is not None:
            raise ConfigurationError(
                "weights and clf were given; the weights of a joint program are those of the clf"
            )
        self.model = model
        self.rows = tuple(rows)
        self._clf = clf
        self.constraints = tuple(
            condition.constraint(model, barrier) for barrier, condition in self.rows
        )
        self.program = Program(
            model,
            self.constraints,
            *_bounds(model, box),
            weights=_positive("weights", weights, model.m),
            priorities=_positive("priorities", priorities, len(self.rows)),
            dt=_period(self.constraints, dt),
            clf=clf,
        )
        self._floats, self._arrays = Solver(self.program, "floats"), Solver(self.program, "arrays")
        self._state_shape, self._input_shape = (model.n,), (model.m,)
        self._single = len(self.rows) == 1 and self.program.plain

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        conditions: Condition | Sequence[Condition] | str,
        knowledge: str = "model",
        objective: str = "nearest",
        priorities: Sequence[float] | None = None,
    ) -> SafetyFilter:
        """The filter for the barriers of a problem.

        Args:
            problem: whose model, barriers and box are taken.
            conditions: one for every barrier, one for all, or their text; see
                `SafetyFilterWrapper`.
            knowledge: "model" for what the designer believes, "plant" for the true system.
                Conditions that correct the model start from it in any case.
            objective: "nearest" to the proposed action, or "clf" for the joint program with the
                problem's goal.
            priorities: see the class.

        Raises:
            ConfigurationError: a word is unknown, the number of conditions is wrong, a condition is
                made for another problem or corrects the model beside one that knows the plant, or
                the problem has no clf.
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
        count, given = (
            len(problem.barriers),
            parse_conditions(conditions, problem) if isinstance(conditions, str) else conditions,
        )
        each = (given,) * count if isinstance(given, Condition) else given
        if not isinstance(each, Sequence) or not all(
            isinstance(condition, Condition) for condition in each
        ):
            raise ConfigurationError(
                f"condition = {conditions!r}; give a Condition, one for each barrier, or their"
                " text, like 'scbf'"
            )
        if len(each) != count:
            raise ConfigurationError(
                f"{len(each)} conditions for the {count} barriers of {problem.name}; give one for"
                " each"
            )
        for condition in each:
            condition.require_fit(problem)
        correcting = [condition.name for condition in each if condition.corrects_model]
        if knowledge == "plant" and 0 < len(correcting) < count:
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
            [self.model.numeric(barrier.expression) for barrier, _ in self.rows],
            flavour,
        )

    def filter(self, x: Any, u_nominal: Any) -> FilterResult:
        """Decide for one state (n,) and input (m,), or for batches (..., n) and (..., m).

        Raises:
            InvalidInputError: a shape does not fit, or an entry is no finite real number.
            NumericalError: the constraint has no finite value at a state.
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
            parts = (decision.action, barriers, *decision[1:3], decision.slack)
            action, barrier, margin, active, slack = [
                stacked(part, len(inputs[0])).reshape(*batch, len(part)) for part in parts
            ]
            if not finite(barrier.T):
                self._require_values(barrier.reshape(-1, len(barriers)), states)
        cause = np.where(
            active.any(axis=-1), np.broadcast_to(decision.cause, len(inputs[0])).reshape(batch), -1
        )
        return FilterResult(
            action, barrier, margin, active > 0.0, decision.feasible.reshape(batch), slack, cause
        )

    def _filter_one(self, x: np.ndarray, u: np.ndarray) -> FilterResult:
        state, inputs = x.tolist(), u.tolist()
        if not math.isfinite(sum(state) + sum(inputs)):
            with np.errstate(over="ignore"):
                _require_finite(x, u)
        action, margin, active, feasible, slack, cause, _ = self.decide_floats(state, inputs)
        try:
            barrier = self._barriers_floats(*state)
        except _NO_VALUE:
            barrier = (math.nan,)
        if not math.isfinite(sum(barrier)):
            with np.errstate(all="ignore"):
                barrier = stacked(self._barriers_arrays(*[np.array([c]) for c in state]), 1)[0]
            self._require_values(barrier[None], state)
        return FilterResult(
            np.array(action),
            np.array(barrier),
            np.array(margin),
            np.array(active),
            feasible,
            np.array(slack),
            cause if True in active else -1,
        )

    def _require_values(self, barrier: np.ndarray, x: Sequence[Any]) -> None:
        """Raise NumericalError where a barrier (B, k) at states, given by components, is not
        finite.
        """
        bad = np.flatnonzero(~np.isfinite(barrier).all(axis=1))
        if bad.size:
            raise self._undefined("the barrier", [float(np.atleast_1d(c)[bad[0]]) for c in x])

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> Decision:
        """Decide for one state, given and returned component by component; the components must be
        finite.
        """
        try:
            found = self._floats.one_row(x, u) if self._single else self._floats.solve(x, u)
        except UndefinedRowError as error:
            raise self._undefined(error.what, x) from error
        except _NO_VALUE:
            # Plain floats raise where arrays overflow to a number or go on without: what is right
            # for the batch is right here.
            found = self._decide_one_of_batch(x, u)
        return found

    def _decide_one_of_batch(self, x: Sequence[float], u: Sequence[float]) -> Decision:
        found = self.decide_arrays(*[tuple(np.array([c]) for c in part) for part in (x, u)])
        *parts, cause, proposed = [
            [filled(c, (1,)).item() for c in (part if isinstance(part, Sequence) else (part,))]
            for part in found
        ]
        action, margin, active, (feasible,), slack = parts
        return Decision(action, margin, active, feasible, slack, cause[0], proposed)

    def decide_arrays(self, x: Components, u: Components) -> Decision:
        """Decide for a batch, given and returned component by component, each an array (B,) of
        finite numbers.
        """
        # What overflows or has no value is found below, which says where.
        with np.errstate(all="ignore"):
            return self._decide(x, u)

    def _decide(self, x: Components, u: Components) -> Decision:
        try:
            return self._arrays.one_row(x, u) if self._single else self._arrays.solve(x, u)
        except UndefinedRowError as error:
            raise self._undefined(error.what, [float(c[error.index]) for c in x]) from error

    def _undefined(self, what: str, x: Sequence[float]) -> NumericalError:
        at = ", ".join(f"{s} = {value:.6g}" for s, value in zip(self.model.states, x, strict=True))
        names = (
            "" if "goal" in what else f" on {', '.join(barrier.name for barrier, _ in self.rows)}"
        )
        return NumericalError(
            f"{what}{names} has no finite value at {at}; check it and the model there"
        )


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


def _bounds(
    model: ControlAffineSDE, box: Sequence[tuple[float, float]]
) -> tuple[list[float], list[float]]:
    if len(box) != model.m:
        raise ConfigurationError(
            f"the box has {len(box)} intervals; the model has {model.m} inputs"
        )
    low, high = [float(pair[0]) for pair in box], [float(pair[1]) for pair in box]
    for symbol, lo, hi in zip(model.inputs, low, high, strict=True):
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            raise ConfigurationError(
                f"box of {symbol} is [{lo}, {hi}]; it needs finite bounds, the lower one below the"
                " upper"
            )
    return low, high


def _positive(name: str, given: Sequence[float] | None, count: int) -> list[float]:
    values = [1.0] * count if given is None else [float(v) for v in given]
    if len(values) != count or not all(math.isfinite(v) and v > 0 for v in values):
        raise ConfigurationError(f"{name} = {values}; give {count} positive numbers")
    return values


def _period(constraints: Sequence[AffineConstraint], dt: float | None) -> float:
    if dt is None:
        if any(constraint.change is not None for constraint in constraints):
            raise ConfigurationError(
                "a sampling margin of first order needs the control period: SafetyFilter(...,"
                " dt=...)"
            )
        return 0.0
    if not 0 < dt < math.inf:
        raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")
    return float(dt)
