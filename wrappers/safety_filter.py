"""A safety filter: from a state and a proposed input to the nearest input that the conditions allow. Free of gym."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safe_envs.barrier import Barrier
from safe_envs.codegen import Components, Flavour, compile_function, constants, finite, stacked
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError, SystemDefinitionError
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from wrappers.conditions import Condition
from wrappers.qp.one_row import project_arrays, project_floats


class FilterResult(NamedTuple):
    """What a filter decides, for one state or a batch (leading axes `...`), with m inputs and k barriers.

    Attributes:
        action: executed input, shape (..., m), inside the box.
        barrier: value of each barrier, shape (..., k).
        margin: a u + b of each row at the action, shape (..., k).
        active: rows that bind or cannot be met, shape (..., k).
        feasible: whether some action in the box meets every row, shape (...). Where it is False, the action is the
            least-violating one.
        slack: by how much the action misses each row where the rows cannot be met, 0 elsewhere, shape (..., k).
    """

    action: np.ndarray
    barrier: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: Any
    slack: np.ndarray


class Decision(NamedTuple):
    """What the thin wrappers read, by components: floats, or arrays over the batch; entries as in `FilterResult`."""

    action: Sequence[Any]
    margin: Sequence[Any]
    active: Sequence[Any]
    feasible: Any
    slack: Sequence[Any]


class SafetyFilter:
    """min 1/2 |u - u_nom|^2_W subject to a_i(x) u + b_i(x) >= 0 for every barrier, and the box.

    One row has a closed form, exact for any number of inputs; several go to ProxQP.

    Args:
        model: the system that the filter believes in.
        rows: (barrier, condition) pairs.
        box: (low, high) of each input, in physical units.
        weights: diagonal of W, one positive number for each input; ones by default.

    Raises:
        SystemDefinitionError: there is no row, or a barrier does not fit the model.
        RelativeDegreeError: a condition does not suit a barrier.
        ConfigurationError: the box or the weights are not allowed.
    """

    def __init__(
        self,
        model: ControlAffineSDE,
        rows: Sequence[tuple[Barrier, Condition]],
        box: Sequence[tuple[float, float]],
        weights: Sequence[float] | None = None,
    ) -> None:
        if not rows:
            raise SystemDefinitionError("a filter needs at least one (barrier, condition) pair")
        self.model = model
        self.rows = tuple(rows)
        self._low, self._high = _bounds(model, box)
        self._low_arrays, self._high_arrays = constants(self._low), constants(self._high)
        self._weights = _positive_weights(model, weights)
        self.constraints = tuple(condition.constraint(model, barrier) for barrier, condition in self.rows)

    @classmethod
    def for_problem(cls, problem: SafetyProblem, condition: Condition, knowledge: str = "model") -> SafetyFilter:
        """The filter that puts one condition on every barrier of a problem.

        Args:
            problem: whose model, barriers and box are taken.
            condition: for every barrier.
            knowledge: "model" for what the designer believes, "plant" for the true system.
        """
        if knowledge not in ("model", "plant"):
            raise ConfigurationError(f"knowledge = {knowledge!r}; allowed: model, plant")
        known = problem.model if knowledge == "model" else problem.plant
        return cls(known, [(b, condition) for b in problem.barriers], problem.box)

    @cached_property
    def _rows_floats(self) -> Any:
        return self._compile(self._row_expressions(), "floats")

    @cached_property
    def _rows_arrays(self) -> Any:
        return self._compile(self._row_expressions(), "arrays")

    @cached_property
    def _barriers_floats(self) -> Any:
        return self._compile([barrier.expression for barrier, _ in self.rows], "floats")

    @cached_property
    def _barriers_arrays(self) -> Any:
        return self._compile([barrier.expression for barrier, _ in self.rows], "arrays")

    def _row_expressions(self) -> list[Any]:
        """a_1, ..., a_m, b of each row, one row after the other."""
        return [e for constraint in self.constraints for e in (*constraint.coefficient, constraint.offset)]

    def _compile(self, expressions: Sequence[Any], flavour: Flavour) -> Any:
        return compile_function(self.model.states, [self.model.numeric(e) for e in expressions], flavour)

    def filter(self, x: Any, u_nominal: Any) -> FilterResult:
        """Decide for one state (n,) and input (m,), or for batches (..., n) and (..., m).

        Raises:
            InvalidInputError: a shape does not fit, or an entry is not finite.
            NumericalError: the constraint has no finite value at a state.
        """
        x, u = np.asarray(x, dtype=np.float64), np.asarray(u_nominal, dtype=np.float64)
        n, m = self.model.n, self.model.m
        if x.shape[-1:] != (n,) or u.shape[-1:] != (m,) or x.shape[:-1] != u.shape[:-1]:
            raise InvalidInputError(
                f"state {x.shape} and input {u.shape} do not fit; give (..., {n}) and (..., {m}) with the same leading axes"
            )
        if x.ndim == 1:
            return self._filter_one(x, u)
        _require_finite(x, u)
        batch = x.shape[:-1]
        states, inputs = (tuple(np.ascontiguousarray(part.reshape(-1, part.shape[-1]).T)) for part in (x, u))
        decision = self.decide_arrays(states, inputs)
        parts = (decision.action, self._barriers_arrays(*states), *decision[1:3], decision.slack)
        action, barrier, margin, active, slack = [stacked(part, len(inputs[0])).reshape(*batch, len(part)) for part in parts]
        return FilterResult(action, barrier, margin, active > 0.0, decision.feasible.reshape(batch), slack)

    def _filter_one(self, x: np.ndarray, u: np.ndarray) -> FilterResult:
        state, inputs = x.tolist(), u.tolist()
        if not math.isfinite(sum(state) + sum(inputs)):
            _require_finite(x, u)
        action, margin, active, feasible, slack = self.decide_floats(state, inputs)
        barrier = self._barriers_floats(*state)
        return FilterResult(np.array(action), np.array(barrier), np.array(margin), np.array(active), feasible, np.array(slack))

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> Decision:
        """Decide for one state, given and returned component by component; the components must be finite."""
        if len(self.rows) > 1:
            return self._decide_one_of_several(x, u)
        try:
            *a, b = self._rows_floats(*x)
        except (OverflowError, ZeroDivisionError, ValueError) as error:
            raise self._undefined(x) from error
        action, margin, active, feasible = project_floats(a, b, u, self._low, self._high, self._weights)
        if not math.isfinite(margin):
            raise self._undefined(x)
        return Decision(action, (margin,), (active,), feasible, (0.0 if feasible else -margin,))

    def decide_arrays(self, x: Components, u: Components) -> Decision:
        """Decide for a batch, given and returned component by component, each an array (B,) of finite numbers."""
        # What overflows or has no value is found below, which says where.
        with np.errstate(all="ignore"):
            values = self._rows_arrays(*x)
            if len(self.rows) > 1:
                return self._decide_several(x, u, values)
            *a, b = values
            action, margin, active, feasible = project_arrays(a, b, u, self._low_arrays, self._high_arrays, self._weights)
        if not finite(margin):
            self._require_defined(x, margin)
        met = np.count_nonzero(feasible) == len(feasible)
        slack = np.zeros(len(margin)) if met else np.where(feasible, 0.0, -margin)
        return Decision(action, (margin,), (active,), feasible, (slack,))

    def _decide_several(self, x: Components, u: Components, values: Components) -> Decision:
        # Imported here, since a filter of one row needs no solver.
        from wrappers.qp.several_rows import project

        size = len(u[0])
        rows = stacked(values, size).reshape(size, -1, self.model.m + 1)
        self._require_defined(x, rows.sum(axis=(1, 2)))
        found = project(
            rows[:, :, :-1], rows[:, :, -1], stacked(u, size), np.array(self._low), np.array(self._high), np.array(self._weights)
        )
        slack = np.where(found.feasible[:, None], 0.0, np.maximum(-found.margin, 0.0))
        return Decision(tuple(found.u.T), tuple(found.margin.T), tuple(found.active.T), found.feasible, tuple(slack.T))

    def _decide_one_of_several(self, x: Sequence[float], u: Sequence[float]) -> Decision:
        batch = self.decide_arrays(tuple(np.array([c]) for c in x), tuple(np.array([c]) for c in u))
        action, margin, active, slack = [[c.item() for c in part] for part in (*batch[:3], batch.slack)]
        return Decision(action, margin, active, batch.feasible.item(), slack)

    def _undefined(self, x: Sequence[float]) -> NumericalError:
        at = ", ".join(f"{s} = {value:.6g}" for s, value in zip(self.model.states, x, strict=True))
        names = ", ".join(barrier.name for barrier, _ in self.rows)
        return NumericalError(f"the constraint on {names} has no finite value at {at}; check the barrier and the model there")

    def _require_defined(self, x: Components, totals: np.ndarray) -> None:
        bad = np.flatnonzero(~np.isfinite(totals))
        if bad.size:
            raise self._undefined([float(c[bad[0]]) for c in x])


def _require_finite(x: np.ndarray, u: np.ndarray) -> None:
    for what, values in (("state", x), ("nominal input", u)):
        finite = np.isfinite(values)
        if not finite.all():
            where = np.argwhere(~finite)[0].tolist()
            raise InvalidInputError(f"the {what} has the entry {values[tuple(where)]} at {where}; a filter needs finite numbers")


def _bounds(model: ControlAffineSDE, box: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    if len(box) != model.m:
        raise ConfigurationError(f"the box has {len(box)} intervals; the model has {model.m} inputs")
    low, high = [float(pair[0]) for pair in box], [float(pair[1]) for pair in box]
    for symbol, lo, hi in zip(model.inputs, low, high, strict=True):
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            raise ConfigurationError(f"box of {symbol} is [{lo}, {hi}]; it needs finite bounds, the lower one below the upper")
    return low, high


def _positive_weights(model: ControlAffineSDE, weights: Sequence[float] | None) -> list[float]:
    values = [1.0] * model.m if weights is None else [float(w) for w in weights]
    if len(values) != model.m or not all(math.isfinite(w) and w > 0 for w in values):
        raise ConfigurationError(f"weights = {values}; give {model.m} positive numbers")
    return values
