"""Bayesian identification of an unknown control-affine system from one-step data.

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

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2, norm
from scipy.stats import f as fisher

from safe_envs.dynamics.codegen import tabulated
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.checks import (
    Progress,
    Purpose,
    random_stream,
    require_kind,
    require_problem,
)
from safe_envs.filters.learning.collection import Step, collect, sensor_deviations
from safe_envs.filters.learning.data import Transitions
from safe_envs.filters.learning.drift_checks import region_warnings
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.distributions import Diffusion, Gaussian, require_prior
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.problem.problem import SafetyProblem

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
    """Return the noise in the R transitions, (R, n), and its degrees of freedom N."""
    # It is the scatter within the rows where these repeat, and else what a first fit leaves.
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
    """Return the weights of variances per s; their own noise follows from what the fit leaves."""
    weight = np.sqrt(count)[:, None]
    solution, _, rank, _ = np.linalg.lstsq(phi * weight, targets * weight, rcond=None)
    left = ((targets - phi @ solution) ** 2 * count[:, None]).sum(axis=0) / max(len(phi) - rank, 1)
    return posterior(phi, targets, np.maximum(left, _SMALLEST) / count[:, None], prior)


def _variation(rows: Rows, residual: np.ndarray, noise: Diffusion) -> np.ndarray:
    """Return the share of each state's variance that is quadratic in the state, (n,)."""
    # It is 0 where that may be chance.
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
    """Return the correlations (n, n) of residuals (R, n) of variance 1."""
    # They are the unit matrix where none is significant, and 0 for a state without noise.
    n = white.shape[1]
    sizes = np.sqrt((white**2).sum(axis=0))
    sizes[sizes == 0] = 1.0
    found = (white / sizes).T @ (white / sizes)
    np.fill_diagonal(found, 1.0)
    limit = norm.isf((1.0 - _SURE) / max(n * (n - 1), 1)) / math.sqrt(len(white))
    return found if (abs(found - np.eye(n)) > limit).any() else np.eye(n)


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


_STILL = 1e-8
"""Part of its range that a state has to cover."""

_STEADY = 0.05
"""Part of its largest size by which an input has to vary."""

_RANK = 1e-8
"""Singular values below this part of the largest count as zero."""

_WEAK = 0.5
"""Part of the prior variance above which a direction counts as not learned."""

_PART = 0.05
"""Share of a weight in a direction from which it is named."""

_MATERIAL = 0.05
"""Part of a state's rate, or of its noise, from which there is a warning of a misfit."""

_MOST_NAMED = 4


class IdentifiabilityWarning(UserWarning):
    """The data do not tell everything that was asked of them."""


def weaknesses(
    features: Features,
    inputs: Sequence[str],
    x: np.ndarray,
    u: np.ndarray,
    design: np.ndarray,
    learned: Gaussian,
    prior: float,
) -> tuple[str, ...]:
    """Say what the data leave open.

    Args:
        features: M of them.
        inputs: names of the inputs.
        x: distinct rows of data: states (P, n),
        u: and inputs (P, m).
        design: of the regression at these rows, (P, D) with D = M (1 + m).
        learned: the posterior of the weights.
        prior: variance of each weight before.

    Returns:
        Texts; none where the data tell everything.

    Source: our own; thesis Sec. 6.3.1 tries u = .1 only, which does not identify g.
    """
    terms = term_names(features, inputs)
    found = [*_steady(features, inputs, x, u)]
    if len(design) < len(terms):
        found.append(
            f"{len(design)} different rows of data are too few for {len(terms)} weights; collect"
            " more, or lower the degree"
        )
    _, singular, right = np.linalg.svd(np.linalg.qr(design, mode="r"), full_matrices=True)
    rank = int((singular > _RANK * singular[0]).sum()) if singular[0] > 0 else 0
    if rank < len(terms):
        found.append(
            f"the data cannot tell apart: {_confounded(terms, right[rank:])}; what is learned of"
            " these is the prior's choice"
        )
    weak = _weak(terms, right[:rank], learned, prior)
    return (
        *found,
        *(
            f"{state}: the noise drowns {names}; observe longer, or try larger inputs"
            for state, names in _by_state(features, weak)
        ),
    )


def misfits(features: Features, misfit: np.ndarray, variation: np.ndarray) -> tuple[str, ...]:
    """Say what the features leave out.

    Args:
        features: of the regression.
        misfit: part of each state's rate that they miss, (n,).
        variation: part by which the variance of its noise varies although it is taken for constant,
            (n,).

    Returns:
        Texts; none where nothing material is left out.
    """
    left_out = [
        f"{state}: features of degree {features.degree} miss {100 * part:.3g} % of its rate; give a"
        " higher degree"
        for state, part in zip(features.states, misfit, strict=True)
        if part > _MATERIAL
    ]
    varied = [
        f"{state}: the variance of its noise varies by {100 * part:.3g} % over the states; give a"
        " diffusion degree"
        for state, part in zip(features.states, variation, strict=True)
        if part > _MATERIAL
    ]
    return (*left_out, *varied)


def term_names(features: Features, inputs: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the D columns of the regression: monomials, then these times each input.

    Args:
        features: of the states.
        inputs: names of the m inputs.
    """
    # Whatever the ranges are, the order of the monomials is the same: on [-1, 1] their names are
    # short.
    plain = Features(
        features.states, ((-1.0, 1.0),) * len(features.states), features.degree, features.angles
    )
    names = [
        str(e.as_coeff_Mul()[1]).replace("**", "^").replace("*", " ") for e in plain.expressions
    ]
    return (*names, *(u if name == "1" else f"{u} {name}" for u in inputs for name in names))


def _steady(features: Features, inputs: Sequence[str], x: np.ndarray, u: np.ndarray) -> list[str]:
    found = []
    for state, (low, high), values in zip(features.states, features.region, x.T, strict=True):
        if np.ptp(values) <= _STILL * (high - low):
            found.append(
                f"the state {state} is always {values[0]:g}: how anything depends on it cannot be"
                " learned"
            )
    for name, values in zip(inputs, u.T, strict=True):
        if np.ptp(values) <= _STEADY * abs(values).max():
            found.append(
                f"the input {name} stays within [{values.min() + 0.0:g}, {values.max() + 0.0:g}]:"
                " its effect cannot be told from the drift; try values of both signs"
            )
    return found


def _confounded(terms: Sequence[str], null: np.ndarray) -> str:
    """Return the groups of terms that mix in the null space with orthonormal basis (d, D)."""
    projector = null.T @ null
    involved = np.flatnonzero(projector.diagonal() > _PART)
    count, group = connected_components(
        abs(projector[np.ix_(involved, involved)]) > _PART, directed=False
    )
    members: list[list[str]] = [[terms[int(k)] for k in involved[group == g]] for g in range(count)]
    texts = [
        " and ".join(_shortened(m)) if len(m) > 1 else f"{m[0]} (never excited)" for m in members
    ]
    return "; ".join(_shortened(texts))


def _weak(
    terms: Sequence[str], seen: np.ndarray, learned: Gaussian, prior: float
) -> list[tuple[str, ...]]:
    """Return for each output the terms in directions that the data hardly show."""
    # `seen` (r, D) is a basis of the directions that they show at all.
    values, vectors = np.linalg.eigh(seen @ learned.covariance @ seen.T)
    found = []
    for sizes, directions in zip(values, vectors, strict=True):
        weights = (seen.T @ directions[:, sizes > _WEAK * prior]) ** 2
        found.append(tuple(terms[int(k)] for k in np.flatnonzero(weights.sum(axis=1) > _PART)))
    return found


def _by_state(features: Features, weak: list[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Names of the states with the same weak terms, and these."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for state, names in zip(features.states, weak, strict=True):
        if names:
            groups.setdefault(names, []).append(state.name)
    return [(", ".join(states), ", ".join(_shortened(names))) for names, states in groups.items()]


def _shortened(names: Sequence[str]) -> list[str]:
    left = len(names) - _MOST_NAMED
    return [*names[:_MOST_NAMED], *([f"{left} more"] if left > 0 else [])]


_HIGHEST_DEGREE = 3
_MOST_WEIGHTS = 200
_HELD_OUT = 0.2
_FEWEST_HELD_OUT = 10
_COLLECTING = 0.8


def identify(  # noqa: PLR0913 - the friendly keyword form
    problem: SafetyProblem,
    *,
    starts: int = 1000,
    steps: int = 1,
    repetitions: int = 100,
    degree: int | None = None,
    prior: float = 10.0,
    diffusion_degree: int = 0,
    alpha: float = 1.0,
    beta: float = 1.0,
    errors_in_variables: bool = True,
    data: Transitions | None = None,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Learn f, g and sigma of a problem's plant.

    (x' - x)/dt = f(x) + g(x) u + noise of the covariance sigma sigma'/dt is regressed on features
    of the state, and on these times each input. The noise follows from repetitions, or in a log
    from what the fit leaves.

    Args:
        problem: its sampling domain says where and under which inputs data are collected.
        starts: number of trajectories.
        steps: of each.
        repetitions: K of each step.
        degree: of the features; None for the highest up to 3 with at most 200 weights for each
            state and two rows for each.
        prior: variance of each weight before, where each state is scaled from its region to [-1,
            1], each input by the largest that was tried, and time is in s.
        diffusion_degree: of the features on which the variances of the noise are regressed; 0 for
            constant noise.
        alpha: shape of the inverse-gamma prior of a constant sigma.
        beta: its scale, in the units of sigma.
        errors_in_variables: whether to correct the bias that the errors of the problem's sensor
            make, if it has one; see `safe_envs.filters.learning.bayesian`.
        data: to learn from, instead of collecting any.
        seed: of all randomness.
        step: how the system is stepped; None for the plant.
        progress: called with the part that is done.

    Returns:
        What was learned. Warns (`IdentifiabilityWarning`) of what the data do not tell.

    Raises:
        LearnedFileError: the data are of another problem.
        ConfigurationError: an argument is not allowed, or the data are too few to tell the noise.

    Source: thesis Sec. 6.2 and 6.3.1; 10 starts x 100 steps and the priors 10 I (cubic) and 1e4 I
        (ACC) were taken for what the thesis leaves open. It identifies f under u = 0 and g under
        u = .1; here both come from inputs of both signs.
    """
    began = time.perf_counter()
    require_problem(problem)
    require_prior(alpha, beta)
    if not 0 < prior < math.inf:
        raise ConfigurationError(
            f"prior = {shown(prior)}; the variance of the weights is positive and finite"
        )
    collected = data is None
    if data is None:
        collecting = None if progress is None else lambda part: progress(_COLLECTING * part)
        data = collect(
            problem, starts, repetitions, steps=steps, seed=seed, step=step, progress=collecting
        )
    require_kind("data", data, Transitions, "collect, Transitions.from_log or Transitions.load")
    data.require(problem)
    rows = Rows.of(data)
    chosen = _degree(problem, len(rows.x)) if degree is None else degree
    features = Features.of(problem, chosen)
    varying = (
        Features.of(problem, diffusion_degree, "diffusion_degree") if diffusion_degree else None
    )
    half = 0.5 * np.ptp(problem.sampling_domain.region, axis=1)
    largest = abs(rows.u).max(axis=0)
    scale = 1.0 / np.where(largest > 0, largest, 1.0)
    design, believed = rows.design(features, scale), Prior(prior * half**2, alpha, beta)
    deviations = sensor_deviations(problem)
    if errors_in_variables and deviations.any():
        if varying is not None:
            raise ConfigurationError(
                f"diffusion_degree = {diffusion_degree}: noise that varies is not told from that of"
                " the sensor; leave it out, or give errors_in_variables=False"
            )
        # What was left out is measured with errors too, and says little.
        errors = {}
        found = corrected_fit(rows, features, scale, deviations, believed)
    else:
        errors = _held_out(data, features, scale, varying, believed)
        found = fit(rows, design, varying, believed)
    names = [u.name for u in problem.plant.inputs]
    warned = (
        *weaknesses(
            features,
            names,
            rows.x,
            rows.u,
            design,
            Gaussian(
                found.learned.mean / half[:, None],
                found.learned.covariance / (half**2)[:, None, None],
            ),
            prior,
        ),
        *misfits(features, found.misfit, found.variation),
        *region_warnings(problem, data),
    )
    for text in warned:
        warnings.warn(text, IdentifiabilityWarning, stacklevel=2)
    settings = {
        **({"starts": starts, "steps": steps} if collected else {"points": data.points}),
        "repetitions": data.repetitions,
        "degree": chosen,
        "diffusion_degree": diffusion_degree,
        "prior": prior,
        "alpha": alpha,
        "beta": beta,
        **({"errors_in_variables": errors_in_variables} if deviations.any() else {}),
        # Of data from elsewhere it is not known how finely a step was integrated: see
        # `safe_envs.proofs.posterior`.
        **({"substeps": problem.substeps} if collected and step is None else {}),
    }
    if progress is not None:
        progress(1.0)
    record = Record(
        data.count, data.observed, time.perf_counter() - began, data.seed, errors, settings, warned
    )
    weights = found.learned.mean, found.learned.covariance
    rest = found.diffusion, float(data.dt.mean()), found.misfit, found.variation
    inputs = problem.plant.inputs
    return Posterior(data.signature, record, features, inputs, scale, *weights, *rest)


def _degree(problem: SafetyProblem, rows: int) -> int:
    """Return the highest degree that the number of weights allows."""
    lowest = Features.of(problem, 1)
    coordinates = lowest.count - 1
    parts = 1 + len(problem.inputs)
    allowed = [
        d
        for d in range(2, _HIGHEST_DEGREE + 1)
        if math.comb(coordinates + d, d) * parts <= min(_MOST_WEIGHTS, rows / 2)
    ]
    return max(allowed, default=1)


def _held_out(
    data: Transitions, features: Features, scale: np.ndarray, varying: Features | None, prior: Prior
) -> dict[str, float]:
    """Return root-mean-square errors of the rates at start states left out, for each state."""
    # They are in its units per s, with the part that the noise of the data explains; and in
    # standard deviations of the prediction, which are 1 where the posterior is right. Empty where
    # the data are too few to leave any out.
    if len(np.unique(data.x, axis=0)) < _FEWEST_HELD_OUT:
        return {}
    trained, held = (
        Rows.of(part)
        for part in data.split(_HELD_OUT, random_stream(data.seed or 0, Purpose.HELD_OUT))
    )
    found = fit(trained, trained.design(features, scale), varying, prior)
    design = held.design(features, scale)
    error = held.rate - design @ found.learned.mean.T
    noise = found.diffusion.variances(held.x) / (held.dt * held.count)[:, None]
    doubt = np.einsum("bd,nde,be->bn", design, found.learned.covariance, design, optimize=True)
    sizes = {"error": error**2, "noise": noise, "standardised": error**2 / (noise + doubt)}
    return {
        f"{state} {name}": float(np.sqrt(values[:, i].mean()))
        for i, state in enumerate(features.states)
        for name, values in sizes.items()
    }
