"""A safety filter for a plant that executes an input some control periods after it is sent."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import real_array
from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.defined import NO_VALUE
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.episode import DelayLine
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    NumericalError,
    require_whole,
    shown,
)
from safe_envs.filters.arguments import RuntimeArguments, doubles, require_finite
from safe_envs.filters.measurement_filter import components_of
from safe_envs.filters.qp import FilterDecision, FilterQP
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.actuators import require_delay, resting_input
from safe_envs.problem.signals import TIME
from safe_envs.text import finite_number


class Prediction:
    """Where a model will be once the inputs that are under way have been executed.

    A period is one of the simulator with every random number 0: classical Runge-Kutta for a model
    without noise, and Euler for one with noise, which is the mean of a simulated sub-step. So the
    prediction is that of the simulator to the last bit where the plant is the model and has no
    noise; and the mean of the simulated state where f and g u are affine in x. Elsewhere the error
    of the prediction is what the model does not know: it grows with the delay, and no condition
    accounts for it.

    Args:
        model: that is believed.
        dt: control period in s.
        substeps: integration steps in it.
    """

    def __init__(self, model: ControlAffineSDE, dt: float, substeps: int = 1) -> None:
        self._floats = Integrator(model, dt, substeps, "floats")
        self._arrays = Integrator(model, dt, substeps, "arrays")

    def of_one(self, x: Sequence[float], inputs: Iterable[Sequence[float]]) -> Sequence[float]:
        """Return the components of the state after some inputs, each for one control period.

        Args:
            x: n components of the state.
            inputs: m components each, the first one first.

        Raises:
            NumericalError: The prediction leaves the finite numbers.
        """
        found: Components = tuple(x)
        try:
            for u in inputs:
                found = self._floats.step(found, u, [0.0] * self._floats.channels)
            if not math.isfinite(sum(found)):
                raise ArithmeticError(f"it ends at {found}")
        except NO_VALUE as error:
            raise NumericalError(
                f"the model has no finite prediction from {tuple(x)} under the inputs that were"
                f" sent: {error}"
            ) from error
        return found

    def of_batch(self, x: Components, inputs: Iterable[Components]) -> Components:
        """Return the same for a batch; what is not finite stays so.

        Args:
            x: n components (B,) of the states.
            inputs: m components (B,) each.

        Returns:
            n components (B,).
        """
        found = x
        with np.errstate(all="ignore"):
            for u in inputs:
                found = self._arrays.step(found, u, [np.float64(0.0)] * self._arrays.channels)
        return tuple([np.broadcast_to(c, np.shape(x[0])) for c in found])


def with_runtime_states(qp: FilterQP) -> ControlAffineSDE:
    """Return a filter's model with what is given at each call as states, by their rates.

    Args:
        qp: of the filter.
    """
    model, m = qp.model, qp.model.m
    if not qp.runtime:
        return model
    moving = {s: sp.Symbol(f"{s.name}_at_run_time", real=True) for s in qp.runtime}
    rates = [sp.sympify(1 if s == TIME else model.signals[s]) for s in qp.runtime]

    def below(matrix: Any, rows: Any) -> Any:
        return sp.Matrix(matrix).col_join(rows).xreplace(moving)

    count = len(rates)
    return ControlAffineSDE(
        states=(*model.states, *moving.values()),
        inputs=model.inputs,
        drift=below(model.drift, sp.Matrix(rates)),
        input_matrix=below(model.input_matrix, sp.zeros(count, m)),
        diffusion=below(model.diffusion, sp.zeros(count, sp.Matrix(model.diffusion).cols)),
        parameters=model.parameters,
    )


class DelayedFilter:
    """A `SafetyFilter` whose inputs are executed a number of control periods after they are sent.

    It remembers the inputs under way, predicts the state at which the next one will be executed,
    and filters there: `decision.barrier`, `margin` and the rest are of the predicted state. Where
    the prediction is exact, so is the filter: the plant is filtered as one without delay is, from
    the period on in which the first decided input arrives. Until then it executes the resting
    input, which no filter can change. As of its filter, all that it needs is compiled when it is
    made.

    Conditions that correct the model, of learned terms, correct no prediction: it is the model's.

    Each call of `filter` stands for a control period, also one that raises: whoever catches its
    error sends something else. What is under way is unknown then, and the filter refuses to decide
    until `override` has said for each such period what was sent, the earliest first, or `reset`.

    What is given at each call is of now, as the state is: signals and the time are predicted with
    their rates. The input bounds are those of the input to be sent.

    Args:
        safety_filter: decides at the predicted state.
        delay: whole control periods between sending and executing; 0 filters as `safety_filter`.
        dt: control period in s.
        substeps: integration steps of the prediction in a control period.
        rest: the input that is executed before any arrives, shape (m,), within the bounds of the
            filter; by default that nearest to 0.

    Raises:
        ConfigurationError: An argument is out of range, or the first one no filter.
        InvalidInputError: `rest` is none of m finite numbers.
    """

    def __init__(
        self,
        safety_filter: SafetyFilter,
        delay: int,
        dt: float,
        substeps: int = 1,
        rest: Sequence[float] | None = None,
    ) -> None:
        if not isinstance(safety_filter, SafetyFilter):
            raise ConfigurationError(
                f"safety_filter = {shown(safety_filter)}; give a SafetyFilter, which decides at the"
                " predicted state"
            )
        if safety_filter.of_measurements:
            raise ConfigurationError(
                f"the filter has {safety_filter.of_measurements}, and a DelayedFilter predicts from"
                " states that it is given: leave that out, and give it the estimate as the state"
            )
        require_delay("delay", delay)
        require_whole("substeps", substeps, 1)
        period = finite_number("dt", dt)
        if not period > 0.0:
            raise ConfigurationError(f"dt = {period} s; a control period is positive")
        qp = safety_filter.qp
        self.safety_filter, self.delay = safety_filter, delay
        self._prediction = Prediction(with_runtime_states(qp), period, substeps)
        fixed = [p.name for p in qp.model.parameters]
        self._given = RuntimeArguments(qp, safety_filter.model.parameters, fixed, True)
        box = list(zip(qp.low, qp.high, strict=True))
        self._rest = resting_input(box) if rest is None else self._resting(rest, box)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the plant executes the resting input until another arrives."""
        self._batch: tuple[int, ...] | None = None
        self._line = DelayLine(0, self._rest)
        self._unknown = 0

    @property
    def sent(self) -> np.ndarray:
        """The inputs under way, the oldest first, shape (..., delay, m); empty after a reset."""
        found = self._line.snapshot()
        return found.reshape(*(self._batch or ()), *found.shape[-2:])

    def filter(
        self,
        x: Any,
        u_nominal: Any,
        *,
        input_bounds: Any = None,
        parameters: Mapping[Any, Any] | None = None,
        t: Any = None,
    ) -> FilterDecision:
        """Decide what to send now, and remember it.

        Args:
            x: states as measured now, shape (n,) or (..., n); of the same plants at every call
                until `reset`.
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m): for the period in
                which they are executed.
            input_bounds: of the input that is to be sent; see `SafetyFilter.filter`.
            parameters: values now of signals and adjustable parameters; see there.
            t: the time now in s; see there.

        Returns:
            The decision at the predicted state; `action` is to be sent.

        Raises:
            InvalidInputError: A shape does not fit, or an entry is no finite real number.
            ConfigurationError: See `SafetyFilter.filter`; or what was sent in an earlier period is
                unknown.
            NumericalError: The prediction or the constraint has no finite value.
        """
        self._unknown += 1
        if self.delay and self._unknown > 1:
            raise ConfigurationError(
                f"the inputs of the last {self._unknown} control periods are unknown, this one"
                " included, since an error took the place of a decision: call override(u) for each"
                " of them with what was sent, the earliest first, or reset()"
            )
        state, u = doubles("state", x), doubles("nominal input", u_nominal)
        line = self._line_for(state, u)
        later: dict[str, Any] = {"parameters": parameters, "t": t}
        if self.delay:
            state, later = self._predicted(state, line, parameters, t)
        decision = self.safety_filter.filter(state, u, input_bounds=input_bounds, **later)
        line.exchange(components_of(decision.action))
        self._batch, self._line, self._unknown = state.shape[:-1], line, 0
        return decision

    def override(self, u: Any) -> None:
        """Say what was sent in place of a decision.

        That is of the last call of `filter`. After calls that raised, it is of the earliest of them
        about which nothing has been said yet.

        Args:
            u: what was sent, shape (m,) or (..., m).

        Raises:
            InvalidInputError: The shape does not fit, or an entry is no finite real number.
            ConfigurationError: `filter` has not been called since the reset.
        """
        given, batch, m = doubles("input", u), self._batch, len(self._rest)
        if batch is None:
            if not self._unknown:
                raise ConfigurationError("nothing was sent since the reset: call filter() first")
            batch = given.shape[:-1]
        if given.shape != (*batch, m) or not np.isfinite(given).all():
            raise InvalidInputError(
                f"the input {shown(u)} does not fit; give finite numbers of shape"
                f" {(*batch, m) if self._batch is not None else f'(..., {m})'}"
            )
        line = self._line if self._batch is not None else self._empty_line(batch)
        sent = tuple(components_of(given))
        if self._unknown:
            line.exchange(sent)
            self._unknown -= 1
        elif self.delay:
            line.under_way[-1] = sent
        self._batch, self._line = batch, line

    def _line_for(self, x: np.ndarray, u: np.ndarray) -> DelayLine:
        """Return the inputs under way to some plants; the resting one to those of a first call."""
        n, m, batch = self.safety_filter.model.n, len(self._rest), x.shape[:-1]
        if x.shape[-1:] != (n,) or u.shape != (*batch, m):
            raise InvalidInputError(
                f"state {x.shape} and input {u.shape} do not fit; give (..., {n}) and (..., {m})"
                " with the same leading axes"
            )
        require_finite(x, u)
        if self._batch is None:
            return self._empty_line(batch)
        if batch != self._batch:
            raise InvalidInputError(
                f"the state has the leading axes {batch}, and the inputs under way are of"
                f" {self._batch}: call reset() before other plants are filtered"
            )
        return self._line

    def _empty_line(self, batch: tuple[int, ...]) -> DelayLine:
        return DelayLine(self.delay, self._rest, math.prod(batch) if batch else None)

    def _predicted(
        self, x: np.ndarray, line: DelayLine, parameters: Any, t: Any
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the predicted states, and the values that a call of the filter takes there."""
        batch = x.shape[:-1] if x.ndim > 1 else None
        now = [*components_of(x), *self._given.values(parameters, t, batch)]
        under_way = line.under_way
        if batch is None:
            found = self._prediction.of_one(now, under_way)
        else:
            found = self._prediction.of_batch(tuple(now), under_way)
            lost = np.flatnonzero(~np.isfinite(found).all(axis=0))
            if lost.size:
                at = [int(i) for i in np.unravel_index(lost[0], batch)]
                raise NumericalError(f"the model has no finite prediction from the state at {at}")
        n, runtime = x.shape[-1], self.safety_filter.qp.runtime
        values = {s: np.reshape(c, batch or ()) for s, c in zip(runtime, found[n:], strict=True)}
        later = {"t": values.pop(TIME, None), "parameters": values or None}
        return np.stack(found[:n], axis=-1).reshape(x.shape), later

    def _resting(self, given: Any, box: Sequence[tuple[float, float]]) -> list[float]:
        values = real_array("rest", given)
        if values.shape != (len(box),) or not np.isfinite(values).all():
            raise InvalidInputError(f"rest = {shown(given)}; give {len(box)} finite numbers")
        if not all(low <= value <= high for value, (low, high) in zip(values, box, strict=True)):
            raise ConfigurationError(
                f"rest = {shown(given)} is outside the bounds of the filter, {box}; a plant"
                " executes an input within them"
            )
        return values.tolist()
