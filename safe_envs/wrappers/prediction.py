"""Where a model will be once inputs that are under way have been executed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.defined import NO_VALUE
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import NumericalError
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.filter_qp import FilterQP


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
