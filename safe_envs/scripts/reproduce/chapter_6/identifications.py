"""What the figures and tables of chapter 6 share: Bayesian identifications, their numbers, and the
posterior of the noise levels."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import stdtrit

from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.evaluation_figure import COLORS, add_legend
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number, Outcome, Sample
from safe_envs.wrappers.learning.bayesian import identify
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.estimators import rates
from safe_envs.wrappers.learning.identifiability import IdentifiabilityWarning
from safe_envs.wrappers.learning.models.posterior import Posterior
from safe_envs.wrappers.learning.regression import sigma_map, sigma_samples

STARTS, STEPS, DEGREE = 10, 100, 3
"""Of the data for the drift: trajectories, states of each, degree of the features."""

REPETITIONS = (10, 30, 100)
"""K of Table 6.1; controllers, figures of sigma and the car rest on the last."""

AT_REST = ((0.0,),)
"""Inputs of the data for f alone, and of those for sigma."""

NOISE_STARTS, NOISE_STEPS, DRAWS = 100, 300, 10_000
PRIOR_OF_SIGMA = (1.0, 1.0)
"""alpha and beta of Sec. 6.3.1."""

CONFIDENCE = 0.95
_BINS = 50

ONE_MORE = (
    "an interval holds one more identification with 95 %, if logarithms are normal: a printed"
    " number is of one"
)
"""What the intervals of `predicted` are."""

FIT_ERRATA = (
    (
        "Sec. 6.2.2: the noise of the data has the variance sigma^2/(K dt), with u1 and u2 besides,"
        " not sigma^2/K"
    ),
    "Eq. (6.13): K terms, not K + 1",
    "Sec. 6.3.1: Phi lacks x1^2 x2 and x1 x2^2; here the full cubic",
)
SIGMA_ERRATA = (
    (
        "Sec. 6.2.4: the likelihood is N(0, sigma^2 dt), with N factors; without dt it estimates"
        " sigma sqrt(dt)"
    ),
    "Eq. (6.11) has a closed solution",
)


def identified(
    problem: SafetyProblem, repetitions: int, seed: int, prior: float, *, inputs: Any = None
) -> Posterior:
    """Learn f, g and sigma from trajectories, by default under inputs of both signs."""
    return identified_from(
        problem, collect(problem, STARTS, repetitions, inputs, steps=STEPS, seed=seed), prior
    )


def identified_from(problem: SafetyProblem, data: Transitions, prior: float) -> Posterior:
    """Learn f, g and sigma from data."""
    with warnings.catch_warnings():
        # What data at a single input do not tell is meant.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        return identify(problem, data=data, degree=DEGREE, prior=prior)


def estimated_drift(learned: Posterior, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The estimate of f and its standard deviation at states (B, n), both (B, n)."""
    phi = learned.features.matrix(x)
    return phi @ learned.mean[:, : learned.features.count].T, np.sqrt(
        learned.drift_variance(x)[:, :, 0, 0]
    )


def true_drift(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """The plant's f at states (B, n)."""
    f = sp.lambdify([problem.plant.states], list(problem.plant.numeric(problem.plant.drift)))
    return np.array([f(row) for row in x.tolist()], dtype=float)


def noise_level(problem: SafetyProblem, name: str) -> float:
    """A noise level of the plant."""
    return {parameter.name: value for parameter, value in problem.plant.parameters.items()}[name]


def seeds(sample: Sample, full: int) -> range:
    """Seeds of identifications, others for each seed of the sample; a quick sample has a tenth, and
    three if there are as many."""
    count = max(2, min(full, 3), full // 10) if sample.quick else full
    return range(1000 * sample.seed, 1000 * sample.seed + count)


def one_more(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """The 95 % prediction interval of one more value, where they are normal: mean +- t s sqrt(1 +
    1/n)."""
    mean = float(np.mean(values))
    half = float(
        stdtrit(len(values) - 1, 0.5 + CONFIDENCE / 2) * np.std(values, ddof=1)
    ) * math.sqrt(1 + 1 / len(values))
    return mean - half, mean + half


def predicted(name: str, values: Any, printed: float | None = None, unit: str = "") -> Number:
    """The geometric mean of a positive quantity over identifications, and the 95 % prediction
    interval of one more.

    Its logarithm is taken for normal. A printed number is of a single identification: it is one
    more.
    """
    logarithms = np.log(values)
    low, high = one_more(logarithms)
    return Number(
        name, float(np.exp(logarithms.mean())), math.exp(low), math.exp(high), printed, unit=unit
    )


def credible(name: str, draws: np.ndarray, unit: str) -> Number:
    """The median of many draws from a posterior, and what holds 95 % of it."""
    low, high = np.quantile(draws, _ends(CONFIDENCE)).tolist()
    return Number(name, float(np.median(draws)), low, high, unit=unit)


def _ends(content: float) -> tuple[float, float]:
    """Levels between which there is so much of a distribution."""
    return (1 - content) / 2, (1 + content) / 2


def noise_levels(
    problem: SafetyProblem, sample: Sample, prior: float, unit: tuple[str, ...]
) -> Outcome:
    """Sample the posterior of sigma from the residuals of fresh trajectories, with the identified f
    and g known."""
    first, second, *_ = seeds(sample, 2)
    learned = identified(problem, REPETITIONS[-1], first, prior)
    data = collect(problem, sample.work(NOISE_STARTS), 1, AT_REST, steps=NOISE_STEPS, seed=second)
    left = data.successors[:, 0] - data.x - rates(learned.system, data) * problem.dt
    squares, count = (left**2).sum(axis=0), len(left)
    rng = np.random.default_rng([sample.seed, 63])
    true = [noise_level(problem, name) for name in ("sigma_1", "sigma_2")]
    numbers, printed, every, shown = [], [], [], {"truth": true}
    for i, (s, at) in enumerate(zip(squares.tolist(), unit, strict=True), start=1):
        draws = sigma_samples(s / problem.dt, count, *PRIOR_OF_SIGMA, DRAWS, rng)
        # The print: no dt, and one factor less.
        wrong = sigma_samples(s, count - 1, *PRIOR_OF_SIGMA, DRAWS, rng)
        numbers.append(credible(f"sigma_{i}", draws, at))
        printed.append(credible(f"sigma_{i}", wrong, at))
        every.append(draws)
        counts, edges = np.histogram(draws, bins=_BINS)
        shown |= {f"counts {i}": counts.tolist(), f"edges {i}": edges.tolist()}
    modes = sigma_map(squares / problem.dt, np.full(len(squares), count), *PRIOR_OF_SIGMA).tolist()
    sharp = np.mean([draws.std() / draws.mean() for draws in every])
    notes = [
        (
            "Most probable:"
            f" {', '.join(f'sigma_{i} = {mode:.4f}' for i, mode in enumerate(modes, start=1))}."
            f" Relative standard deviation {100 * sharp:.2f} %; by the law sqrt(1/(2 N))"
            f" {100 / np.sqrt(2 * count):.2f} % with N = {count} residuals."
        ),
    ]
    return Outcome(
        numbers=numbers, claims=[gathered(every, true)], as_printed=printed, data=shown, notes=notes
    )


def gathered(every: Sequence[np.ndarray], true: Sequence[float]) -> Claim:
    """That posteriors are around the true values: together in 95 % of all cases, so that each
    interval holds a little more."""
    levels = _ends(1 - (1 - CONFIDENCE) / len(every))
    found = [tuple(np.quantile(draws, levels).tolist()) for draws in every]
    content = f"{100 * (levels[1] - levels[0]):g} %"
    return Claim(
        "The posteriors of sigma_1 and sigma_2 are around the true values.",
        all(low <= level <= high for (low, high), level in zip(found, true, strict=True)),
        "; ".join(
            f"{content} of that of sigma_{i} in [{low:.4f}, {high:.4f}], true {level:g}"
            for i, ((low, high), level) in enumerate(zip(found, true, strict=True), start=1)
        ),
    )


def noise_setting(sample: Sample, rest: str) -> tuple[str, ...]:
    """How `noise_levels` goes."""
    return (
        (
            f"{sample.work(NOISE_STARTS)} trajectories of {NOISE_STEPS} steps of .01 s, {DRAWS}"
            f" draws, {rest}; alpha = beta = 1 in the prior of sigma"
        ),
        "an interval holds 95 % of the posterior",
    )


def draw_levels(figure: Figure, outcome: Outcome) -> None:
    """Histograms of the draws, and where the printed likelihood puts them."""
    data = outcome.data
    panels = figure.subplots(1, 3)
    for i, (letter, axes, number) in enumerate(
        zip("ab", panels, outcome.numbers, strict=False), start=1
    ):
        axes.stairs(
            data[f"counts {i}"],
            data[f"edges {i}"],
            fill=True,
            color=COLORS[i - 1],
            alpha=0.6,
            label=f"$\\sigma_{i}$",
        )
        axes.axvline(data["truth"][i - 1], color="black", linewidth=1.4, label="true value")
        axes.set(
            xlabel=f"$\\sigma_{i}$ ({_pretty(number.unit)})", title=f"({letter}) $\\sigma_{i}$"
        )
        axes.locator_params(axis="x", nbins=4)
    panels[0].set_ylabel("draws")
    _draw_likelihoods(panels[2], outcome)
    first, second = (axes.get_legend_handles_labels()[0] for axes in panels[:2])
    add_legend(figure, [first[0], *second])


def _draw_likelihoods(axes: Axes, outcome: Outcome) -> None:
    """Medians by either likelihood on one axis, where their intervals are thinner than the points."""
    truth = outcome.data["truth"][0]
    for row, numbers in enumerate((outcome.numbers, outcome.as_printed)):
        for i, number in enumerate(numbers):
            # One above the other, for they are nearly equal.
            axes.plot(
                number.ours,
                row + 0.12 * (1 - 2 * i),
                "os"[i],
                color=COLORS[i],
                markersize=6,
                alpha=0.8,
            )
    axes.axvline(truth, color="black", linewidth=1.0, zorder=0)
    low = outcome.as_printed[0].ours
    ticks = [float(f"{t:.1g}") for t in (low, np.sqrt(low * truth), truth)]
    axes.set(
        xscale="log",
        xlim=(low / 2, truth * 2),
        ylim=(-0.6, 1.6),
        xlabel="median of $\\sigma$ (units of a, b)",
        title="(c) both likelihoods",
    )
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.set_yticks([0, 1], ["corrected", "as printed"], rotation=90, va="center")


def draw_estimate(
    axes: Axes, curve: tuple[Any, Any], across: Any, estimate: Any, deviation: Any, color: str
) -> None:
    """A true curve, and estimates with what the posterior leaves open."""
    axes.plot(*curve, color="black", linewidth=1.4, label="true value", zorder=3)
    bars = 1.96 * np.array(deviation)
    axes.errorbar(
        across,
        estimate,
        bars,
        fmt="o",
        color=color,
        markersize=3.5,
        elinewidth=1.0,
        label="estimate, with 95 % of its posterior",
    )


def _pretty(unit: str) -> str:
    return unit.replace("sqrt(s)", "$\\sqrt{\\mathrm{s}}$")
