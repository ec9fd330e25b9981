"""A safety filter for a plant that executes an input some control periods after it is sent."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.delay_line import DelayLine
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError, require_whole
from safe_envs.number_text import finite_number
from safe_envs.problem.actuators import require_delay, resting_input
from safe_envs.problem.signals import TIME
from safe_envs.validators import real_array
from safe_envs.wrappers.filter_qp import FilterDecision, FilterQP
from safe_envs.wrappers.filter_qp.component_filter import NO_VALUE
from safe_envs.wrappers.filter_qp.runtime import RuntimeArguments
from safe_envs.wrappers.safety_filter import SafetyFilter


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


class DelayedFilter:
    """A `SafetyFilter` whose inputs are executed a number of control periods after they are sent.

    It remembers the inputs under way, predicts the state at which the next one will be executed,
    and filters there: `decision.barrier`, `margin` and the rest are of the predicted state. Where
    the prediction is exact, so is the filter: the plant is filtered as one without delay is, from
    the period on in which the first decided input arrives. Until then it executes the resting
    input, which no filter can change. As of its filter, all that it needs is compiled when it is
    made.

    Conditions that correct the model, of learned terms, correct no prediction: it is the model's.

    What is given at each call is of now, as the state is: signals and the time are predicted with
    their rates. The input bounds are those of the input to be sent.

    Args:
        safety_filter: decides at the predicted state.
        delay: whole control periods between sending and executing; 0 filters as `safety_filter`.
        dt: control period in s.
        substeps: integration steps of the prediction in a control period.
        rest: the input that is executed before any arrives, shape (m,); by default that within
            the bounds of the filter nearest to 0.

    Raises:
        ConfigurationError: An argument is out of range.
    """

    def __init__(
        self,
        safety_filter: SafetyFilter,
        delay: int,
        dt: float,
        substeps: int = 1,
        rest: Sequence[float] | None = None,
    ) -> None:
        require_delay("delay", delay)
        require_whole("substeps", substeps, 1)
        period = finite_number("dt", dt)
        if not period > 0.0:
            raise ConfigurationError(f"dt = {period} s; a control period is positive")
        qp = safety_filter.qp
        self.safety_filter, self.delay = safety_filter, delay
        self._prediction = Prediction(_with_runtime_states(qp), period, substeps)
        fixed = [p.name for p in qp.model.parameters]
        self._given = RuntimeArguments(qp, safety_filter.model.parameters, fixed, True)
        box = list(zip(qp.low, qp.high, strict=True))
        self._rest = resting_input(box) if rest is None else self._input("rest", rest)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the plant executes the resting input until another arrives."""
        self._batch: tuple[int, ...] | None = None
        self._line = DelayLine(0, self._rest)

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
        bounds: Any = None,
        parameters: Mapping[Any, Any] | None = None,
        t: Any = None,
    ) -> FilterDecision:
        """Decide what to send now, and remember it.

        Args:
            x: states as measured now, shape (n,) or (..., n); of the same plants at every call
                until `reset`.
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m): for the period in
                which they are executed.
            bounds: of the input that is to be sent; see `SafetyFilter.filter`.
            parameters: values now of signals and adjustable parameters; see there.
            t: the time now in s; see there.

        Returns:
            The decision at the predicted state; `action` is to be sent.

        Raises:
            InvalidInputError: A shape does not fit, or an entry is no finite real number.
            ConfigurationError: See `SafetyFilter.filter`.
            NumericalError: The prediction or the constraint has no finite value.
        """
        state = real_array("state", x).astype(np.float64)
        self._begin(state)
        later: dict[str, Any] = {"parameters": parameters, "t": t}
        if self.delay:
            state, later = self._predicted(state, parameters, t)
        decision = self.safety_filter.filter(state, u_nominal, bounds=bounds, **later)
        self._line.exchange(self._components(decision.action))
        return decision

    def override(self, u: Any) -> None:
        """Say what was sent in place of the last decision, shape (m,) or (..., m).

        Raises:
            InvalidInputError: The shape does not fit, or an entry is no finite real number.
            ConfigurationError: Nothing has been decided since the reset.
        """
        given = real_array("input", u).astype(np.float64)
        if self._batch is None:
            raise ConfigurationError("nothing was sent since the reset: call filter() first")
        if given.shape != (*self._batch, len(self._rest)) or not np.isfinite(given).all():
            raise InvalidInputError(
                f"the input {u!r} does not fit; give finite numbers of shape"
                f" {(*self._batch, len(self._rest))}"
            )
        if self.delay:
            self._line.under_way[-1] = tuple(self._components(given))

    def _begin(self, x: np.ndarray) -> None:
        n, batch = self.safety_filter.model.n, x.shape[:-1]
        if x.shape[-1:] != (n,) or not np.isfinite(x).all():
            raise InvalidInputError(
                f"the state has shape {x.shape}; a filter needs finite numbers of shape (..., {n})"
            )
        if self._batch is None:
            count = int(np.prod(batch)) if batch else None
            self._batch, self._line = batch, DelayLine(self.delay, self._rest, count)
        if batch != self._batch:
            raise InvalidInputError(
                f"the state has the leading axes {batch}, and the inputs under way are of"
                f" {self._batch}: call reset() before other plants are filtered"
            )

    def _predicted(
        self, x: np.ndarray, parameters: Any, t: Any
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the predicted states, and the values that a call of the filter takes there."""
        batch = x.shape[:-1] if x.ndim > 1 else None
        now = [*self._components(x), *self._given.values(parameters, t, batch)]
        under_way = self._line.under_way
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

    def _components(self, values: np.ndarray) -> Sequence[Any]:
        """Return components of arrays (..., k): floats of one, arrays (B,) of a batch."""
        if values.ndim == 1:
            return values.tolist()
        return list(np.ascontiguousarray(values.reshape(-1, values.shape[-1]).T))

    def _input(self, what: str, given: Any) -> list[float]:
        values = real_array(what, given)
        if values.shape != (self.safety_filter.model.m,) or not np.isfinite(values).all():
            raise InvalidInputError(
                f"{what} = {given!r}; give {self.safety_filter.model.m} finite numbers"
            )
        return values.tolist()


def _with_runtime_states(qp: FilterQP) -> ControlAffineSDE:
    """Return a filter's model with what is given at each call as states, by their rates."""
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
