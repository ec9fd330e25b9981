"""Figures 6.2 and 6.4: the posterior of the noise levels of the cubic system and of the car."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs.agents import make_problem
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.drift_checks import rates
from safe_envs.filters.learning.models.distributions import sigma_samples
from safe_envs.scripts.figures.style import COLORS, add_legend, labelled
from thesis.artefact import Claim, Number, Outcome, Sample, settings
from thesis.chapter_6 import bayes
from thesis.chapter_6.bayes import SETTINGS


def compute(section: str, sample: Sample) -> tuple[Outcome, Any]:
    """Sample the posterior of sigma from the residuals of fresh trajectories, given f and g."""
    system = settings(6, section)
    problem, steps = make_problem(system.env), SETTINGS.noise_steps
    first, second, *_ = bayes.seeds(sample, 2)
    learned = bayes.identified(problem, bayes.MOST, first, system.prior)
    starts = sample.work(SETTINGS.noise_starts)
    data = collect(problem, starts, 1, bayes.AT_REST, steps=steps, seed=second)
    left = data.successors[:, 0] - data.x - rates(learned.system, data) * problem.dt
    rng, count = np.random.default_rng([sample.seed, 63]), len(left)
    alpha, beta = SETTINGS.prior_of_sigma
    numbers, printed, draws = [], [], []
    for i, (square, unit) in enumerate(
        zip((left**2).sum(axis=0).tolist(), system.unit, strict=True)
    ):
        draws.append(sigma_samples(square / problem.dt, count, alpha, beta, SETTINGS.draws, rng))
        # The printed formula: no dt, and one factor less.
        wrong = sigma_samples(square, count - 1, alpha, beta, SETTINGS.draws, rng)
        numbers.append(credible(f"sigma_{i + 1}", draws[-1], unit))
        printed.append(credible(f"sigma_{i + 1}", wrong, unit))
    true = [problem.plant.parameter_values[name] for name in ("sigma_1", "sigma_2")]
    outcome = Outcome(
        numbers,
        [gathered(draws, true)],
        printed_formula=printed,
    )
    return outcome, partial(_draw, draws, true, system.unit)


def credible(name: str, draws: np.ndarray, unit: str) -> Number:
    """Return the median of draws (D,) from a posterior, and what holds 95 % of it."""
    low, high = np.quantile(draws, _ends(bayes.CONFIDENCE)).tolist()
    return Number(name, float(np.median(draws)), low, high, unit=unit)


def _ends(content: float) -> tuple[float, float]:
    """Return the levels between which there is so much of a distribution."""
    return (1 - content) / 2, (1 + content) / 2


def gathered(draws: Sequence[np.ndarray], true: Sequence[float]) -> Claim:
    """Return the claim that posteriors, by draws from each, are around the true values.

    Together they are in 95 % of all cases, so that each interval holds a little more.
    """
    levels = _ends(1 - (1 - bayes.CONFIDENCE) / len(draws))
    ends = [np.quantile(each, levels).tolist() for each in draws]
    content = f"{100 * (levels[1] - levels[0]):g} %"
    return Claim(
        "The posteriors of sigma_1 and sigma_2 are around the true values.",
        all(low <= level <= high for (low, high), level in zip(ends, true, strict=True)),
        "; ".join(
            f"{content} of that of sigma_{i} in [{low:.4f}, {high:.4f}], true {level:g}"
            for i, ((low, high), level) in enumerate(zip(ends, true, strict=True), start=1)
        ),
    )


def _draw(
    draws: Sequence[np.ndarray], true: Sequence[float], unit: Sequence[str], figure: Figure
) -> None:
    """Draw histograms of the draws."""
    panels = figure.subplots(1, 2)
    for i, axes in enumerate(panels):
        name = f"$\\sigma_{i + 1}$"
        axes.hist(draws[i], bins=50, label=name, color=COLORS[i], alpha=0.6, histtype="stepfilled")
        axes.axvline(true[i], color="black", linewidth=1.4, label="true value")
        axes.set(xlabel=labelled(name, unit[i]), title=f"({'ab'[i]}) {name}")
        axes.locator_params(axis="x", nbins=4)
    panels[0].set_ylabel("draws")
    first, second = (axes.get_legend_handles_labels()[0] for axes in panels)
    add_legend(figure, [first[0], *second])


ARTEFACTS = {"figure-6.2": partial(compute, "cubic"), "figure-6.4": partial(compute, "car")}
