"""Regression of rates on states that were measured with noise: errors in variables.

A start y = x + v and a successor y' = x' + v' are measured with independent Gaussian errors of
variances R. Then (y' - y)/dt is correlated with the features of y, and these are not those of x: a
regression is biased, however long the log.

**Unbiased moments.** For a polynomial p, p~ = exp(-1/2 sum_i R_i d^2/dx_i^2) p, a finite sum, has
E[p~(x + v)] = p(x): the heat equation, backwards. And by Stein's identity E[v_k g(x + v)] = R_k
E[dg/dx_k (x + v)]. So with the design d = s(u) (x) phi(x), s = (1, u),

    G = sum s s' (x) (phi phi')~(y),
    b_k = sum s (x) [phi~(y) (y'_k - y_k)/dt + R_k/dt d phi~/dx_k (y)]

have the means that the sums of d d' and d (x'_k - x_k)/dt have without errors, and theta_k =
G^-1 b_k converges to what a log without errors gives. Its covariance is G^-1 (sum psi psi') G^-1
with psi = b - G theta of each start (the sandwich formula), with the errors of the sensor in it.

The scatter of successors from one start has the variance sigma^2 dt + R, and y' - y the mean square
sigma^2 dt + dt^2 f^2 + 2 R: sigma^2 follows by the difference.

Source: Fuller, Measurement Error Models, 1987; Nakamura, Corrected score function for errors-in-
    variables models, Biometrika 1990.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.tables import tabulated
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.learning.bayesian_fit import Fit, Prior
from safe_envs.wrappers.learning.models.distributions import Diffusion, Gaussian
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.regression import Rows

_LEAST_LEFT = 0.05
"""Part that the smallest eigenvalue of the moments of the states has to be of that of what was
measured."""


def unbiased(expression: Any, states: Any, variances: np.ndarray) -> Any:
    """Return p~ with E[p~(x + v)] = p(x); see above.

    Args:
        expression: p, a polynomial of the states.
        states: n symbols.
        variances: R, (n,).
    """
    found = sp.expand(expression)
    for state, variance in zip(states, variances.tolist(), strict=True):
        term, order = found, 1
        while variance and (term := sp.diff(term, state, 2)) != 0:
            term = sp.expand(-sp.Float(variance, 17) / (2 * order) * term)
            found, order = found + term, order + 1
    return sp.expand(found)


def corrected_fit(
    rows: Rows, features: Features, scale: np.ndarray, deviations: np.ndarray, prior: Prior
) -> Fit:
    """Return the regression without the bias of errors in the states.

    Args:
        rows: of what was measured.
        features: phi, polynomials.
        scale: of the inputs, (m,).
        deviations: standard deviation of the error of each state, (n,).
        prior: of the weights and of sigma.

    Raises:
        ConfigurationError: A feature is no polynomial, or the errors hide what is to be learned.
    """
    if features.angles:
        raise ConfigurationError(
            f"errors_in_variables is of polynomial features; {', '.join(features.angles)} are"
            " angles: give errors_in_variables=False, or learn from estimates"
        )
    states, variances = features.states, deviations**2
    phi = [unbiased(e, states, variances) for e in features.expressions]
    count, n = len(phi), len(states)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    products = [
        unbiased(features.expressions[i] * features.expressions[j], states, variances)
        for i, j in pairs
    ]
    values = tabulated(states, phi)(rows.x)
    slopes = tabulated(states, [sp.diff(e, s) for s in states for e in phi])(rows.x)
    slopes = slopes.reshape(len(rows.x), n, count)
    squares = np.empty((len(rows.x), count, count))
    for (i, j), column in zip(pairs, tabulated(states, products)(rows.x).T, strict=True):
        squares[:, i, j] = squares[:, j, i] = column
    s = np.column_stack((np.ones(len(rows.x)), rows.u * scale))
    gram = np.einsum("ra,rb,rij->aibj", s, s, squares).reshape(s.shape[1] * count, -1)
    _require_seen(gram, rows.design(features, scale))
    mean, covariance = np.empty((n, len(gram))), np.empty((n, *gram.shape))
    for k in range(n):
        right = values * rows.rate[:, k, None] + variances[k] / rows.dt[:, None] * slopes[:, k]
        each = (s[:, :, None] * right[:, None, :]).reshape(len(s), -1)
        inverse = np.linalg.inv(
            gram + np.eye(len(gram)) * np.var(rows.rate[:, k]) / prior.weights[k]
        )
        mean[k] = inverse @ each.sum(axis=0)
        weights = mean[k].reshape(s.shape[1], count)
        inner = np.einsum("rij,bj,rb->ri", squares, weights, s)
        left = each - (s[:, :, None] * inner[:, None, :]).reshape(len(s), -1)
        covariance[k] = inverse @ (left.T @ left) @ inverse
    levels, freedom = _noise(rows, variances, mean, gram)
    diffusion = Diffusion(levels * freedom, float(freedom), np.eye(n), prior.alpha, prior.beta)
    return Fit(Gaussian(mean, covariance), diffusion, np.zeros(n), np.zeros(n))


def _require_seen(gram: np.ndarray, design: np.ndarray) -> None:
    size = np.sqrt((design**2).sum(axis=0))
    scale = np.outer(size, size)
    naive = np.linalg.eigvalsh(design.T @ design / scale)[0]
    left = np.linalg.eigvalsh(gram / scale)[0]
    if left < _LEAST_LEFT * naive:
        raise ConfigurationError(
            "the errors of the sensor hide what is to be learned: the smallest eigenvalue of the"
            f" moments of the states is {left:.2g}, that of what was measured {naive:.2g}; take"
            " more starts, a lower degree or a better sensor"
        )


def _noise(
    rows: Rows, variances: np.ndarray, mean: np.ndarray, gram: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return sigma^2 of each state, 0 where the sensor hides it, and degrees of freedom."""
    freedom = float(len(rows.group) - len(rows.count))
    dt = rows.dt.mean()
    if rows.repeated:
        scatter = (rows.deviation**2).sum(axis=0) / freedom
        levels = scatter - variances / dt
    else:
        freedom = float(len(rows.rate))
        scatter = (rows.rate**2).mean(axis=0) * dt
        moved = np.einsum("ki,ij,kj->k", mean, gram, mean) / len(rows.rate)
        levels = scatter - 2.0 * variances / dt - dt * moved
    error = scatter * np.sqrt(2.0 / freedom)
    levels = np.where(levels > error, levels, 0.0)
    seen = levels > 0.0
    # As many degrees of freedom as a chi-square number of this relative error has.
    known = 2.0 * (levels[seen] / error[seen]) ** 2 if seen.any() else np.array([freedom])
    return levels, max(float(known.min()), 1.0)
