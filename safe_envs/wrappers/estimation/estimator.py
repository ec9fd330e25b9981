"""State estimators of a model and a sensor: what they share, and how they are named."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.number_text import finite_number
from safe_envs.problem.measurement import Measurement
from safe_envs.validators import numbers_in
from safe_envs.wrappers.estimation.autonomy import require_state_alone
from safe_envs.wrappers.estimation.initial import InitialBelief
from safe_envs.wrappers.estimation.packed import unpacked
from safe_envs.wrappers.estimation.periods import continuous_output, periods_of_states

Components = Sequence[Any]
"""Floats of one state, or arrays (B,) of a batch."""


class Update(NamedTuple):
    """A belief after a sample.

    Attributes:
        mean: n components.
        covariance: n (n + 1)/2 components, see `safe_envs.wrappers.estimation.packed`.
        innovation: k components: what was measured less what was expected; 0 of lost samples.
        nis: normalized innovation squared, nu' S^-1 nu of what was received: for a linear model
            and Gaussian noise chi-square distributed, with as many degrees of freedom.
    """

    mean: Components
    covariance: Components
    innovation: Components
    nis: Any


class Estimator(ABC):
    """Base of the estimators: a belief about the state, a mean and a covariance, in time.

    The model moves by the step of the simulator, and its sensor is without bias: a bias and a
    mismatch of the plant are unknown to the estimator.

    Attributes:
        name: by which texts know it.
        text: with its settings.
        n: number of states.
        variances: of the noise of each channel.
        added: standard deviation of the noise added to each state, per square root of a second.

    Args:
        model: that is believed.
        measurement: what is measured.
        dt: control period in s.
        substeps: integration steps in it.
        process_noise: standard deviation per square root of a second of noise that the estimator
            adds to the model's, for all states or one number for each: for what the model does not
            know. Without noise the covariance would go to 0, and no sample count any more.
        initial: belief before the first sample, if it is known.

    Raises:
        SystemDefinitionError: Something unknown is measured, or the model or the sensor depends on
            signals or the time.
        ConfigurationError: A number is out of range, or something is measured without noise or with
            jumps that its period does not take away.
    """

    name: ClassVar[str]

    def __init__(
        self,
        model: ControlAffineSDE,
        measurement: Measurement,
        dt: float,
        substeps: int = 1,
        process_noise: float | Sequence[float] = 0.0,
        initial: InitialBelief | None = None,
    ) -> None:
        require_whole("substeps", substeps, 1)
        self.dt, self.substeps = finite_number("dt", dt), int(substeps)
        if not self.dt > 0.0:
            raise ConfigurationError(f"dt = {self.dt} s; a control period is positive")
        require_state_alone(model, measurement)
        measurement.require_known(model)
        exact = [c.name for c in measurement.channels if not c.noise > _LEAST_NOISE]
        if exact:
            raise ConfigurationError(
                f"{', '.join(exact)}: measured without noise, for which the gain of an estimator is"
                " singular; give a small standard deviation, or the true state without a sensor"
            )
        self.model, self.measurement, self.n = model, measurement, model.n
        if initial is not None:
            initial.require_states(model.n)
        self.initial = initial
        self.added = _process_noise(process_noise, model)
        self._expected = [continuous_output(c, model) for c in measurement.channels]
        self.variances = tuple(c.noise**2 for c in measurement.channels)

    @property
    def text(self) -> str:
        """The name with the settings."""
        added = [float(a) for a in self.added]
        if not any(added):
            return self.name
        equal = added[:1] if len(set(added)) == 1 else added
        return f"{self.name}:process_noise={','.join(format(a, 'g') for a in equal)}"

    @abstractmethod
    def predict(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Return the belief one control period later.

        Args:
            flavour: "floats" for one state, "arrays" for a batch.
            mean: n components.
            covariance: n (n + 1)/2 components.
            u: m components of the input that is executed.

        Returns:
            The mean and the covariance.
        """

    @abstractmethod
    def update(
        self,
        flavour: Flavour,
        mean: Components,
        covariance: Components,
        y: Components,
        received: Components,
    ) -> Update:
        """Return the belief after a sample.

        Args:
            flavour: see `predict`.
            mean: n components.
            covariance: n (n + 1)/2 components.
            y: k components of what was measured; finite numbers where it was lost.
            received: whether each component was.
        """

    def gained(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Return the covariance after the coming sample, and by how much that lowers it.

        The second is K S K', with the gain K and the covariance S of the innovation: the covariance
        of the jump of the mean.

        Args:
            flavour: see `predict`.
            mean: n components.
            covariance: n (n + 1)/2 components.
            u: m components of the input until then.
        """
        mean, before = self.predict(flavour, mean, covariance, u)
        y = self.expected(flavour, mean)
        after = self.update(flavour, mean, before, y, [True] * len(y)).covariance
        return after, [b - a for b, a in zip(before, after, strict=True)]

    def expected(self, flavour: Flavour, mean: Components) -> Components:
        """Return what a sensor without noise measures of a state.

        Args:
            flavour: see `predict`.
            mean: n components of the state.

        Returns:
            k components.
        """
        return self._functions[flavour](*mean)

    @cached_property
    def _functions(self) -> dict[Flavour, Any]:
        return {f: compile_function(self.model.states, self._expected, f) for f in _FLAVOURS}

    def innovations(
        self, flavour: Flavour, y: Components, expected: Components, received: Components
    ) -> list[Any]:
        """Return what was measured less what was expected.

        That of a periodic channel is within half a period of 0, and that of a lost sample is 0.

        Args:
            flavour: see `predict`.
            y: k components.
            expected: k components.
            received: whether each was measured.
        """
        found, up = [], math.ceil if flavour == "floats" else np.ceil
        for channel, value, mean, has in zip(
            self.measurement.channels, y, expected, received, strict=True
        ):
            difference = value - mean
            if channel.period:
                turns = up(difference / channel.period - 0.5)
                difference = difference - channel.period * turns
            found.append(difference * has)
        return found

    @cached_property
    def periods(self) -> tuple[float, ...]:
        """The number modulo which the sensor tells each state; 0 of those that it tells in full."""
        return periods_of_states(self)

    @cached_property
    def certain(self) -> tuple[int, ...]:
        """Places of the states that are known without any uncertainty, throughout.

        Initially they are, no noise drives them, and their rates depend on none but themselves.
        """
        if self.initial is None:
            return ()
        states, n = self.model.states, self.n
        start = unpacked(self.initial.covariance, n)
        known = {i for i in range(n) if not start[i, i] and not self.diffusion_square[i, i]}
        rates = sp.Matrix(self.model.numeric(self.model.drift)).row_join(
            sp.Matrix(self.model.numeric(self.model.input_matrix))
        )
        while True:
            others = {s for i, s in enumerate(states) if i not in known}
            lost = {i for i in known if rates[i, :].free_symbols & others}
            if not lost:
                return tuple(sorted(known))
            known -= lost

    @cached_property
    def jacobian(self) -> Any:
        """A = d(f + g u)/dx, a matrix of expressions of the states and inputs."""
        model = self.model
        rate = model.numeric(model.drift + model.input_matrix * sp.Matrix(model.inputs))
        return sp.Matrix(rate).jacobian(list(model.states))

    @cached_property
    def diffusion_square(self) -> Any:
        """Sigma sigma' with what is added to it, a matrix of expressions of the states."""
        sigma = sp.Matrix(self.model.numeric(self.model.diffusion))
        added = sp.diag(*[sp.Float(a, 17) ** 2 if a else 0 for a in self.added])
        return sigma * sigma.T + added

    @cached_property
    def output_jacobian(self) -> Any:
        """H = dc/dx, a matrix of expressions of the states."""
        return sp.Matrix(self._expected).jacobian(list(self.model.states))


_LEAST_NOISE = 1e-150
"""Standard deviation whose square is still a number above 0."""

_FLAVOURS: tuple[Flavour, ...] = ("floats", "arrays")


def nonzero(matrix: Any, upper: bool = False) -> tuple[tuple[int, int], ...]:
    """Return the places of the entries of a matrix that are not 0.

    Args:
        matrix: of expressions.
        upper: only those (i, j) with i <= j.
    """
    rows, columns = matrix.shape
    return tuple(
        (i, j)
        for i in range(rows)
        for j in range(columns)
        if matrix[i, j] != 0 and not (upper and i > j)
    )


def packed_entries(matrix: Any) -> tuple[tuple[tuple[int, int], ...], list[Any]]:
    """Return the places and the expressions of the upper triangle that are not 0."""
    found = nonzero(matrix, upper=True)
    return found, [matrix[i, j] for i, j in found]


def _process_noise(given: Any, model: ControlAffineSDE) -> tuple[float, ...]:
    values = numbers_in(given)
    if values.shape not in ((), (1,), (model.n,)) or not (
        np.isfinite(values).all() and (values >= 0.0).all()
    ):
        raise ConfigurationError(
            f"process_noise = {shown(given)}; give a number >= 0, or one for each of the {model.n}"
            " states"
        )
    return tuple(np.broadcast_to(values, model.n).tolist())
