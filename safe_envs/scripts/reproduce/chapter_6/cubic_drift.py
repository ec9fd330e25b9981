"""Chapter 6, the drift of the cubic system, identified from K repetitions of each step, beside the
true one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.statistics import repeated_interval
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS, add_legend
from safe_envs.scripts.reproduce.chapter_6.identifications import (
    AT_REST,
    CONFIDENCE,
    DEGREE,
    FIT_ERRATA,
    ONE_MORE,
    REPETITIONS,
    STARTS,
    STEPS,
    draw_estimate,
    estimated_drift,
    identified_from,
    noise_level,
    one_more,
    predicted,
    seeds,
    true_drift,
)
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.wrappers.learning.data.collection import collect, draw_states
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.models.posterior import Posterior
from safe_envs.wrappers.learning.regression import Rows, posterior

ENV = "safe_envs/CubicSDEDisk-v0"
PRIOR = 10.0
DATA = f"{STARTS} trajectories of {STEPS} states in steps of .01 s, cubic features, prior 10 I"
_IDENTIFICATIONS, _PICTURED = 40, 20
"""For Table 6.1 and for Fig. 6.1."""

POINTS, SHOWN = 100, 30
"""States at which f is compared, in Table 6.1 and in Fig. 6.1."""

_BANDS = f"{ONE_MORE}; those 'in standard deviations' are Student's for the mean"
_PRINTED_MSE = {"f_1": (1e-2, 2e-3, 6e-4), "f_2": (5e-2, 8e-3, 6e-4)}
_UNITS = {"f_1": "(x_1/s)^2", "f_2": "(x_2/s)^2"}
"""Each in those of its own state. The errors of f_1 and f_2 have nearly the same law: which is
larger in one identification is chance."""


@dataclass(frozen=True)
class Study:
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
) -> Study:
    """Identify f under u = 0, as the print does, and hold it against the truth at states."""
    truth, squares, errors_in_deviations, overconfident, first = (
        true_drift(problem, x),
        [],
        [],
        [],
        None,
    )
    for seed in chosen:
        data = collect(problem, starts, repetitions, AT_REST, steps=steps, seed=seed)
        learned = identified_from(problem, data, PRIOR)
        mean, deviation = estimated_drift(learned, x)
        first = first or (mean, deviation)
        squares.append(((mean - truth) ** 2).mean(axis=0))
        errors_in_deviations.append(float(np.sqrt((((mean - truth) / deviation) ** 2).mean())))
        overconfident.append(_printed_doubt(learned, data, x, truth))
    assert first is not None
    return Study(np.array(squares), np.array(errors_in_deviations), np.array(overconfident), first)


def _printed_doubt(
    learned: Posterior, data: Transitions, x: np.ndarray, truth: np.ndarray
) -> float:
    """By the printed posterior, whose noise has the variance sigma^2/K instead of sigma^2/(K dt)."""
    rows = Rows.of(data)
    variance = learned.diffusion.sigma**2 / data.repetitions
    found = posterior(learned.features.matrix(rows.x), rows.rate, variance, PRIOR)
    phi = learned.features.matrix(x)
    deviation = np.sqrt(np.einsum("bk,nkl,bl->bn", phi, found.covariance, phi))
    return float(np.sqrt((((phi @ found.mean.T - truth) / deviation) ** 2).mean()))


def falls(name: str, squares: Mapping[int, np.ndarray]) -> Claim:
    """That the error falls from each K to the next, on average over identifications.

    Args:
        name: of what.
        squares: errors by K, of the same identifications each, (identifications,).
    """
    sure, evidence = [], []
    for a, b in pairwise(squares):
        ratios = np.log(squares[a] / squares[b])
        mean = float(ratios.mean())
        low, high = repeated_interval(
            ratios.tolist(), (mean, mean), CONFIDENCE, (-math.inf, math.inf)
        )
        sure.append(low > 0.0)
        evidence.append(
            f"{math.exp(mean):.2g}-fold [{math.exp(low):.2g}, {math.exp(high):.2g}] on average from"
            f" K = {a} to {b}"
        )
    return Claim(
        f"The error of {name} falls as the repetitions K grow.", all(sure), ", ".join(evidence)
    )


def falls_as_printed(
    name: str, squares: Mapping[int, np.ndarray], printed: Sequence[float]
) -> Claim:
    """That a new identification for each K can have errors in the printed ratios.

    Args:
        name: of what.
        squares: errors by K, of the same identifications each, (identifications,).
        printed: errors, one for each K.
    """
    possible, evidence, by = [], [], dict(zip(squares, printed, strict=True))
    for a, b in combinations(squares, 2):
        ratios = np.log(squares[a] / squares[b])
        low, high = map(math.exp, one_more(ratios))
        possible.append(low <= by[a] / by[b] <= high)
        evidence.append(
            f"from K = {a} to {b} {by[a] / by[b]:.3g}-fold in print,"
            f" {math.exp(ratios.mean()):.3g}-fold [{low:.2g}, {high:.2g}] here, {b / a:.3g}-fold by"
            " the law"
        )
    fold, first, last = by[min(by)] / by[max(by)], min(by), max(by)
    return Claim(
        f"The MSE of {name} falls {fold:.0f}-fold from K = {first} to {last}, in the printed"
        " steps.",
        all(possible),
        "; ".join(evidence),
    )


def _drift_errors(sample: Sample) -> Outcome:
    problem = make_problem(ENV)
    x = draw_states(problem, POINTS, np.random.default_rng([sample.seed, 61]))
    chosen = seeds(sample, _IDENTIFICATIONS)
    found = {k: study(problem, x, k, chosen, STARTS, STEPS) for k in REPETITIONS}
    squares = {
        name: {k: each.squares[:, i] for k, each in found.items()}
        for i, name in enumerate(_PRINTED_MSE)
    }
    numbers = [
        predicted(f"MSE of {name}, K = {k}", values, printed, _UNITS[name])
        for name, by in squares.items()
        for (k, values), printed in zip(by.items(), _PRINTED_MSE[name], strict=True)
    ]
    many, doubt = (
        found[REPETITIONS[-1]],
        f"rms error in standard deviations of the posterior, K = {REPETITIONS[-1]}",
    )
    widths = [n.high / n.low for n in numbers if n.low and n.high]
    return Outcome(
        numbers=[*numbers, Number.mean(doubt, many.errors_in_deviations, least=0.0)],
        claims=[
            *(falls(name, by) for name, by in squares.items()),
            *(falls_as_printed(name, by, _PRINTED_MSE[name]) for name, by in squares.items()),
        ],
        as_printed=[Number.mean(doubt, many.overconfident, least=0.0)],
        notes=[
            (
                "The errors of single identifications differ so much that the intervals span"
                f" {min(widths):.0f} to {max(widths):.0f}-fold: a printed number of one"
                " identification tells little."
            ),
            _beside_the_law(problem, x, chosen, found[REPETITIONS[0]]),
        ],
    )


def _beside_the_law(problem: SafetyProblem, x: np.ndarray, chosen: range, followed: Study) -> str:
    """The smallest K, from states all over the disk and from as many on trajectories, beside M
    sigma^2/(K R dt)."""
    spread_out = study(problem, x, REPETITIONS[0], chosen, STARTS * STEPS, 1)
    sigma = noise_level(problem, "sigma_1")
    law = (
        Features.of(problem, DEGREE).count
        * sigma**2
        / (REPETITIONS[0] * STARTS * STEPS * problem.dt)
    )
    ratio = Number.mean("ratio", spread_out.squares.mean(axis=1) / law, least=0.0)
    return (
        f"From {STARTS * STEPS} states drawn over the disk the MSE at K = {REPETITIONS[0]} is"
        f" {ratio.ours:.2f} [{ratio.low:.2f}, {ratio.high:.2f}] times M sigma^2/(K R dt) ="
        f" {law:.2g} (mean of {len(chosen)} identifications); from as many on {STARTS}"
        f" trajectories, which do not see all of the disk, {followed.squares.mean() / law:.1f}"
        " times that."
    )


def _drift_picture(sample: Sample) -> Outcome:
    problem = make_problem(ENV)
    x = draw_states(problem, SHOWN, np.random.default_rng([sample.seed, 62]))
    x = x[x[:, 0].argsort()]
    chosen = seeds(sample, _PICTURED)
    found = {k: study(problem, x, k, chosen, STARTS, STEPS) for k in REPETITIONS}
    numbers = [
        predicted(f"rms error of f_2, K = {k}", np.sqrt(s.squares[:, 1]), unit="1/s")
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
    return Outcome(
        numbers=[*numbers, covered],
        claims=[falls("f_2 = x_1^3", {k: np.sqrt(s.squares[:, 1]) for k, s in found.items()})],
        as_printed=[printed],
        data={
            "x_1": x[:, 0].tolist(),
            "truth": true_drift(problem, x)[:, 1].tolist(),
            **{f"estimate {k}": s.first[0][:, 1].tolist() for k, s in found.items()},
            **{f"deviation {k}": s.first[1][:, 1].tolist() for k, s in found.items()},
        },
        notes=[
            "The picture is of the first identification; the rms errors are geometric means over"
            " identifications."
        ],
    )


def _draw_drift(figure: Figure, outcome: Outcome) -> None:
    data, line = outcome.data, np.linspace(-1.0, 1.0, 201)
    panels = figure.subplots(1, len(REPETITIONS), sharey=True)
    for letter, axes, k in zip("abc", panels, REPETITIONS, strict=True):
        draw_estimate(
            axes,
            (line, line**3),
            data["x_1"],
            data[f"estimate {k}"],
            data[f"deviation {k}"],
            COLORS[0],
        )
        axes.set(xlabel="$x_1$", title=f"({letter}) K = {k}")
    panels[0].set_ylabel("$f_2$ (1/s)")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


def _setting(sample: Sample, states: int, full: int) -> tuple[str, ...]:
    return (
        f"{ENV}, sigma = .2 and .2, {DATA}, input 0",
        f"{states} states of the disk, {len(seeds(sample, full))} identifications; {_BANDS}",
    )


FIGURE = Artefact(
    name="figure-6.1",
    title="Estimate of f_2 from K repetitions of each step",
    compute=_drift_picture,
    setting=lambda sample: _setting(sample, SHOWN, _PICTURED),
    chosen=("steps of a trajectory 100",),
    corrections=FIT_ERRATA,
    draw=_draw_drift,
    size=(7.0, 3.2),
)

TABLE = Artefact(
    name="table-6.1",
    title="Errors of the identified drift",
    compute=_drift_errors,
    setting=lambda sample: _setting(sample, POINTS, _IDENTIFICATIONS),
    chosen=("steps of a trajectory 100", "e^-2 in print is read as 1e-2, and so on"),
    corrections=FIT_ERRATA,
)
