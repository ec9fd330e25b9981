"""Distributions that are learned: of the weights of a regression, and of the noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import sympy as sp
from scipy.integrate import cumulative_trapezoid
from scipy.stats import chi2

from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.data import LARGEST
from safe_envs.filters.learning.models.features import Features

_GRID = 20_001


_DROP = 40.0
"""Where the log density is this far below its maximum, nothing is left of the distribution."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal distributions of the weights of n outputs.

    Attributes:
        mean: (n, D).
        covariance: (n, D, D).
    """

    mean: np.ndarray
    covariance: np.ndarray

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Draw weights (n, D)."""
        values, vectors = np.linalg.eigh(self.covariance)
        draws = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(self.mean.shape)
        return self.mean + np.einsum("ide,ie->id", vectors, draws)


def sigma_map(
    squares: np.ndarray, counts: np.ndarray, alpha: float = 1.0, beta: float = 1.0
) -> np.ndarray:
    """Return the most probable noise level after N increments, for an inverse-gamma prior.

    sigma = [beta + sqrt(beta^2 + 4 (N + alpha + 1) S)]/(2 (N + alpha + 1)).

    Args:
        squares: S = sum of xi^2/dt over the increments xi ~ N(0, sigma^2 dt), of any shape.
        counts: N, of the same shape.
        alpha: shape of the prior, >= 0.
        beta: its scale, >= 0, in units of sigma.

    Raises:
        ConfigurationError: alpha or beta is negative.

    Source: thesis Eq. (6.11), whose solution the thesis calls intractable; it prints the likelihood
        N(0, sigma^2), without dt,
    with N - 1 factors.
    """
    require_prior(alpha, beta)
    total = np.asarray(counts) + alpha + 1.0
    return (beta + np.sqrt(beta**2 + 4.0 * total * np.asarray(squares))) / (2.0 * total)


def sigma_quantile(
    levels: np.ndarray, squares: float, count: float, alpha: float = 1.0, beta: float = 1.0
) -> np.ndarray:
    """Return quantiles of the posterior of sigma, tabulated around its mode.

    p(sigma) ~ sigma^-(N + alpha + 1) exp(-S/(2 sigma^2) - beta/sigma); the density of log sigma is
    log-concave.

    Args:
        levels: probabilities in [0, 1], of any shape.
        squares: S, see `sigma_map`.
        count: N.
        alpha: shape of the prior, >= 0.
        beta: its scale, >= 0; positive where S is 0.

    Returns:
        Of the shape of `levels`.

    Raises:
        ConfigurationError: there is no such distribution.

    Source: thesis Eq. (6.8) to (6.10), see `sigma_map`.
    """
    require_prior(alpha, beta)
    power = count + alpha
    if not (squares >= 0 and power > 0 and squares + beta > 0):
        raise ConfigurationError(
            f"no distribution of sigma for S = {squares}, N = {count}, alpha = {alpha}, beta ="
            f" {beta}"
        )
    # In d = log sigma - mode: -power d - S s^2 (exp(-2 d) - 1)/2 - beta s (exp(-d) - 1), with s =
    # 1/sigma at the mode.
    inverse = 2.0 * power / (beta + np.sqrt(beta**2 + 4.0 * power * squares))
    quadratic, linear = squares * inverse**2, beta * inverse
    bend = 2.0 * quadratic + linear
    # To the left it falls faster than its parabola; to the right the curvature is at least exp(-2)
    # of that up to d = 1, and from there on the slope tends to -power.
    right = np.sqrt(2.0 * np.e**2 * _DROP / bend)
    d = np.linspace(
        -np.sqrt(2.0 * _DROP / bend), right if right < 1.0 else 1.0 + _DROP / power, _GRID
    )
    density = np.exp(-power * d - 0.5 * quadratic * np.expm1(-2.0 * d) - linear * np.expm1(-d))
    below = cumulative_trapezoid(density, d, initial=0.0)
    return np.exp(np.interp(levels, below / below[-1], d)) / inverse


def sigma_samples(
    squares: float, count: float, alpha: float, beta: float, size: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws (size,) from the posterior of sigma; see `sigma_quantile` for the rest.

    Source: thesis Sec. 6.3.1, Fig. 6.2.
    """
    return sigma_quantile(rng.random(size), squares, count, alpha, beta)


def require_prior(alpha: float, beta: float) -> None:
    """Raise ConfigurationError unless there is a prior of sigma with these numbers.

    Args:
        alpha: its shape.
        beta: its scale, in units of sigma.
    """
    for name, value in (("alpha", alpha), ("beta", beta)):
        if not 0 <= value < math.inf:
            raise ConfigurationError(
                f"{name} = {shown(value)}; the prior of sigma needs a finite number from 0"
            )


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
