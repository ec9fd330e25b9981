"""What the figures and tables of chapter 6 share: Bayesian identifications and their errors."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from scipy.special import stdtrit

from safe_envs import SafetyProblem
from safe_envs.scripts.reproduce.framework.artefact import Number, Workload
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.wrappers.learning.bayesian import identify
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.identifiability import IdentifiabilityWarning
from safe_envs.wrappers.learning.models.posterior import Posterior

CHAPTER = chapter(6)
SETTINGS = CHAPTER.settings["identification"]
STARTS, STEPS, REPETITIONS = (SETTINGS[name] for name in ("starts", "steps", "repetitions"))
DEGREE = 3  # of the features
AT_REST = ((0.0,),)  # inputs of the data for f alone, and of those for sigma
CONFIDENCE = 0.95


def identified(
    problem: SafetyProblem, repetitions: int, seed: int, prior: float, *, inputs: Any = None
) -> Posterior:
    """Return what is learned of f, g and sigma from trajectories.

    Args:
        problem: that is identified.
        repetitions: K of each step.
        seed: of the data.
        prior: precision of the prior.
        inputs: of the data, by default of both signs.
    """
    data = collect(problem, STARTS, repetitions, inputs, steps=STEPS, seed=seed)
    return identified_from(problem, data, prior)


def identified_from(problem: SafetyProblem, data: Transitions, prior: float) -> Posterior:
    """Return what is learned of f, g and sigma from data.

    Args:
        problem: that is identified.
        data: of it.
        prior: precision of the prior.
    """
    with warnings.catch_warnings():
        # Data at a single input do not identify g, on purpose.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        return identify(problem, data=data, degree=DEGREE, prior=prior)


def estimated_drift(learned: Posterior, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimate of f and its standard deviation, shape (B, n) each.

    Args:
        learned: the identification.
        x: states, shape (B, n).
    """
    mean = learned.features.matrix(x) @ learned.mean[:, : learned.features.count].T
    return mean, np.sqrt(learned.drift_variance(x)[:, :, 0, 0])


def true_drift(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """Return the plant's f at states, shape (B, n).

    Args:
        problem: with the plant.
        x: states, shape (B, n).
    """
    f = sp.lambdify([problem.plant.states], list(problem.plant.numeric(problem.plant.drift)))
    return np.array([f(row) for row in x.tolist()], dtype=float)


def seeds(sample: Workload, full: int) -> range:
    """Return seeds of identifications, others for each seed of the sample.

    A quick sample has a tenth, and three if there are as many.

    Args:
        sample: how much is simulated.
        full: number of identifications in the full work.
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

    Its logarithm is taken for normal. A printed number is of a single identification: it is one
    more.

    Args:
        name: of the number.
        values: of the identifications, shape (R,).
        printed: in the thesis.
        unit: of the values.
    """
    logarithms = np.log(values)
    low, high = one_more(logarithms)
    return Number(
        name, float(np.exp(logarithms.mean())), math.exp(low), math.exp(high), printed, unit=unit
    )


def draw_estimate(
    axes: Axes, curve: tuple[Any, Any], across: Any, estimate: Any, deviation: Any, color: str
) -> None:
    """Draw a true curve, and estimates with what the posterior leaves open.

    Args:
        axes: where.
        curve: abscissas and values of the true curve.
        across: abscissas of the estimates.
        estimate: their values.
        deviation: their standard deviations.
        color: of the estimates.
    """
    axes.plot(*curve, color="black", linewidth=1.4, label="true value", zorder=3)
    bars = 1.96 * np.array(deviation)
    style: dict[str, Any] = {"color": color, "markersize": 3.5, "elinewidth": 1.0}
    label = "estimate, with 95 % of its posterior"
    axes.errorbar(across, estimate, bars, fmt="o", label=label, **style)
