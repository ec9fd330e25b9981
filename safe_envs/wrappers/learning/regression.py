"""Bayesian linear regression: rows of one-step data, and the posterior of the weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.models.distributions import Gaussian
from safe_envs.wrappers.learning.models.features import Features

_SAME_SHAPE = 1e-12


@dataclass(frozen=True, eq=False)
class Rows:
    """Transitions, those from the same state under the same input for the same time taken together.

    Attributes:
        x: states (G, n).
        u: inputs (G, m).
        dt: durations in s, (G,).
        count: number of transitions in each row, (G,).
        rate: mean of (x' - x)/dt, (G, n).
        group: row of each of the R transitions, (R,).
        deviation: of each transition from its row's mean, times sqrt(dt), (R, n): noise of variance
            (sigma sigma')_ii.
    """

    x: np.ndarray
    u: np.ndarray
    dt: np.ndarray
    count: np.ndarray
    rate: np.ndarray
    group: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, data: Transitions) -> Rows:
        """Group data: a log in which rows repeat gives what a collector with repetitions gives."""
        n, m = data.x.shape[1], data.u.shape[1]
        unique, inverse = np.unique(
            np.column_stack((data.x, data.u, data.dt)), axis=0, return_inverse=True
        )
        group = np.repeat(inverse.ravel(), data.repetitions)
        rates = ((data.successors - data.x[:, None]) / data.dt[:, None, None]).reshape(-1, n)
        count, dt = np.bincount(group), unique[:, -1]
        mean = grouped(rates, group, count)
        deviation = (rates - mean[group]) * np.sqrt(dt[group])[:, None]
        return cls(unique[:, :n], unique[:, n : n + m], dt, count, mean, group, deviation)

    @property
    def repeated(self) -> bool:
        """Whether rows repeat so often that their scatter tells most about the noise."""
        return 2 * (len(self.group) - len(self.count)) >= len(self.group)

    def design(self, features: Features, input_scale: np.ndarray) -> np.ndarray:
        """Return Phi, s_1 u_1 Phi, .., s_m u_m Phi of the rows, (G, M (1 + m)).

        Args:
            features: Phi.
            input_scale: s, shape (m,).
        """
        phi = features.matrix(self.x)
        scaled = np.column_stack((np.ones(len(phi)), self.u * input_scale))
        return (scaled[:, :, None] * phi[:, None, :]).reshape(len(phi), -1)


def grouped(values: np.ndarray, group: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return sums over groups, divided by counts, shape (G, n).

    Args:
        values: shape (R, n).
        group: index of the group of each row, shape (R,).
        count: divisor of each group, shape (G,).
    """
    return np.column_stack([np.bincount(group, column) / count for column in values.T])


def posterior(
    design: np.ndarray, y: np.ndarray, variance: np.ndarray, prior: np.ndarray | float
) -> Gaussian:
    """Return the posterior of w in y = design w + noise, for every output i.

    The prior is N(0, prior_i I). The whitened rows are reduced by QR and an SVD, not by their Gram
    matrix: directions that the data do not show keep the prior, even where an output is nearly free
    of noise.

    Args:
        design: (P, D).
        y: (P, n).
        variance: of the noise, (n,) or (P, n), positive, in units of y squared. Outputs whose
            variances differ by a factor only share the decomposition.
        prior: variance of each weight, positive, one for all outputs or (n,).

    Raises:
        ConfigurationError: a variance is not positive and finite.

    Source: thesis Eq. (6.7), where the noise variance is printed as sigma^2/K for data that are
        divided by dt: the callers
    here pass sigma^2/(K dt).
    """
    spread, believed = (
        np.broadcast_to(np.asarray(variance, dtype=float), y.shape),
        np.broadcast_to(prior, y.shape[1:]),
    )
    if not (
        np.isfinite(spread).all()
        and (spread > 0).all()
        and np.isfinite(believed).all()
        and (believed > 0).all()
    ):
        raise ConfigurationError(
            f"the variances of the noise and of the prior ({prior!r}) must be positive and finite"
        )
    ratio = spread / spread[:, :1]
    if (np.ptp(ratio, axis=0) <= _SAME_SHAPE * ratio[0]).all():
        return _shared(design, y, spread[:, 0], ratio[0], believed)
    parts = [
        _shared(design, y[:, [i]], spread[:, i], np.ones(1), believed[[i]])
        for i in range(y.shape[1])
    ]
    return Gaussian(
        np.concatenate([p.mean for p in parts]), np.concatenate([p.covariance for p in parts])
    )


def _shared(
    design: np.ndarray, y: np.ndarray, variance: np.ndarray, ratio: np.ndarray, prior: np.ndarray
) -> Gaussian:
    """Return the same where the noise of output i has the variance `variance` (P,) by ratio_i."""
    count = design.shape[1]
    reduced = np.asarray(
        np.linalg.qr(np.hstack((design, y)) / np.sqrt(variance)[:, None], mode="r")
    )
    left, singular, right = np.linalg.svd(reduced[:, :count], full_matrices=True)
    size = np.zeros(count)
    size[: len(singular)] = singular
    seen = np.zeros((count, y.shape[1]))
    seen[: len(singular)] = left.T[: len(singular)] @ reduced[:, count:]
    precision = size**2 / ratio[:, None] + 1.0 / prior[:, None]
    mean = (seen.T * size / ratio[:, None] / precision) @ right
    return Gaussian(mean, np.einsum("ki,nk,kj->nij", right, 1.0 / precision, right, optimize=True))
