"""Whether an estimator is as certain as it may be: normalized errors against chi-square."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from safe_envs.filters.estimation.estimator import Estimator

_ROUNDING = 1e-9
"""Standard deviation, in parts of the mean, below which a state counts as known."""


@dataclass(frozen=True)
class Consistency:
    """The mean of normalized errors squared, and where it should lie.

    Attributes:
        mean: of all episodes and control instants.
        low: lower end of its confidence interval, over episodes, which are independent.
        high: upper end.
        expected: mean of what an honest estimator has, the mean degrees of freedom.
        consistent: whether the interval of the mean holds the expected one.
    """

    mean: float
    low: float
    high: float
    expected: float

    @property
    def consistent(self) -> bool:
        """Whether the interval holds the expected mean."""
        return self.low <= self.expected <= self.high


def consistency_of(
    sums: np.ndarray, freedom: np.ndarray, instants: np.ndarray, confidence: float
) -> Consistency | None:
    """Return the mean per control instant, with an interval over episodes.

    Values at instants of an episode are correlated, so that their number says nothing: each episode
    counts with its ratio of sums, with the interval of Student's distribution for ratios.

    Args:
        sums: of the normalized errors of each episode, (E,).
        freedom: sums of their degrees of freedom, (E,).
        instants: control instants of each episode, (E,).
        confidence: of the interval.

    Returns:
        None for fewer than two episodes.
    """
    count = len(sums)
    if count < 2 or not instants.sum():
        return None
    mean = float(sums.sum() / instants.sum())
    expected = float(freedom.sum() / instants.sum())
    # Of a ratio of sums, linearised.
    rest = (sums - mean * instants) / instants.mean()
    error = float(rest.std(ddof=1) / np.sqrt(count))
    half = float(stats.t.ppf(0.5 + 0.5 * confidence, count - 1)) * error
    return Consistency(mean, mean - half, mean + half, expected)


def nees(
    estimator: Estimator, x: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalized estimation error squared, e' P^-1 e, and its degrees of freedom.

    Where P is singular, its pseudo-inverse takes the place of the inverse, and its rank that of n.
    Errors of states that are measured modulo a period are taken modulo that.

    Args:
        estimator: whose belief it is.
        x: true states, shape (B, n).
        mean: shape (B, n).
        covariance: shape (B, n, n).

    Returns:
        Values (B,) and whole numbers (B,).
    """
    error = x - mean
    for i, period in enumerate(estimator.periods):
        if period:
            error[:, i] -= period * np.ceil(error[:, i] / period - 0.5)
    scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    # What is less than the rounding of the mean is exactly known.
    scale = np.where(scale > _ROUNDING * np.maximum(abs(mean), _ROUNDING), scale, 0.0)
    safe = np.where(scale > 0.0, scale, 1.0)
    # In units of standard deviations no state's unit decides what counts as singular.
    live = (scale > 0.0).astype(float)
    correlation = covariance / (safe[:, :, None] * safe[:, None, :])
    values, vectors = np.linalg.eigh(correlation * live[:, :, None] * live[:, None, :])
    known = values > 1e-10 * np.maximum(values[:, -1:], 1e-300)
    along = np.einsum("bij,bi->bj", vectors, error / safe)
    parts = np.where(known, along**2 / np.where(known, values, 1.0), 0.0)
    return parts.sum(axis=1), known.sum(axis=1)
