"""What chapter 6 shares: Bayesian identifications, their errors, and controllers that use them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from scipy.special import stdtrit

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import rate_interval
from safe_envs.filters.learning.bayesian import IdentifiabilityWarning, identify
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.data import Transitions
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.scripts.figures.style import COLORS
from safe_envs.wrappers import AffineConstraint
from thesis.artefact import Claim, Number, Sample, settings
from thesis.rates import (
    PRINTED_EPISODES,
    Flags,
    MeasuredFilter,
    PrintedCondition,
    difference,
    measure,
)

SETTINGS = settings(6, "identification")
FEWEST, MOST = min(SETTINGS.repetitions), max(SETTINGS.repetitions)  # K
AT_REST = ((0.0,),)  # inputs of the data for f alone, and of those for sigma
CONFIDENCE = 0.95


def identified(
    problem: SafetyProblem, repetitions: int, seed: int, prior: float, *, inputs: Any = None
) -> Posterior:
    """Return what is learned of f, g and sigma from trajectories with K repetitions of each step.

    The inputs of the data are by default of both signs; `prior` is the precision of the prior.
    """
    steps = SETTINGS.steps
    data = collect(problem, SETTINGS.starts, repetitions, inputs, steps=steps, seed=seed)
    return identified_from(problem, data, prior)


def identified_from(problem: SafetyProblem, data: Transitions, prior: float) -> Posterior:
    """Return what is learned of f, g and sigma from data."""
    with warnings.catch_warnings():
        # Data at a single input do not identify g, on purpose.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        return identify(problem, data=data, degree=SETTINGS.degree, prior=prior)


def estimated_drift(learned: Posterior, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimate of f and its standard deviation at states, shape (B, n) each."""
    mean = learned.features.matrix(x) @ learned.mean[:, : learned.features.count].T
    return mean, np.sqrt(learned.drift_variance(x)[:, :, 0, 0])


def true_drift(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """Return the plant's f at states, shape (B, n)."""
    f = sp.lambdify([problem.plant.states], list(problem.plant.numeric(problem.plant.drift)))
    return np.array([f(row) for row in x.tolist()], dtype=float)


def seeds(sample: Sample, full: int) -> range:
    """Return seeds of identifications, others for each seed of the sample.

    A quick sample has a tenth, and three if there are as many.
    """
    count = max(2, min(full, 3), full // 10) if sample.quick else full
    return range(1000 * sample.seed, 1000 * sample.seed + count)


def one_more(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Return the 95 % prediction interval of one more normal value: mean +- t s sqrt(1 + 1/n)."""
    mean = float(np.mean(values))
    quantile = stdtrit(len(values) - 1, 0.5 + CONFIDENCE / 2)
    half = float(quantile * np.std(values, ddof=1)) * math.sqrt(1 + 1 / len(values))
    return mean - half, mean + half


def predicted(name: str, values: Any, printed: float | None = None, unit: str = "") -> Number:
    """Return the geometric mean of a positive quantity, and the prediction interval of one more.

    Its logarithm is taken for normal. A printed number is of one identification: it is one more.
    """
    logarithms = np.log(values)
    low, high = map(math.exp, one_more(logarithms))
    return Number(name, float(np.exp(logarithms.mean())), low, high, printed, unit=unit)


def draw_estimate(
    axes: Axes, curve: tuple[Any, Any], across: Any, estimate: Any, deviation: Any
) -> None:
    """Draw a true curve, and estimates (B,) over abscissas with what the posterior leaves open."""
    axes.plot(*curve, color="black", linewidth=1.4, label="true value", zorder=3)
    style: dict[str, Any] = {"color": COLORS[0], "markersize": 3.5, "elinewidth": 1.0}
    label = "estimate, with 95 % of its posterior"
    axes.errorbar(across, estimate, 1.96 * deviation, fmt="o", label=label, **style)


def printed_rate(
    name: str, problem: SafetyProblem, formula: sp.Expr, episodes: int, seed: int
) -> Number:
    """Return the safety rate under a printed formula, affine in the inputs, that is to be >= 0."""
    condition = PrintedCondition(partial(_constraint, formula))
    return measure(problem, condition, episodes, seed).number(name)


def _constraint(formula: sp.Expr, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
    slopes = [sp.diff(formula, u) for u in model.inputs]
    terms = [a * u for a, u in zip(slopes, model.inputs, strict=True)]
    return AffineConstraint(tuple(slopes), sp.expand(formula - sum(terms)), (barrier.expression,))


def rate_of_one_more(name: str, flags: Flags, printed: float | None = None) -> Number:
    """Return the mean rate over identifications, and the interval of that with one more of them.

    A printed rate, in per cent, is with a single one. The distances from the mean to the ends of
    the interval over episodes, which all identifications share, and those of the prediction
    interval over identifications are added as squares.
    """
    rates, episodes = [float(np.mean(each)) for each in flags], len(flags[0])
    mean = float(np.mean(rates))
    low, high = rate_interval(round(mean * episodes), episodes)
    half = mean - one_more(rates)[0]
    low = max(mean - math.hypot(mean - low, half), 0.0)
    high = min(mean + math.hypot(high - mean, half), 1.0)
    trials = None if printed is None else PRINTED_EPISODES
    return Number(name, 100 * mean, 100 * low, 100 * high, printed, trials, "%")


def against(found: MeasuredFilter, reference: MeasuredFilter) -> str:
    """Return by how much rates with identifications differ from that of a reference, in words."""
    gap, rates = difference("", found.flags, reference.flags), found.rates
    return (
        f"{gap.text} on average over {len(rates)} identifications, with rates of"
        f" {100 * min(rates):.1f} to {100 * max(rates):.1f} %"
    )


def similar(each: Mapping[str, tuple[MeasuredFilter, MeasuredFilter]]) -> Claim:
    """Return the claim that an identified system is as safe as the real one at each start.

    `each` holds the filters for the identified and for the real system by the start. It is decided
    by the interval of the mean difference.

    Source: thesis Sec. 7.1, which gives no number: the largest printed difference is taken for the
        limit.
    """
    ends = [difference("", found.flags, real.flags).ends for found, real in each.values()]
    return Claim(
        "The learned system has a safety ratio similar to the real one's: up to"
        f" {SETTINGS.similar:g} points apart, as in the thesis.",
        all(max(-low, high) <= SETTINGS.similar for low, high in ends),
        "; ".join(f"{place}: {against(*pair)}" for place, pair in each.items()),
    )
