"""What the figures and tables of chapter 6 share: Bayesian identifications, their numbers, and the posterior of the noise levels."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.statistics import repeated_interval
from safe_envs.problem import SafetyProblem
from scripts.figure import COLORS, add_legend
from scripts.reproduce.artefact import Claim, Number, Outcome, Sample
from wrappers.learning.bayesian import identify
from wrappers.learning.collect import collect
from wrappers.learning.estimators import rates
from wrappers.learning.identifiability import IdentifiabilityWarning
from wrappers.learning.posterior import Posterior
from wrappers.learning.regression import sigma_map, sigma_samples

STARTS, STEPS, DEGREE = 10, 100, 3
"""Of the data for the drift: trajectories, states of each, degree of the features."""

REPETITIONS = (10, 30, 100)
"""K of Table 6.1; controllers, figures of sigma and the car rest on the last."""

AT_REST = ((0.0,),)
"""Inputs of the data for f alone, and of those for sigma."""

NOISE_STARTS, NOISE_STEPS, DRAWS = 100, 300, 10_000
_LEVELS = (0.025, 0.975)
_BINS = 50

FIT_ERRATA = (
    "Sec. 6.2.2: the noise of the data has the variance sigma^2/(K dt), with u1 and u2 besides, not sigma^2/K",
    "Eq. (6.13): K terms, not K + 1",
    "Sec. 6.3.1: Phi lacks x1^2 x2 and x1 x2^2; here the full cubic",
)
SIGMA_ERRATA = (
    "Sec. 6.2.4: the likelihood is N(0, sigma^2 dt), with N factors; without dt it estimates sigma sqrt(dt)",
    "Eq. (6.11) has a closed solution",
)


def identified(
    problem: SafetyProblem, repetitions: int, seed: int, prior: float, *, starts: int = STARTS, steps: int = STEPS, inputs: Any = None
) -> Posterior:
    """Learn f, g and sigma from trajectories, by default under inputs of both signs."""
    with warnings.catch_warnings():
        # What data at a single input do not tell is meant.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        data = collect(problem, starts, repetitions, inputs, steps=steps, seed=seed)
        return identify(problem, data=data, degree=DEGREE, prior=prior)


def estimated_drift(learned: Posterior, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The estimate of f and its standard deviation at states (B, n), both (B, n)."""
    phi = learned.features.matrix(x)
    return phi @ learned.mean[:, : learned.features.count].T, np.sqrt(learned.drift_variance(x)[:, :, 0, 0])


def true_drift(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """The plant's f at states (B, n)."""
    f = sp.lambdify([problem.plant.states], list(problem.plant.numeric(problem.plant.drift)))
    return np.array([f(row) for row in x.tolist()], dtype=float)


def noise_level(problem: SafetyProblem, name: str) -> float:
    """A noise level of the plant."""
    return {parameter.name: value for parameter, value in problem.plant.parameters.items()}[name]


def seeds(sample: Sample, full: int) -> range:
    """Seeds of identifications, others for each seed of the sample; at least two."""
    count = max(2, full // 10) if sample.quick else full
    return range(1000 * sample.seed, 1000 * sample.seed + count)


def spread(name: str, values: Any, printed: float | None = None, unit: str = "") -> Number:
    """The median over identifications, and what holds 95 % of them: a printed number is of a single one."""
    low, high = np.quantile(values, _LEVELS).tolist()
    return Number(name, float(np.median(values)), low, high, printed, unit=unit)


def averaged(name: str, values: Any, unit: str = "") -> Number:
    """The mean over identifications, with Student's interval."""
    mean = float(np.mean(values))
    low, high = repeated_interval(list(map(float, values)), (mean, mean), 0.95, (0.0, float("inf")))
    return Number(name, mean, low, high, unit=unit)


def noise_levels(problem: SafetyProblem, sample: Sample, prior: float, unit: tuple[str, ...]) -> Outcome:
    """Sample the posterior of sigma from the residuals of fresh trajectories, with the identified f and g known."""
    first, second, *_ = seeds(sample, 2)
    learned = identified(problem, REPETITIONS[-1], first, prior)
    starts, steps = sample.work(NOISE_STARTS), NOISE_STEPS
    data = collect(problem, starts, 1, AT_REST, steps=steps, seed=second)
    left = data.successors[:, 0] - data.x - rates(learned.system, data) * problem.dt
    squares, count = (left**2).sum(axis=0), len(left)
    rng = np.random.default_rng([sample.seed, 63])
    true = [noise_level(problem, name) for name in ("sigma_1", "sigma_2")]
    numbers, printed, shown, apart, sharp = [], [], {"truth": true}, [], []
    for i, (s, at) in enumerate(zip(squares.tolist(), unit, strict=True), start=1):
        draws = sigma_samples(s / problem.dt, count, 1.0, 1.0, DRAWS, rng)
        # The print: no dt, and one factor less.
        wrong = sigma_samples(s, count - 1, 1.0, 1.0, DRAWS, rng)
        numbers.append(spread(f"sigma_{i}", draws, unit=at))
        printed.append(spread(f"sigma_{i}", wrong, unit=at))
        apart.append(abs(draws.mean() - true[i - 1]) / draws.std())
        sharp.append(draws.std() / draws.mean())
        counts, edges = np.histogram(draws, bins=_BINS)
        shown |= {f"counts {i}": counts.tolist(), f"edges {i}": edges.tolist()}
    mode = sigma_map(squares / problem.dt, np.full(len(squares), count))
    evidence = [
        f"sigma_{i} {n.ours:.4f} [{n.low:.4f}, {n.high:.4f}], most probable {m:.4f}, true {t:g}, {a:.1f} standard deviations apart"
        for i, (n, m, t, a) in enumerate(zip(numbers, mode, true, apart, strict=True), start=1)
    ]
    claim = Claim("The posteriors of sigma_1 and sigma_2 gather at the true values.", bool(max(apart) < 3.0), "; ".join(evidence))
    note = (
        f"Relative standard deviation {100 * np.mean(sharp):.2f} %; by the law sqrt(1/(2 N)) {100 / np.sqrt(2 * count):.2f} % with "
        f"N = {count} residuals."
    )
    return Outcome(numbers=numbers, claims=[claim], as_printed=printed, data=shown, notes=[note])


def draw_levels(figure: Figure, outcome: Outcome) -> None:
    """Histograms of the draws, and where the printed likelihood puts them."""
    data = outcome.data
    panels = figure.subplots(1, 3)
    for i, (letter, axes, number) in enumerate(zip("ab", panels, outcome.numbers, strict=False), start=1):
        axes.stairs(data[f"counts {i}"], data[f"edges {i}"], fill=True, color=COLORS[i - 1], alpha=0.6, label=f"$\\sigma_{i}$")
        axes.axvline(data["truth"][i - 1], color="black", linewidth=1.4, label="true value")
        axes.set(xlabel=f"$\\sigma_{i}$ ({_pretty(number.unit)})", title=f"({letter}) $\\sigma_{i}$")
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
            axes.plot(number.ours, row + 0.12 * (1 - 2 * i), "os"[i], color=COLORS[i], markersize=6, alpha=0.8)
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


def draw_estimate(axes: Axes, curve: tuple[Any, Any], across: Any, estimate: Any, deviation: Any, color: str) -> None:
    """A true curve, and estimates with what the posterior leaves open."""
    axes.plot(*curve, color="black", linewidth=1.4, label="true value", zorder=3)
    bars = 1.96 * np.array(deviation)
    axes.errorbar(
        across, estimate, bars, fmt="o", color=color, markersize=3.5, elinewidth=1.0, label="estimate, with 95 % of its posterior"
    )


def _pretty(unit: str) -> str:
    return unit.replace("sqrt(s)", "$\\sqrt{\\mathrm{s}}$")
