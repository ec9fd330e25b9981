"""The unscented Kalman filter."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.filters.estimation.estimator import (
    Components,
    Estimator,
    InitialBelief,
    Update,
    cholesky,
    packed_entries,
    pairs,
)
from safe_envs.problem.measurement import Measurement
from safe_envs.text import finite_number


class UnscentedKalmanFilter(Estimator):
    """The unscented Kalman filter (UKF), with additive noise.

    The sigma points x^, x^ +- sqrt(n + lambda) L_i, L L' = P, take the simulator's step without its
    noise; sigma sigma' is averaged over them. lambda = alpha^2 (n + kappa) - n. By default all
    weights are equal, and that of the mean is 0 (the cubature filter). For linear systems it is the
    Kalman filter. One state is computed as a batch of one.

    Args:
        model: see `Estimator`.
        measurement: see there.
        dt: see there.
        substeps: see there.
        process_noise: see there.
        initial: see there.
        alpha: spread of the sigma points.
        beta: 2 is best for Gaussian errors with a small alpha.
        kappa: see above.

    Raises:
        ConfigurationError: See `Estimator`; or alpha is not positive, or n + kappa is not.

    Source: Julier and Uhlmann, Unscented Filtering and Nonlinear Estimation, Proc. IEEE, 2004; Wan
        and van der Merwe, 2000; Arasaratnam and Haykin, Cubature Kalman Filters, 2009.
    """

    name = "ukf"

    def __init__(  # noqa: PLR0913  (what every estimator has, and the settings of the transform)
        self,
        model: ControlAffineSDE,
        measurement: Measurement,
        dt: float,
        substeps: int = 1,
        process_noise: float | Sequence[float] = 0.0,
        initial: InitialBelief | None = None,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.0,
    ) -> None:
        super().__init__(model, measurement, dt, substeps, process_noise, initial)
        self.alpha, self.beta, self.kappa = (
            finite_number(name, value)
            for name, value in (("alpha", alpha), ("beta", beta), ("kappa", kappa))
        )
        n = model.n
        scale = self.alpha * self.alpha * (n + self.kappa)
        # If it is too small, the weights of 1/scale cancel each other.
        if not (self.alpha > 0.0 and n + self.kappa > 0.0 and 1e-8 <= scale <= 1e8):
            raise ConfigurationError(
                f"alpha = {self.alpha:g}, kappa = {self.kappa:g}; alpha is positive, kappa above"
                f" -n, and alpha^2 (n + kappa) from 1e-8 to 1e8, with n = {n} states"
            )
        others = 0.5 / scale
        first = 1.0 - n / scale
        self._spread = scale**0.5
        self._weights = np.array([first, *[others] * (2 * n)])
        self._squares = self._weights.copy()
        self._squares[0] += 1.0 - self.alpha**2 + self.beta

    @property
    def text(self) -> str:
        """The name with the settings."""
        standard = {"alpha": 1.0, "beta": 0.0, "kappa": 0.0}
        given = [f":{k}={getattr(self, k):g}" for k, v in standard.items() if getattr(self, k) != v]
        return super().text + "".join(given)

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
        belief, inputs = [_rows(c) for c in (mean, covariance)], _rows(u)
        x, p = belief
        for _ in range(self.substeps):
            points = self._points(x, p)
            moved = self._step(points, inputs)
            x = [self._weights @ c for c in moved]
            spread = [c - m for c, m in zip(moved, x, strict=True)]
            p = [self._squares @ (spread[i] * spread[j]) for i, j in pairs(self.n)]
            for at, noise in zip(self._noisy, self._noise(*points), strict=True):
                noise = np.broadcast_to(noise, points[0].shape)
                p[at] = p[at] + self.dt / self.substeps * (self._weights @ noise)
        return _as_given(flavour, x), _as_given(flavour, p)

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
        x, p, has = _rows(mean), _rows(covariance), [np.atleast_1d(r) for r in received]
        points, k = self._points(x, p), len(y)
        seen = [np.broadcast_to(c, points[0].shape) for c in self._outputs(*points)]
        center = [c[0] for c in seen]
        # Periodic values are averaged as differences from that of the mean.
        away = [self._wrapped(i, c - c[0]) for i, c in enumerate(seen)]
        bias = [self._weights @ c for c in away]
        expected = [c + b for c, b in zip(center, bias, strict=True)]
        nu = self.innovations("arrays", _rows(y), expected, has)
        output = np.stack([c - b for c, b in zip(away, bias, strict=True)])
        state = np.stack([c - m for c, m in zip(points, x, strict=True)])
        mask = np.stack([np.broadcast_to(h, nu[0].shape) for h in has]).astype(float)
        s = np.einsum("s,isb,jsb->bij", self._squares, output, output)
        s = s * mask.T[:, :, None] * mask.T[:, None, :] + np.diag(self.variances)
        cross = np.einsum("s,isb,jsb->bij", self._squares, state, output) * mask.T[:, None, :]
        gain = np.swapaxes(np.linalg.solve(s, np.swapaxes(cross, 1, 2)), 1, 2)
        errors = np.stack(nu, axis=-1)
        change = np.einsum("bij,bj->bi", gain, errors)
        both = gain @ np.swapaxes(cross, 1, 2)
        lower = both + np.swapaxes(both, 1, 2) - gain @ s @ np.swapaxes(gain, 1, 2)
        after = [c - lower[:, i, j] for c, (i, j) in zip(p, pairs(self.n), strict=True)]
        nis = np.einsum("bi,bi->b", errors, np.linalg.solve(s, errors[:, :, None])[:, :, 0])
        moved = [m + change[:, i] for i, m in enumerate(x)]
        found = [_as_given(flavour, part) for part in (moved, after, nu[:k], [nis])]
        return Update(found[0], found[1], found[2], found[3][0])

    def _points(self, x: Sequence[np.ndarray], p: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the components of the sigma points, each (2 n + 1, B)."""
        n, rows = self.n, cholesky(p, self.n)
        points = []
        for i in range(n):
            columns = [self._spread * np.broadcast_to(rows[i][j], x[i].shape) for j in range(n)]
            points.append(
                np.stack([x[i], *(x[i] + c for c in columns), *(x[i] - c for c in columns)])
            )
        return points

    def _step(self, points: Sequence[np.ndarray], u: Sequence[np.ndarray]) -> list[np.ndarray]:
        nothing = [np.float64(0.0)] * self._integrator.channels
        moved = self._integrator.step(tuple(points), u, nothing)
        return [np.broadcast_to(c, points[0].shape) for c in moved]

    def _wrapped(self, channel: int, values: np.ndarray) -> np.ndarray:
        period = self.measurement.channels[channel].period
        return values - period * np.ceil(values / period - 0.5) if period else values

    @cached_property
    def _integrator(self) -> Integrator:
        return Integrator(self.model, self.dt / self.substeps, 1, "arrays")

    @cached_property
    def _outputs(self) -> Any:
        return compile_function(self.model.states, self._expected, "arrays")

    @cached_property
    def _noisy(self) -> list[int]:
        index = {pair: i for i, pair in enumerate(pairs(self.n))}
        return [index[pair] for pair in packed_entries(self.diffusion_square)[0]]

    @cached_property
    def _noise(self) -> Any:
        entries = packed_entries(self.diffusion_square)[1]
        return compile_function(self.model.states, entries, "arrays")


def _rows(components: Components) -> list[np.ndarray]:
    return [np.atleast_1d(np.asarray(c, dtype=float)) for c in components]


def _as_given(flavour: Flavour, components: Sequence[np.ndarray]) -> list[Any]:
    return [float(c[0]) for c in components] if flavour == "floats" else list(components)
