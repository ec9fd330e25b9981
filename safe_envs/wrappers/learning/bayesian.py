"""Bayesian identification of a control-affine system of which nothing is known, from one-step data."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm
from scipy.stats import f as fisher

from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.base import Progress, Record
from safe_envs.wrappers.learning.checks import Purpose, random_stream, require_kind, require_problem
from safe_envs.wrappers.learning.data.collection import Step, collect
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.estimators import region_warnings
from safe_envs.wrappers.learning.identifiability import IdentifiabilityWarning, misfits, weaknesses
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.posterior import Diffusion, Posterior
from safe_envs.wrappers.learning.regression import Gaussian, Rows, grouped, posterior

_HIGHEST_DEGREE = 3
_MOST_WEIGHTS = 200
_HELD_OUT = 0.2
_FEWEST_HELD_OUT = 10
_COLLECTING = 0.8
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
        missed = np.where(beyond, np.maximum((error**2 - variance).mean(axis=0), 0.0), 0.0)
        learned = posterior(
            design, rows.rate, variance * np.where(beyond, excess, 1.0), prior.weights
        )
        learned.covariance[:, 0, 0] += missed
        misfit = np.sqrt(missed / (size + _SMALLEST))
    return Fit(
        learned,
        noise,
        misfit,
        np.zeros(len(size)) if features else _variation(rows, residual, noise),
    )


def _residuals(rows: Rows, design: np.ndarray) -> tuple[np.ndarray, float]:
    """What is noise in the R transitions, (R, n), and its degrees of freedom N.

    The scatter within the rows where these repeat, and else what a first fit leaves.
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
    """Weights of variances per s, from mean squares (G, n) whose own noise is told by what the fit
    leaves.
    """
    weight = np.sqrt(count)[:, None]
    solution, _, rank, _ = np.linalg.lstsq(phi * weight, targets * weight, rcond=None)
    left = ((targets - phi @ solution) ** 2 * count[:, None]).sum(axis=0) / max(len(phi) - rank, 1)
    return posterior(phi, targets, np.maximum(left, _SMALLEST) / count[:, None], prior)


def _variation(rows: Rows, residual: np.ndarray, noise: Diffusion) -> np.ndarray:
    """Part by which the variance of each state varies, as a quadratic of the state, (n,); 0 where
    that may be chance.
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
    """Correlations of residuals (R, n) of variance 1; the unit matrix where none is significant,
    and 0 for a state without noise.
    """
    n = white.shape[1]
    sizes = np.sqrt((white**2).sum(axis=0))
    sizes[sizes == 0] = 1.0
    found = (white / sizes).T @ (white / sizes)
    np.fill_diagonal(found, 1.0)
    limit = norm.isf((1.0 - _SURE) / max(n * (n - 1), 1)) / math.sqrt(len(white))
    return found if (abs(found - np.eye(n)) > limit).any() else np.eye(n)


def identify(
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
    data: Transitions | None = None,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Learn f, g and sigma of a problem's plant.

    (x' - x)/dt = f(x) + g(x) u + noise of the covariance sigma sigma'/dt is regressed on features
    of the state, and on these times each input. The noise is told by repetitions, or in a log by
    what the fit leaves.

    Args:
        problem: its exploration says where and under which inputs data are collected.
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
        data: to learn from, instead of collecting any.
        seed: of all randomness.
        step: how the system is stepped; None for the plant.
        progress: is told which part is done.

    Returns:
        What was learned. Warns (`IdentifiabilityWarning`) of what the data do not tell.

    Raises:
        LearnedFileError: the data are of another problem.
        ConfigurationError: an argument is not allowed, or the data are too few to tell the noise.

    Source: thesis Sec. 6.2 and 6.3.1; 10 starts x 100 steps and the priors 10 I (cubic) and 1e4 I
        (ACC) were taken for what the
    print leaves open. The print identifies f under u = 0 and g under u = .1; here both come from
    inputs of both signs.
    """
    began = time.perf_counter()
    require_problem(problem)
    _require_prior(prior, alpha, beta)
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
    half = 0.5 * np.ptp(problem.exploration.region, axis=1)
    largest = abs(rows.u).max(axis=0)
    scale = 1.0 / np.where(largest > 0, largest, 1.0)
    design, believed = rows.design(features, scale), Prior(prior * half**2, alpha, beta)
    errors = _held_out(data, features, scale, varying, believed)
    found = fit(rows, design, varying, believed)
    names = [u.name for u in problem.plant.inputs]
    told = (
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
    for text in told:
        warnings.warn(text, IdentifiabilityWarning, stacklevel=2)
    settings = {
        **({"starts": starts, "steps": steps} if collected else {"points": data.points}),
        "repetitions": data.repetitions,
        "degree": chosen,
        "diffusion_degree": diffusion_degree,
        "prior": prior,
        "alpha": alpha,
        "beta": beta,
        # Of data from elsewhere it is not known how finely a step was integrated: see
        # `safe_envs.wrappers.verification.step_bias`.
        **({"substeps": problem.substeps} if collected and step is None else {}),
    }
    if progress is not None:
        progress(1.0)
    record = Record(
        data.count, data.observed, time.perf_counter() - began, data.seed, errors, settings, told
    )
    learned, dt = found.learned, float(data.dt.mean())
    weights = learned.mean, learned.covariance
    return Posterior(
        data.signature,
        record,
        features,
        problem.plant.inputs,
        scale,
        *weights,
        found.diffusion,
        dt,
        found.misfit,
        found.variation,
    )


def _require_prior(prior: float, alpha: float, beta: float) -> None:
    if not 0 < prior < math.inf:
        raise ConfigurationError(
            f"prior = {shown(prior)}; the variance of the weights is positive and finite"
        )
    for name, value in (("alpha", alpha), ("beta", beta)):
        if not 0 <= value < math.inf:
            raise ConfigurationError(
                f"{name} = {shown(value)}; the prior of sigma needs a finite number from 0"
            )


def _degree(problem: SafetyProblem, rows: int) -> int:
    """The highest degree that the number of weights allows."""
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
    """Root-mean-square errors of the rates at start states that were left out, for each state.

    In its units per s, beside what the noise of the data makes of it; and in standard deviations of
    the prediction, which is 1 where the posterior is right. Empty where the data are too few to
    leave any out.
    """
    if len(np.unique(data.x, axis=0)) < _FEWEST_HELD_OUT:
        return {}
    kept, held = (
        Rows.of(part)
        for part in data.split(_HELD_OUT, random_stream(data.seed or 0, Purpose.HELD_OUT))
    )
    found = fit(kept, kept.design(features, scale), varying, prior)
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
