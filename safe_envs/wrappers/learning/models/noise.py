"""The noise of an identified system: constant levels or varying variances, and correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp
from scipy.stats import chi2

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.learning.data.values import (
    LARGEST,
)
from safe_envs.wrappers.learning.models.distributions import Gaussian, sigma_map, sigma_samples
from safe_envs.wrappers.learning.models.features import Features

_ROUNDING = 1e-9
"""Of the entries of a matrix of correlations."""

_ROUNDED = 1e-3
"""Part of its mean within which a regressed variance is rounded off towards 0, so that it stays
positive and smooth."""


@dataclass(frozen=True, eq=False)
class Diffusion:
    """The noise: a level for each state, or a variance that varies, and correlations.

    Attributes:
        squares: S of each state, the sum of xi^2/dt over the residual increments xi, (n,); 0 for a
            state without noise.
        count: N, degrees of freedom of each S.
        correlation: of the noise of the states, (n, n).
        alpha: shape of the prior of sigma.
        beta: its scale, in the units of sigma.
        features: on which the variances per s were regressed; None for constant noise.
        variance: weights of these variances; None for constant noise.
    """

    squares: np.ndarray
    count: float
    correlation: np.ndarray
    alpha: float = 1.0
    beta: float = 1.0
    features: Features | None = None
    variance: Gaussian | None = None

    @property
    def sigma(self) -> np.ndarray:
        """The most probable constant levels, (n,); 0 for a state without any scatter."""
        levels = sigma_map(
            self.squares, np.full(len(self.squares), self.count), self.alpha, self.beta
        )
        return np.where(self.squares > 0, levels, 0.0)

    def sigma_intervals(self, delta: float) -> np.ndarray:
        """Return intervals of all sigma_i of constant, independent noise, shape (n, 2).

        All of them hold but for a probability delta. They are those of S/sigma^2 ~ chi^2_N: a prior
        of sigma, whose scale is a guess, would move them off the truth.

        Raises:
            ConfigurationError: the noise varies with the state, or is correlated.
        """
        if self.features is not None or not np.array_equal(
            self.correlation, np.eye(len(self.squares))
        ):
            raise ConfigurationError(
                "intervals of sigma are known for constant noise of independent states only; ask"
                " for confidence instead"
            )
        tail = 0.5 * delta / len(self.squares)
        levels = np.array([tail, 1.0 - tail])
        return np.sqrt(self.squares[:, None] / chi2.isf(levels, self.count))

    def variances(self, x: np.ndarray) -> np.ndarray:
        """Estimated variances per s at states (B, n), without the prior of sigma, shape (B, n)."""
        constant = self.squares / self.count
        if self.features is None or self.variance is None:
            return np.broadcast_to(constant, x.shape)
        p, rounding = self.features.matrix(x) @ self.variance.mean.T, _ROUNDED * constant
        return 0.5 * (p + np.sqrt(p**2 + 4.0 * rounding**2))

    def matrix(self, rng: np.random.Generator | None = None) -> sp.ImmutableMatrix:
        """sigma(x), (n, n): the most probable one, or one drawn from the posterior."""
        if self.features is None or self.variance is None:
            levels = [sp.Float(s, 17) if s else sp.Integer(0) for s in self._levels(rng).tolist()]
        else:
            weights = self.variance.mean if rng is None else self.variance.sample(rng)
            levels = [
                self._level(p, r)
                for p, r in zip(
                    map(self.features.combined, weights), self.squares / self.count, strict=True
                )
            ]
        return sp.ImmutableMatrix(sp.diag(*levels) * _root(self.correlation))

    def _levels(self, rng: np.random.Generator | None) -> np.ndarray:
        if rng is None:
            return self.sigma
        return np.array(
            [
                sigma_samples(s, self.count, self.alpha, self.beta, 1, rng)[0] if s > 0 else 0.0
                for s in self.squares
            ]
        )

    def _level(self, p: sp.Expr, constant: float) -> sp.Expr:
        if not constant:
            return sp.Integer(0)
        rounding = sp.Float(2.0 * _ROUNDED * constant, 17)
        return sp.sqrt((p + sp.sqrt(p**2 + rounding**2)) / 2)


def require_noise(noise: Diffusion) -> None:
    """Raise ValueError where noise has a variance, a correlation or a prior that there is not."""
    correlation = noise.correlation
    fits = (
        (noise.squares >= 0).all()
        and 0 < noise.count <= LARGEST
        and max(noise.alpha, noise.beta) <= LARGEST
    )
    fits = fits and min(noise.alpha, noise.beta) >= 0
    if not (
        fits
        and np.allclose(correlation, correlation.T, atol=_ROUNDING)
        and (abs(correlation) <= 1.0 + _ROUNDING).all()
    ):
        raise ValueError(
            "the noise has a negative variance, a correlation above 1, or no degrees of freedom"
        )


def _root(correlation: np.ndarray) -> sp.Matrix:
    """Return the symmetric square root of a correlation matrix, which may be singular."""
    values, vectors = np.linalg.eigh(correlation)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return sp.Matrix(
        [[sp.Float(v, 17) if v else sp.Integer(0) for v in row] for row in root.tolist()]
    )
