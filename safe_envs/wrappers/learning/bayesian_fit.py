"""Bayesian regression of the rates of a system, with the noise that the data show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm
from scipy.stats import f as fisher

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.learning.models.distributions import Diffusion, Gaussian
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.regression import Rows, grouped, posterior

_SURE = 0.9999


_NOISELESS = 1e-7
"""Noise below this part of a state's own rate is rounding."""


_FLOOR = 1e-6
"""Part of a state's rate that its noise counts for at least, as the rounding of a state without
noise."""


_LEAST_VARYING = 0.05
"""Part of its mean that a regressed variance counts for at least: where it is nearly 0 it is not
known well enough for a weight."""


_SMALLEST = 1e-24
"""Mean square of a rate that is 0."""


@dataclass(frozen=True)
class Prior:
    """What is believed before any data.

    Attributes:
        weights: variance of each weight, (n,).
        alpha: shape of the inverse-gamma distribution of a constant sigma.
        beta: its scale, in the units of sigma.
    """

    weights: np.ndarray
    alpha: float
    beta: float


@dataclass(frozen=True, eq=False)
class Fit:
    """A regression.

    Attributes:
        learned: the weights.
        diffusion: the noise.
        misfit: part of each state's rate that the features miss, (n,), where that is beyond the
            noise; else 0.
        variation: part by which the variance of each state's noise varies with the state, (n,),
            where that is beyond chance and taken for constant; else 0.
    """

    learned: Gaussian
    diffusion: Diffusion
    misfit: np.ndarray
    variation: np.ndarray


def fit(rows: Rows, design: np.ndarray, features: Features | None, prior: Prior) -> Fit:
    """Regress the rates on the design, with the noise that the data show.

    Where the rows scatter about the best fit by more than the noise explains, that much is taken
    for their variance; and what the features miss is no noise, that more rows would average out:
    its mean square is the least variance of the constant term.

    Args:
        rows: of data.
        design: at these rows, (G, D).
        features: on which the variances are regressed; None for constant noise.
        prior: what was believed before.

    Returns:
        The weights, the noise, and by how much the features fail.

    Raises:
        ConfigurationError: the rows do not repeat and are too few for the weights: nothing is left
            to tell the noise.
    """
    residual, count = _residuals(rows, design)
    noise = _diffusion(rows, residual, count, features, prior)
    size = np.average(rows.rate**2, axis=0, weights=rows.dt * rows.count)
    floor = (_FLOOR**2 * size + _SMALLEST) * rows.dt.mean()
    constant = np.maximum(_LEAST_VARYING * noise.squares / noise.count, floor)
    variance = np.maximum(noise.variances(rows.x), constant) / (rows.dt * rows.count)[:, None]
    learned = posterior(design, rows.rate, variance, prior.weights)
    left, misfit = len(design) - design.shape[1], np.zeros(len(size))
    if left > 0:
        error = rows.rate - design @ learned.mean.T
        excess = (error**2 / variance).sum(axis=0) / left
        beyond = excess > fisher.ppf(_SURE, left, count)
        unexplained = np.where(beyond, np.maximum((error**2 - variance).mean(axis=0), 0.0), 0.0)
        learned = posterior(
            design, rows.rate, variance * np.where(beyond, excess, 1.0), prior.weights
        )
        learned.covariance[:, 0, 0] += unexplained
        misfit = np.sqrt(unexplained / (size + _SMALLEST))
    return Fit(
        learned,
        noise,
        misfit,
        np.zeros(len(size)) if features else _variation(rows, residual, noise),
    )


def _residuals(rows: Rows, design: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the noise in the R transitions, (R, n), and its degrees of freedom N.

    It is the scatter within the rows where these repeat, and else what a first fit leaves.
    """
    if rows.repeated:
        return rows.deviation, float(len(rows.group) - len(rows.count))
    weight = np.sqrt(rows.dt * rows.count)[:, None]
    solution, _, rank, _ = np.linalg.lstsq(design * weight, rows.rate * weight, rcond=None)
    count = float(len(rows.group) - rank)
    if count < 1:
        raise ConfigurationError(
            f"{len(rows.group)} rows without repetitions determine {rank} weights and nothing of"
            " the noise; give more data, repetitions or a lower degree"
        )
    return (
        rows.deviation + ((rows.rate - design @ solution) * np.sqrt(rows.dt)[:, None])[rows.group],
        count,
    )


def _diffusion(
    rows: Rows, residual: np.ndarray, count: float, features: Features | None, prior: Prior
) -> Diffusion:
    squares = (residual**2).sum(axis=0)
    noiseless = (
        squares / count
        <= _NOISELESS**2 * np.average(rows.rate**2, axis=0, weights=rows.count) * rows.dt.mean()
    )
    squares = np.where(noiseless, 0.0, squares)
    variance = None
    if features is not None:
        targets = grouped(residual**2, rows.group, rows.count * (count / len(rows.group)))
        variance = _regressed(features.matrix(rows.x), targets, rows.count, prior.weights)
    plain = Diffusion(
        squares, count, np.eye(len(squares)), prior.alpha, prior.beta, features, variance
    )
    scale = np.sqrt(plain.variances(rows.x))[rows.group]
    white = np.divide(residual, scale, out=np.zeros_like(residual), where=~noiseless & (scale > 0))
    return Diffusion(
        squares, count, _correlation(white), prior.alpha, prior.beta, features, variance
    )


def _regressed(
    phi: np.ndarray, targets: np.ndarray, count: np.ndarray, prior: np.ndarray
) -> Gaussian:
    """Return the weights of variances per s; their own noise follows from what the fit leaves.

    Args:
        phi: features, shape (G, M).
        targets: mean squares, shape (G, n).
        count: degrees of freedom of each row, shape (G,).
        prior: variance of each weight, shape (n,).
    """
    weight = np.sqrt(count)[:, None]
    solution, _, rank, _ = np.linalg.lstsq(phi * weight, targets * weight, rcond=None)
    left = ((targets - phi @ solution) ** 2 * count[:, None]).sum(axis=0) / max(len(phi) - rank, 1)
    return posterior(phi, targets, np.maximum(left, _SMALLEST) / count[:, None], prior)


def _variation(rows: Rows, residual: np.ndarray, noise: Diffusion) -> np.ndarray:
    """Return the part by which the variance of each state varies as a quadratic of the state, (n,).

    It is 0 where that may be chance.
    """
    centred = rows.x - rows.x.mean(axis=0)
    scaled = centred / np.maximum(abs(centred).max(axis=0), np.finfo(float).tiny)
    terms = np.column_stack((np.ones(len(scaled)), scaled, scaled**2))
    constant = np.maximum(noise.squares / noise.count, _SMALLEST)
    free = rows.count * (noise.count / len(rows.group))
    squares, weight = grouped(residual**2, rows.group, free) / constant, np.sqrt(free)[:, None]
    solution, _, rank, _ = np.linalg.lstsq(terms * weight, (squares - 1.0) * weight, rcond=None)
    # Mean squares of noise that is the same everywhere have the variance 2/free: half the sum is
    # chi^2.
    explained = ((terms @ solution) ** 2 * free[:, None]).sum(axis=0)
    varies = (explained / 2.0 > chi2.ppf(_SURE, rank)) & (noise.squares > 0)
    return np.where(varies, np.sqrt(explained / free.sum()), 0.0)


def _correlation(white: np.ndarray) -> np.ndarray:
    """Return the correlations (n, n) of residuals (R, n) of variance 1.

    They are the unit matrix where none is significant, and 0 for a state without noise.
    """
    n = white.shape[1]
    sizes = np.sqrt((white**2).sum(axis=0))
    sizes[sizes == 0] = 1.0
    found = (white / sizes).T @ (white / sizes)
    np.fill_diagonal(found, 1.0)
    limit = norm.isf((1.0 - _SURE) / max(n * (n - 1), 1)) / math.sqrt(len(white))
    return found if (abs(found - np.eye(n)) > limit).any() else np.eye(n)
