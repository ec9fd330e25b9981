"""Figures 6.2 and 6.4: the posterior of the noise levels of the cubic system and of the car."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS, add_legend
from safe_envs.scripts.reproduce.chapter_6 import identifications as bayes
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.estimators import rates
from safe_envs.wrappers.learning.models.distributions import sigma_map, sigma_samples

NOISE_STARTS, NOISE_STEPS, DRAWS = (
    bayes.SETTINGS[name] for name in ("noise_starts", "noise_steps", "draws")
)
PRIOR_OF_SIGMA = bayes.SETTINGS["prior_of_sigma"]
_BINS = 50


def credible(name: str, draws: np.ndarray, unit: str) -> Number:
    """Return the median of many draws from a posterior, and what holds 95 % of it.

    Args:
        name: of the number.
        draws: shape (D,).
        unit: of the draws.
    """
    low, high = np.quantile(draws, _ends(bayes.CONFIDENCE)).tolist()
    return Number(name, float(np.median(draws)), low, high, unit=unit)


def _ends(content: float) -> tuple[float, float]:
    """Return the levels between which there is so much of a distribution."""
    return (1 - content) / 2, (1 + content) / 2


def noise_levels(section: str, unit: tuple[str, ...], sample: Workload) -> Findings:
    """Sample the posterior of sigma from the residuals of fresh trajectories, given f and g.

    Args:
        section: of the settings.
        unit: of each level.
        sample: how much is simulated.

    Returns:
        Medians and intervals of the levels, by the corrected and by the printed likelihood.
    """
    env, prior = (bayes.CHAPTER.settings[section][name] for name in ("env", "prior"))
    problem = make_problem(env)
    first, second, *_ = bayes.seeds(sample, 2)
    learned = bayes.identified(problem, bayes.REPETITIONS[-1], first, prior)
    data = collect(
        problem, sample.work(NOISE_STARTS), 1, bayes.AT_REST, steps=NOISE_STEPS, seed=second
    )
    left = data.successors[:, 0] - data.x - rates(learned.system, data) * problem.dt
    squares, count = (left**2).sum(axis=0), len(left)
    rng = np.random.default_rng([sample.seed, 63])
    alpha, beta = PRIOR_OF_SIGMA
    true = [problem.plant.parameter_values[name] for name in ("sigma_1", "sigma_2")]
    numbers, printed, every, shown = [], [], [], {"truth": true}
    for i, (s, at) in enumerate(zip(squares.tolist(), unit, strict=True), start=1):
        draws = sigma_samples(s / problem.dt, count, alpha, beta, DRAWS, rng)
        # The printed formula: no dt, and one factor less.
        wrong = sigma_samples(s, count - 1, alpha, beta, DRAWS, rng)
        numbers.append(credible(f"sigma_{i}", draws, at))
        printed.append(credible(f"sigma_{i}", wrong, at))
        every.append(draws)
        counts, edges = np.histogram(draws, bins=_BINS)
        shown |= {f"counts {i}": counts.tolist(), f"edges {i}": edges.tolist()}
    modes = sigma_map(squares / problem.dt, np.full(len(squares), count), alpha, beta).tolist()
    sharp = np.mean([draws.std() / draws.mean() for draws in every])
    probable = ", ".join(f"sigma_{i} = {mode:.4f}" for i, mode in enumerate(modes, start=1))
    law = {"deviation": 100 * sharp, "law": 100 / np.sqrt(2 * count), "count": count}
    return Findings(
        numbers=numbers,
        claims=[gathered(every, true)],
        printed_formula=printed,
        data=shown,
        notes=[bayes.CHAPTER.note("figure-6.2", "modes", modes=probable, **law)],
    )


def gathered(every: Sequence[np.ndarray], true: Sequence[float]) -> Claim:
    """Return the claim that posteriors are around the true values.

    Together they are in 95 % of all cases, so that each interval holds a little more.

    Args:
        every: draws from each posterior.
        true: value of each level.
    """
    levels = _ends(1 - (1 - bayes.CONFIDENCE) / len(every))
    found = [tuple(np.quantile(draws, levels).tolist()) for draws in every]
    content = f"{100 * (levels[1] - levels[0]):g} %"
    holds = all(low <= level <= high for (low, high), level in zip(found, true, strict=True))
    each = "; ".join(
        f"{content} of that of sigma_{i} in [{low:.4f}, {high:.4f}], true {level:g}"
        for i, ((low, high), level) in enumerate(zip(found, true, strict=True), start=1)
    )
    return bayes.CHAPTER.claim("figure-6.2", "gathered", holds, each=each)


def _draw_levels(figure: Figure, outcome: Findings) -> None:
    """Draw histograms of the draws, and the medians by the printed likelihood."""
    data = outcome.data
    panels = figure.subplots(1, 3)
    for i, (letter, axes, number) in enumerate(
        zip("ab", panels, outcome.numbers, strict=False), start=1
    ):
        name, style = f"$\\sigma_{i}$", {"color": COLORS[i - 1], "alpha": 0.6}
        axes.stairs(data[f"counts {i}"], data[f"edges {i}"], fill=True, label=name, **style)
        axes.axvline(data["truth"][i - 1], color="black", linewidth=1.4, label="true value")
        axes.set(xlabel=labelled(name, number.unit), title=f"({letter}) {name}")
        axes.locator_params(axis="x", nbins=4)
    panels[0].set_ylabel("draws")
    _draw_likelihoods(panels[2], outcome)
    first, second = (axes.get_legend_handles_labels()[0] for axes in panels[:2])
    add_legend(figure, [first[0], *second])


def _draw_likelihoods(axes: Axes, outcome: Findings) -> None:
    """Draw medians by either likelihood; their intervals are thinner than the points."""
    truth = outcome.data["truth"][0]
    for row, numbers in enumerate((outcome.numbers, outcome.printed_formula)):
        for i, number in enumerate(numbers):
            # One above the other, for they are nearly equal.
            style: dict[str, Any] = {"color": COLORS[i], "markersize": 4.5, "alpha": 0.8}
            axes.plot(number.ours, row + 0.12 * (1 - 2 * i), "os"[i], **style)
    axes.axvline(truth, color="black", linewidth=1.0, zorder=0)
    low = outcome.printed_formula[0].ours
    ticks = [float(f"{t:.1g}") for t in (low, np.sqrt(low * truth), truth)]
    axes.set(
        xscale="log",
        xlim=(low / 2, truth * 2),
        ylim=(-0.6, 1.6),
        xlabel="median of $\\sigma$ [units of a, b]",
        title="(c) both likelihoods",
    )
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.set_yticks([0, 1], ["corrected", "printed"], rotation=90, va="center")


def _values(sigma: str, sample: Workload) -> dict[str, Any]:
    return {"trajectories": sample.work(NOISE_STARTS), "sigma": sigma}


ARTEFACTS = tuple(
    bayes.CHAPTER.artefact(
        name, partial(noise_levels, section, unit), partial(_values, sigma), _draw_levels
    )
    for name, section, unit, sigma in (
        ("figure-6.2", "cubic", ("1/sqrt(s)", "1/sqrt(s)"), ".2"),
        ("figure-6.4", "car", ("m/s/sqrt(s)", "m/sqrt(s)"), ".5"),
    )
)
