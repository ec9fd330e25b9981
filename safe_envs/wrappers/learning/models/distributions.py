"""Distributions that are learned: of the weights of a regression, and of a level of noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

from safe_envs.errors import ConfigurationError

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
    _require_prior(alpha, beta)
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
    _require_prior(alpha, beta)
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


def _require_prior(alpha: float, beta: float) -> None:
    if not (np.isfinite(alpha) and np.isfinite(beta) and alpha >= 0 and beta >= 0):
        raise ConfigurationError(
            f"alpha = {alpha!r} and beta = {beta!r}; the prior of sigma needs both from 0"
        )
