"""Entries of an identified input matrix that are taken for 0."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from safe_envs.wrappers.learning.data.values import LearnedFileError
from safe_envs.wrappers.learning.models.features import Features

_SIGNIFICANT = 0.999
_POINTS = 256
_SLOPE = 1e-6
"""Part of its range by which a state is moved to see how f and g change."""


def insignificant(mean: np.ndarray, covariance: np.ndarray, inputs: int) -> np.ndarray:
    """Return whether w' Cov^-1 w of the weights of g_ij is below the .999 quantile of chi^2_M.

    Args:
        mean: of the weights, shape (n, M (1 + m)).
        covariance: of the weights of each state, shape (n, M (1 + m), M (1 + m)).
        inputs: m.

    Returns:
        Shape (n, m).
    """
    count = mean.shape[1] // (1 + inputs)
    small = np.empty((len(mean), inputs), dtype=bool)
    for j in range(inputs):
        block = slice((j + 1) * count, (j + 2) * count)
        weights = mean[:, block, None]
        size = (weights * solved(covariance[:, block, block], weights)).sum(axis=(1, 2))
        small[:, j] = size <= chi2.ppf(_SIGNIFICANT, count)
    return small


def mixed_by_steps(features: Features, mean: np.ndarray, dt: float) -> np.ndarray:
    """Return whether g_ij is no larger than twice dt/2 (Df g_j + Dg_j f)_i.

    A step of dt mixes the entries by that much: in a plant that is integrated finer than dt the
    input reaches a position within a step.

    Args:
        features: Phi, M of them.
        mean: of the weights, shape (n, M (1 + m)).
        dt: length of the steps in s.

    Returns:
        Shape (n, m).
    """
    n, low, high = len(mean), *np.array(features.region).T
    x = np.random.default_rng(0).uniform(low, high, (_POINTS, n))
    reach = np.diag(_SLOPE * (high - low))
    slopes = np.stack(
        [(features.matrix(x + h) - features.matrix(x - h)) / (2.0 * h.sum()) for h in reach],
        axis=-1,
    )
    weights = mean.reshape(n, -1, features.count)
    values = np.einsum("bk,ipk->bip", features.matrix(x), weights)
    jacobians = np.einsum("bkj,ipk->bipj", slopes, weights, optimize=True)
    mixed = jacobians[:, :, 0] @ values[:, :, 1:] + np.einsum(
        "bipj,bj->bip", jacobians[:, :, 1:], values[:, :, 0]
    )
    return (values[:, :, 1:] ** 2).mean(axis=0) <= dt**2 * (mixed**2).mean(axis=0)


def solved(covariance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a system with a covariance of weights.

    Args:
        covariance: regular, if it was learned, shape (..., D, D).
        right: right-hand sides, shape (..., D, k).

    Raises:
        LearnedFileError: the covariance is singular.
    """
    try:
        return np.linalg.solve(covariance, right)
    except np.linalg.LinAlgError as error:
        raise LearnedFileError(
            "the covariance of the weights is singular: the file was altered. Learn again"
        ) from error
