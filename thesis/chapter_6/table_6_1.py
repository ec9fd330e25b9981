"""Table 6.1 and Figure 6.1: the drift of the cubic system from K repetitions of each step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.filters.learning.bayesian import Rows, posterior
from safe_envs.filters.learning.collection import collect, draw_states
from safe_envs.filters.learning.data import Transitions
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.scripts.figures.style import add_legend, labelled
from thesis.artefact import Claim, Number, Outcome, Sample, settings, texts
from thesis.chapter_6 import bayes
from thesis.chapter_6.bayes import SETTINGS

CUBIC = settings(6, "cubic")
_UNITS = {"f_1": "(x_1/s)^2", "f_2": "(x_2/s)^2"}
"""Each in those of its own state. The errors of f_1 and f_2 have nearly the same law: which is
larger in one identification is chance."""


@dataclass(frozen=True)
class DriftStudy:
    """Identifications of f with one K.

    Attributes:
        squares: mean squared errors at the states, (identifications, n).
        in_deviations: rms of the errors in standard deviations of the posterior.
        overconfident: the same, where the noise of the data is taken for sigma^2/K.
        first: estimates and standard deviations of the first identification, (B, n) each.
    """

    squares: np.ndarray
    in_deviations: np.ndarray
    overconfident: np.ndarray
    first: tuple[np.ndarray, np.ndarray]


def study(
    problem: SafetyProblem, x: np.ndarray, repetitions: int, seeds: range, starts: int, steps: int
) -> DriftStudy:
    """Identify f under u = 0, as the thesis does, and compare it with the truth at states (B, n).

    The data are trajectories from so many starts, with K repetitions of each of the steps.
    """
    truth = bayes.true_drift(problem, x)
    estimates, squares, in_deviations, overconfident = [], [], [], []
    for seed in seeds:
        data = collect(problem, starts, repetitions, bayes.AT_REST, steps=steps, seed=seed)
        learned = bayes.identified_from(problem, data, CUBIC.prior)
        mean, deviation = bayes.estimated_drift(learned, x)
        estimates.append((mean, deviation))
        squares.append(((mean - truth) ** 2).mean(axis=0))
        in_deviations.append(_rms((mean - truth) / deviation))
        mean, deviation = _printed_posterior(learned, data, x)
        overconfident.append(_rms((mean - truth) / deviation))
    found = map(np.array, (squares, in_deviations, overconfident))
    return DriftStudy(*found, first=estimates[0])


def _printed_posterior(
    learned: Posterior, data: Transitions, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and deviation by noise of the variance sigma^2/K, not sigma^2/(K dt)."""
    rows, phi = Rows.of(data), learned.features.matrix(x)
    variance = learned.diffusion.sigma**2 / data.repetitions
    found = posterior(learned.features.matrix(rows.x), rows.rate, variance, CUBIC.prior)
    deviation = np.sqrt(np.einsum("bk,nkl,bl->bn", phi, found.covariance, phi))
    return phi @ found.mean.T, deviation


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _studies(problem: SafetyProblem, x: np.ndarray, seeds: range) -> dict[int, DriftStudy]:
    size = SETTINGS.starts, SETTINGS.steps
    return {k: study(problem, x, k, seeds, *size) for k in SETTINGS.repetitions}


def compute_table(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 6.1."""
    problem, seeds = make_problem(CUBIC.env), bayes.seeds(sample, CUBIC.table_identifications)
    x = draw_states(problem, CUBIC.points, np.random.default_rng([sample.seed, 61]))
    found = _studies(problem, x, seeds)
    printed = texts()["table-6.1"].printed
    squares = {
        name: {k: each.squares[:, i] for k, each in found.items()} for i, name in enumerate(printed)
    }
    doubt = f"rms error in standard deviations of the posterior, K = {bayes.MOST}"
    most = found[bayes.MOST]
    return Outcome(
        numbers=[
            *(
                bayes.predicted(f"MSE of {name}, K = {k}", values, number, _UNITS[name])
                for name, by in squares.items()
                for (k, values), number in zip(by.items(), printed[name], strict=True)
            ),
            Number.mean(doubt, most.in_deviations, least=0.0),
        ],
        claims=[
            *(falls(name, by) for name, by in squares.items()),
            *(falls_as_printed(name, by, printed[name]) for name, by in squares.items()),
        ],
        printed_formula=[Number.mean(doubt, most.overconfident, least=0.0)],
    ), None


def compute_figure(sample: Sample) -> tuple[Outcome, Any]:
    """Compute Figure 6.1."""
    problem, seeds = make_problem(CUBIC.env), bayes.seeds(sample, CUBIC.figure_identifications)
    x = draw_states(problem, CUBIC.shown, np.random.default_rng([sample.seed, 62]))
    x = x[x[:, 0].argsort()]
    found = _studies(problem, x, seeds)
    errors = {k: np.sqrt(each.squares[:, 1]) for k, each in found.items()}
    doubt = "rms error in standard deviations of the posterior, all K"
    ours, printed = (
        Number.mean(doubt, np.concatenate(each), least=0.0)
        for each in zip(*[(s.in_deviations, s.overconfident) for s in found.values()], strict=True)
    )
    outcome = Outcome(
        numbers=[
            *(
                bayes.predicted(f"rms error of f_2, K = {k}", e, unit="1/s")
                for k, e in errors.items()
            ),
            ours,
        ],
        claims=[falls("f_2 = x_1^3", errors)],
        printed_formula=[printed],
    )
    return outcome, partial(_draw, x[:, 0], {k: each.first for k, each in found.items()})


def falls(name: str, errors: Mapping[int, np.ndarray]) -> Claim:
    """Return the claim that the error falls from each K to the next on average.

    The errors by K are of the same identifications each, shape (identifications,).
    """
    sure, evidence = [], []
    for a, b in pairwise(errors):
        ratio = Number.mean("", np.log(errors[a] / errors[b]))
        sure.append(ratio.is_above())
        fold, low, high = np.exp([ratio.ours, *ratio.ends])
        evidence.append(f"{fold:.2g}-fold [{low:.2g}, {high:.2g}] on average from K = {a} to {b}")
    sentence = f"The error of {name} falls as the repetitions K grow."
    return Claim(sentence, all(sure), ", ".join(evidence))


def falls_as_printed(
    name: str, squares: Mapping[int, np.ndarray], printed: Sequence[float]
) -> Claim:
    """Return the claim that a new identification for each K can have errors in the printed ratios.

    The squared errors by K are of the same identifications each, shape (identifications,).
    """
    possible, evidence = [], []
    by = dict(zip(squares, printed, strict=True))
    for a, b in combinations(squares, 2):
        ratios = np.log(squares[a] / squares[b])
        low, high = map(math.exp, bayes.one_more(ratios))
        possible.append(low <= by[a] / by[b] <= high)
        evidence.append(
            f"from K = {a} to {b} {by[a] / by[b]:.3g}-fold in the thesis, [{low:.2g}, {high:.2g}]"
            f" here, {b / a:.3g}-fold by the law"
        )
    first, last = min(by), max(by)
    return Claim(
        f"The MSE of {name} falls {by[first] / by[last]:.0f}-fold from K = {first} to {last}, in"
        " the printed steps.",
        all(possible),
        "; ".join(evidence),
    )


def _draw(
    x_1: np.ndarray, found: Mapping[int, tuple[np.ndarray, np.ndarray]], figure: Figure
) -> None:
    line, panels = np.linspace(-1.0, 1.0, 201), figure.subplots(1, len(found), sharey=True)
    for letter, axes, (k, (mean, deviation)) in zip("abc", panels, found.items(), strict=True):
        bayes.draw_estimate(axes, (line, line**3), x_1, mean[:, 1], deviation[:, 1])
        axes.set(xlabel="$x_1$", title=f"({letter}) $K$ = {k}")
    panels[0].set_ylabel(labelled("$f_2$", "1/s"))
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


ARTEFACTS = {"figure-6.1": compute_figure, "table-6.1": compute_table}
