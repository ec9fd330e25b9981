"""The Kalman filter of linear systems and the extended one, continuous in time between samples."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import sympy as sp

from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.integrators import rate
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.estimation.covariance_source import (
    GeneratedFunction,
    euler_source,
    runge_kutta_source,
    update_source,
)
from safe_envs.wrappers.estimation.estimator import (
    Components,
    Estimator,
    Update,
    nonzero,
    packed_entries,
)


class ExtendedKalmanFilter(Estimator):
    """The extended Kalman filter (EKF).

    The mean takes the simulator's step without its noise: steps of Euler for a model with noise, of
    Runge and Kutta for one without. The covariance takes the derivative F of that very step,

        P <- F P F' + h sigma sigma',    F = I + h A,    A = d(f + g u)/dx,

    in steps h of Euler; F of a step of Runge and Kutta follows from A at its stages. So mean and
    covariance are those of the simulated process where f, g u and the measurements are affine in x
    and sigma is constant; elsewhere they are approximations, whose honesty the NEES measures.

    Samples are taken in by Joseph's form; see `covariance_source.update_source`.

    Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, Sec. 8.3; Bucy and Joseph,
        Filtering for Stochastic Processes, 1968.
    """

    name = "ekf"

    def predict(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Predict; see `Estimator.predict`.

        Args:
            flavour: see there.
            mean: see there.
            covariance: see there.
            u: see there.

        Returns:
            The mean and the covariance.
        """
        if self._noisy:
            return self._euler(flavour, mean, covariance, u)
        return self._runge_kutta(flavour, mean, covariance, u)

    def update(
        self,
        flavour: Flavour,
        mean: Components,
        covariance: Components,
        y: Components,
        received: Components,
    ) -> Update:
        """Take in a sample; see `Estimator.update`.

        Args:
            flavour: see there.
            mean: see there.
            covariance: see there.
            y: see there.
            received: see there.

        Returns:
            The belief after it.
        """
        k = len(y)
        values = self._outputs[flavour](*mean)
        nu = self.innovations(flavour, y, values[:k], received)
        found = self._joseph.call(*covariance, *values[k:], *nu, *[1.0 * has for has in received])
        n = self.n
        moved = [x + d for x, d in zip(mean, found[:n], strict=True)]
        return Update(moved, found[n:-1], nu, found[-1])

    def _euler(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        step, n = self._euler_steps[flavour], self.n
        for _ in range(self.substeps):
            values = step(*mean, *u)
            covariance = self._euler_covariance.call(*covariance, *values[n:])
            mean = values[:n]
        return mean, covariance

    def _runge_kutta(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        rates, n, h = self._rates[flavour], self.n, self.dt / self.substeps
        noise = [h * a**2 for a in self.added if a]
        for _ in range(self.substeps):
            stages = [rates(*mean, *u)]
            for length in (h / 2, h / 2, h):
                moved = [x + length * k for x, k in zip(mean, stages[-1][:n], strict=True)]
                stages.append(rates(*moved, *u))
            entries = self._transition.call(*[a for stage in stages for a in stage[n:]])
            covariance = self._linear_covariance.call(*covariance, *entries, *noise)
            mean = [
                x + h / 6 * (a + 2.0 * (b + c) + d)
                for x, a, b, c, d in zip(mean, *(stage[:n] for stage in stages), strict=True)
            ]
        return mean, covariance

    @cached_property
    def _noisy(self) -> bool:
        return self.model.noisy  # Which goes through symbols at each call.

    @cached_property
    def _slopes(self) -> tuple[tuple[int, int], ...]:
        return nonzero(self.jacobian)

    @cached_property
    def _euler_steps(self) -> dict[Flavour, Any]:
        model, h = self.model, sp.Float(self.dt / self.substeps, 17)
        moved = sp.Matrix(model.states) + rate(model) * h
        slopes = [self.jacobian[at] * h for at in self._slopes]
        noise = [entry * h for entry in packed_entries(self.diffusion_square)[1]]
        return self._compiled((*model.states, *model.inputs), [*moved, *slopes, *noise])

    @cached_property
    def _rates(self) -> dict[Flavour, Any]:
        model = self.model
        slopes = [self.jacobian[at] for at in self._slopes]
        return self._compiled((*model.states, *model.inputs), [*rate(model), *slopes])

    @cached_property
    def _outputs(self) -> dict[Flavour, Any]:
        rows = [self.output_jacobian[at] for at in nonzero(self.output_jacobian)]
        return self._compiled(self.model.states, [*self._expected, *rows])

    @cached_property
    def _euler_covariance(self) -> GeneratedFunction:
        noise, _ = packed_entries(self.diffusion_square)
        return GeneratedFunction(euler_source, self.n, self._slopes, noise)

    @cached_property
    def _linear_covariance(self) -> GeneratedFunction:
        every = tuple((i, j) for i in range(self.n) for j in range(self.n))
        added = tuple((i, i) for i, a in enumerate(self.added) if a)
        return GeneratedFunction(euler_source, self.n, every, added)

    @cached_property
    def _transition(self) -> GeneratedFunction:
        return GeneratedFunction(runge_kutta_source, self.n, self._slopes, self.dt / self.substeps)

    @cached_property
    def _joseph(self) -> GeneratedFunction:
        places = nonzero(self.output_jacobian)
        rows = tuple(
            tuple(j for i, j in places if i == channel)
            for channel in range(len(self.measurement.channels))
        )
        return GeneratedFunction(update_source, self.n, rows, self.variances)

    def _compiled(self, arguments: Any, expressions: Any) -> dict[Flavour, Any]:
        return {f: compile_function(arguments, expressions, f) for f in ("floats", "arrays")}


class KalmanFilter(ExtendedKalmanFilter):
    """The Kalman filter (KF), of models and measurements that are affine in the state.

    With Gaussian noise and a Gaussian start, mean and covariance are those of the state given the
    measurements, under any inputs that are functions of these.

    Raises:
        ConfigurationError: The model or a measurement is not affine in the state, or the noise or
            the effect of an input depends on it.

    Source: Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960.
    """

    name = "kf"

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        why_not = nonlinearity(self)
        if why_not:
            raise ConfigurationError(
                f"the Kalman filter is of linear systems, and {why_not}; use ekf or ukf"
            )


def nonlinearity(estimator: Estimator) -> str:
    """Return what of an estimator's model and measurements is not affine; "" where all is.

    Args:
        estimator: with the model and what is measured.
    """
    model = estimator.model
    moving = {*model.states, *model.inputs}
    for what, matrix in (
        ("the model", estimator.jacobian),
        ("the noise", estimator.diffusion_square),
        ("the measurement", estimator.output_jacobian),
    ):
        found = sorted(str(s) for e in matrix for s in sp.simplify(e).free_symbols if s in moving)
        if found:
            verb = "depends on" if what == "the noise" else "is not affine in"
            return f"{what} {verb} {found[0]}"
    return ""
