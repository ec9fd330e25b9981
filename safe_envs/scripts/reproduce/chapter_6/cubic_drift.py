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
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS, add_legend
from safe_envs.scripts.reproduce.chapter_6 import identifications as bayes
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import is_above
from safe_envs.wrappers.learning.data.collection import collect, draw_states
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.models.posterior import Posterior
from safe_envs.wrappers.learning.regression import Rows, posterior

_SETTINGS = bayes.CHAPTER.settings["cubic"]
ENV, PRIOR, POINTS, SHOWN = (_SETTINGS[name] for name in ("env", "prior", "points", "shown"))
_note = partial(bayes.CHAPTER.note, "table-6.1")
_claim = partial(bayes.CHAPTER.claim, "table-6.1")
_IDENTIFICATIONS, _PICTURED = 40, 20  # for Table 6.1 and for Fig. 6.1
_PRINTED_MSE = bayes.CHAPTER.printed("table-6.1")
_UNITS = {"f_1": "(x_1/s)^2", "f_2": "(x_2/s)^2"}
"""Each in those of its own state. The errors of f_1 and f_2 have nearly the same law: which is
larger in one identification is chance."""


@dataclass(frozen=True)
class DriftStudy:
    """Identifications of f with one K.

    Attributes:
        squares: mean squared errors at the states, (identifications, n).
        errors_in_deviations: root mean squares of the errors in standard deviations of the
            posterior.
        overconfident: the same, where the noise of the data is taken for sigma^2/K.
        first: estimates and standard deviations of the first identification, (B, n) each.
    """

    squares: np.ndarray
    errors_in_deviations: np.ndarray
    overconfident: np.ndarray
    first: tuple[np.ndarray, np.ndarray]


def study(
    problem: SafetyProblem, x: np.ndarray, repetitions: int, chosen: range, starts: int, steps: int
) -> DriftStudy:
    """Identify f under u = 0, as the thesis does, and compare it with the truth at states.

    Args:
        problem: that is identified.
        x: states, shape (B, n).
        repetitions: K of each step.
        chosen: seeds of the identifications.
        starts: trajectories of the data.
        steps: states of each.

    Returns:
        The errors of the identifications.
    """
    truth = bayes.true_drift(problem, x)
    estimates, squares, in_deviations, overconfident = [], [], [], []
    for seed in chosen:
        data = collect(problem, starts, repetitions, bayes.AT_REST, steps=steps, seed=seed)
        learned = bayes.identified_from(problem, data, PRIOR)
        mean, deviation = bayes.estimated_drift(learned, x)
        estimates.append((mean, deviation))
        squares.append(((mean - truth) ** 2).mean(axis=0))
        in_deviations.append(float(np.sqrt((((mean - truth) / deviation) ** 2).mean())))
        overconfident.append(_printed_doubt(learned, data, x, truth))
    found = map(np.array, (squares, in_deviations, overconfident))
    return DriftStudy(*found, first=estimates[0])


def _printed_doubt(
    learned: Posterior, data: Transitions, x: np.ndarray, truth: np.ndarray
) -> float:
    """Return the rms error in standard deviations of the printed posterior.

    Its noise has the variance sigma^2/K instead of sigma^2/(K dt).
    """
    rows = Rows.of(data)
    variance = learned.diffusion.sigma**2 / data.repetitions
    found = posterior(learned.features.matrix(rows.x), rows.rate, variance, PRIOR)
    phi = learned.features.matrix(x)
    deviation = np.sqrt(np.einsum("bk,nkl,bl->bn", phi, found.covariance, phi))
    return float(np.sqrt((((phi @ found.mean.T - truth) / deviation) ** 2).mean()))


def falls(name: str, squares: Mapping[int, np.ndarray]) -> Claim:
    """Return the claim that the error falls from each K to the next on average.

    Args:
        name: of what.
        squares: errors by K, of the same identifications each, (identifications,).
    """
    sure, evidence = [], []
    for a, b in pairwise(squares):
        ratio = Number.mean("", np.log(squares[a] / squares[b]))
        sure.append(is_above(ratio))
        low, fold, high = np.exp([ratio.low or 0.0, ratio.ours, ratio.high or 0.0])
        evidence.append(f"{fold:.2g}-fold [{low:.2g}, {high:.2g}] on average from K = {a} to {b}")
    return _claim("falls", all(sure), what=name, each=", ".join(evidence))


def falls_as_printed(
    name: str, squares: Mapping[int, np.ndarray], printed: Sequence[float]
) -> Claim:
    """Return the claim that a new identification for each K can have errors in the printed ratios.

    Args:
        name: of what.
        squares: errors by K, of the same identifications each, (identifications,).
        printed: errors, one for each K.
    """
    possible, evidence = [], []
    by = dict(zip(squares, printed, strict=True))
    for a, b in combinations(squares, 2):
        ratios = np.log(squares[a] / squares[b])
        low, high = map(math.exp, bayes.one_more(ratios))
        possible.append(low <= by[a] / by[b] <= high)
        folds = {"printed": by[a] / by[b], "ours": math.exp(ratios.mean()), "law": b / a}
        evidence.append(_note("fold", a=a, b=b, low=low, high=high, **folds))
    ends = {"fold": by[min(by)] / by[max(by)], "first": min(by), "last": max(by)}
    return _claim("as_printed", all(possible), what=name, each="; ".join(evidence), **ends)


def compute_errors(sample: Workload) -> Findings:
    """Compute Table 6.1."""
    problem = make_problem(ENV)
    x = draw_states(problem, POINTS, np.random.default_rng([sample.seed, 61]))
    chosen = bayes.seeds(sample, _IDENTIFICATIONS)
    found = {k: study(problem, x, k, chosen, bayes.STARTS, bayes.STEPS) for k in bayes.REPETITIONS}
    squares = {
        name: {k: each.squares[:, i] for k, each in found.items()}
        for i, name in enumerate(_PRINTED_MSE)
    }
    numbers = [
        bayes.predicted(f"MSE of {name}, K = {k}", values, printed, _UNITS[name])
        for name, by in squares.items()
        for (k, values), printed in zip(by.items(), _PRINTED_MSE[name], strict=True)
    ]
    many = found[bayes.REPETITIONS[-1]]
    doubt = f"rms error in standard deviations of the posterior, K = {bayes.REPETITIONS[-1]}"
    widths = [n.high / n.low for n in numbers if n.low and n.high]
    return Findings(
        numbers=[*numbers, Number.mean(doubt, many.errors_in_deviations, least=0.0)],
        claims=[
            *(falls(name, by) for name, by in squares.items()),
            *(falls_as_printed(name, by, _PRINTED_MSE[name]) for name, by in squares.items()),
        ],
        printed_formula=[Number.mean(doubt, many.overconfident, least=0.0)],
        notes=[
            _note("span", least=min(widths), largest=max(widths)),
            _compared_with_law(problem, x, chosen, found[bayes.REPETITIONS[0]]),
        ],
    )


def _compared_with_law(
    problem: SafetyProblem, x: np.ndarray, chosen: range, followed: DriftStudy
) -> str:
    """Return how the errors with the smallest K compare with M sigma^2/(K R dt), in words.

    They are from states all over the disk and from as many on trajectories.
    """
    spread_out = study(problem, x, bayes.REPETITIONS[0], chosen, bayes.STARTS * bayes.STEPS, 1)
    sigma = problem.plant.parameter_values["sigma_1"]
    time = bayes.REPETITIONS[0] * bayes.STARTS * bayes.STEPS * problem.dt
    law = Features.of(problem, bayes.DEGREE).count * sigma**2 / time
    ratio = Number.mean("ratio", spread_out.squares.mean(axis=1) / law, least=0.0)
    counts = {"data": bayes.STARTS * bayes.STEPS, "count": len(chosen)}
    share = followed.squares.mean() / law
    return _note("law", ratio=ratio, law=law, followed=share, **counts)


def compute_figure(sample: Workload) -> Findings:
    """Compute Figure 6.1."""
    problem = make_problem(ENV)
    x = draw_states(problem, SHOWN, np.random.default_rng([sample.seed, 62]))
    x = x[x[:, 0].argsort()]
    chosen = bayes.seeds(sample, _PICTURED)
    found = {k: study(problem, x, k, chosen, bayes.STARTS, bayes.STEPS) for k in bayes.REPETITIONS}
    numbers = [
        bayes.predicted(f"rms error of f_2, K = {k}", np.sqrt(s.squares[:, 1]), unit="1/s")
        for k, s in found.items()
    ]
    covered = Number.mean(
        "rms error in standard deviations of the posterior, all K",
        np.concatenate([s.errors_in_deviations for s in found.values()]),
        least=0.0,
    )
    printed = Number.mean(
        covered.name, np.concatenate([s.overconfident for s in found.values()]), least=0.0
    )
    return Findings(
        numbers=[*numbers, covered],
        claims=[falls("f_2 = x_1^3", {k: np.sqrt(s.squares[:, 1]) for k, s in found.items()})],
        printed_formula=[printed],
        data={
            "x_1": x[:, 0].tolist(),
            "truth": bayes.true_drift(problem, x)[:, 1].tolist(),
            **{f"estimate {k}": s.first[0][:, 1].tolist() for k, s in found.items()},
            **{f"deviation {k}": s.first[1][:, 1].tolist() for k, s in found.items()},
        },
        notes=[
            "The figure is of the first identification; the rms errors are geometric means over"
            " identifications."
        ],
    )


def _draw_drift(figure: Figure, outcome: Findings) -> None:
    data, line = outcome.data, np.linspace(-1.0, 1.0, 201)
    panels = figure.subplots(1, len(bayes.REPETITIONS), sharey=True)
    for letter, axes, k in zip("abc", panels, bayes.REPETITIONS, strict=True):
        estimate = data[f"estimate {k}"], data[f"deviation {k}"]
        bayes.draw_estimate(axes, (line, line**3), data["x_1"], *estimate, COLORS[0])
        axes.set(xlabel="$x_1$", title=f"({letter}) $K$ = {k}")
    panels[0].set_ylabel(labelled("$f_2$", "1/s"))
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


def _values(states: int, full: int, sample: Workload) -> dict[str, Any]:
    return {"states": states, "identifications": len(bayes.seeds(sample, full))}


ARTEFACTS = (
    bayes.CHAPTER.artefact(
        "figure-6.1", compute_figure, partial(_values, SHOWN, _PICTURED), _draw_drift
    ),
    bayes.CHAPTER.artefact("table-6.1", compute_errors, partial(_values, POINTS, _IDENTIFICATIONS)),
)
