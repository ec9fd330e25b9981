"""Chapter 6, the drift of the cubic system, identified from K repetitions of each step, beside the true one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from agents.problems import load_problem
from safe_envs.problem import SafetyProblem
from scripts.figure import COLORS, add_legend
from scripts.reproduce.artefact import Artefact, Claim, Outcome, Sample
from scripts.reproduce.identifications import (
    AT_REST,
    DEGREE,
    FIT_ERRATA,
    REPETITIONS,
    STARTS,
    STEPS,
    averaged,
    draw_estimate,
    estimated_drift,
    identified,
    noise_level,
    seeds,
    spread,
    true_drift,
)
from wrappers.learning.collect import collect, draw_states
from wrappers.learning.features import Features
from wrappers.learning.posterior import Posterior
from wrappers.learning.regression import Rows, posterior
from wrappers.learning.transitions import Transitions

ENV = "safe_envs/CubicSDEDisk-v0"
PRIOR = 10.0
DATA = f"{STARTS} trajectories of {STEPS} states in steps of .01 s, cubic features, prior 10 I"
_IDENTIFICATIONS = 40
_POINTS, _SHOWN = 100, 30
"""States at which f is compared, in Table 6.1 and in Fig. 6.1."""

_BANDS = "an interval holds 95 % of the identifications, since a printed number is of one; those 'in standard deviations' are Student's"
_PRINTED_MSE = {"f_1": (1e-2, 2e-3, 6e-4), "f_2": (5e-2, 8e-3, 6e-4)}


@dataclass(frozen=True)
class Study:
    """Identifications of f with one K.

    Attributes:
        squares: mean squared errors at the states, (identifications, n).
        doubts: root mean squares of the errors in standard deviations of the posterior.
        overconfident: the same, where the noise of the data is taken for sigma^2/K.
        first: estimates and standard deviations of the first identification, (B, n) each.
    """

    squares: np.ndarray
    doubts: np.ndarray
    overconfident: np.ndarray
    first: tuple[np.ndarray, np.ndarray]


def study(problem: SafetyProblem, x: np.ndarray, repetitions: int, chosen: range, starts: int, steps: int) -> Study:
    """Identify f under u = 0, as the print does, and hold it against the truth at states."""
    truth, squares, doubts, overconfident, first = true_drift(problem, x), [], [], [], None
    for seed in chosen:
        learned = identified(problem, repetitions, seed, PRIOR, starts=starts, steps=steps, inputs=AT_REST)
        mean, deviation = estimated_drift(learned, x)
        first = first or (mean, deviation)
        squares.append(((mean - truth) ** 2).mean(axis=0))
        doubts.append(float(np.sqrt((((mean - truth) / deviation) ** 2).mean())))
        overconfident.append(
            _printed_doubt(problem, learned, collect(problem, starts, repetitions, AT_REST, steps=steps, seed=seed), x, truth)
        )
    assert first is not None
    return Study(np.array(squares), np.array(doubts), np.array(overconfident), first)


def _printed_doubt(problem: SafetyProblem, learned: Posterior, data: Transitions, x: np.ndarray, truth: np.ndarray) -> float:
    """By the printed posterior, whose noise has the variance sigma^2/K instead of sigma^2/(K dt)."""
    rows = Rows.of(data)
    variance = learned.diffusion.sigma**2 / data.repetitions
    found = posterior(learned.features.matrix(rows.x), rows.rate, variance, PRIOR)
    phi = learned.features.matrix(x)
    deviation = np.sqrt(np.einsum("bk,nkl,bl->bn", phi, found.covariance, phi))
    return float(np.sqrt((((phi @ found.mean.T - truth) / deviation) ** 2).mean()))


def _drift_errors(sample: Sample) -> Outcome:
    problem = load_problem(ENV)
    x = draw_states(problem, _POINTS, np.random.default_rng([sample.seed, 61]))
    chosen, steps = seeds(sample, _IDENTIFICATIONS), STEPS
    found = {k: study(problem, x, k, chosen, STARTS, steps) for k in REPETITIONS}
    spread_out = study(problem, x, REPETITIONS[0], chosen, STARTS * steps, 1)
    numbers = [
        spread(f"MSE of {name}, K = {k}", found[k].squares[:, i], _PRINTED_MSE[name][j])
        for i, name in enumerate(_PRINTED_MSE)
        for j, k in enumerate(REPETITIONS)
    ]
    many = found[REPETITIONS[-1]]
    doubt = "rms error in standard deviations of the posterior, K = 100"
    slopes = [np.polyfit(np.log(REPETITIONS), [np.log(found[k].squares[:, i]).mean() for k in REPETITIONS], 1)[0] for i in (0, 1)]
    count = spread_out.squares.shape[0]
    sigma = noise_level(problem, "sigma_1")
    law = Features.of(problem, DEGREE).count * sigma**2 / (REPETITIONS[0] * STARTS * steps * problem.dt)
    ratio = averaged("ratio", spread_out.squares.mean(axis=1) / law)
    ratios = {name: found[REPETITIONS[0]].squares[:, i][:, None] / many.squares[:, i] for i, name in enumerate(_PRINTED_MSE)}
    beyond = {name: _PRINTED_MSE[name][0] / _PRINTED_MSE[name][2] for name in _PRINTED_MSE}
    falls = all(a.squares.mean(axis=0)[i] > b.squares.mean(axis=0)[i] for a, b in pairwise(list(found.values())) for i in (0, 1))
    return Outcome(
        numbers=[*numbers, averaged(doubt, many.doubts)],
        claims=[
            Claim(
                "The error of f falls as the repetitions K grow.",
                falls,
                f"log-log slope of the MSE over K: {slopes[0]:.2f} for f_1, {slopes[1]:.2f} for f_2; -1 by the law",
            )
        ],
        as_printed=[averaged(doubt, many.overconfident)],
        notes=[
            f"From {STARTS * steps} states drawn over the disk the MSE at K = {REPETITIONS[0]} is {ratio.ours:.2f} [{ratio.low:.2f}, "
            f"{ratio.high:.2f}] times M sigma^2/(K R dt) = {law:.2g} ({count} identifications); from as many on ten trajectories "
            f"{found[REPETITIONS[0]].squares.mean() / law:.1f} times that, since they leave most of the disk unseen.",
            *(
                f"The printed MSE of {name} falls {beyond[name]:.0f}-fold from K = 10 to 100, tenfold by the law; that much is in "
                f"{100 * np.mean(ratios[name] >= beyond[name]):.1f} % of all pairs of ours."
                for name in _PRINTED_MSE
            ),
        ],
    )


def _drift_picture(sample: Sample) -> Outcome:
    problem = load_problem(ENV)
    x = draw_states(problem, _SHOWN, np.random.default_rng([sample.seed, 62]))
    x = x[x[:, 0].argsort()]
    chosen = seeds(sample, _IDENTIFICATIONS // 2)
    found = {k: study(problem, x, k, chosen, STARTS, STEPS) for k in REPETITIONS}
    numbers = [spread(f"rms error of f_2, K = {k}", np.sqrt(s.squares[:, 1]), unit="1/s") for k, s in found.items()]
    covered = averaged("rms error in standard deviations of the posterior, all K", np.concatenate([s.doubts for s in found.values()]))
    printed = averaged(covered.name, np.concatenate([s.overconfident for s in found.values()]))
    return Outcome(
        numbers=[*numbers, covered],
        claims=[
            Claim(
                "The estimate of f_2 comes nearer to x_1^3 as K grows.",
                all(a.ours > b.ours for a, b in pairwise(numbers)),
                ", ".join(f"rms {n.ours:.2g} [{n.low:.2g}, {n.high:.2g}] at K = {k}" for n, k in zip(numbers, REPETITIONS, strict=True)),
            )
        ],
        as_printed=[printed],
        data={
            "x_1": x[:, 0].tolist(),
            "truth": true_drift(problem, x)[:, 1].tolist(),
            **{f"estimate {k}": s.first[0][:, 1].tolist() for k, s in found.items()},
            **{f"deviation {k}": s.first[1][:, 1].tolist() for k, s in found.items()},
        },
        notes=["The picture is of the first identification; the numbers are medians over identifications and hold 95 % of them."],
    )


def _draw_drift(figure: Figure, outcome: Outcome) -> None:
    data, line = outcome.data, np.linspace(-1.0, 1.0, 201)
    panels = figure.subplots(1, len(REPETITIONS), sharey=True)
    for letter, axes, k in zip("abc", panels, REPETITIONS, strict=True):
        draw_estimate(axes, (line, line**3), data["x_1"], data[f"estimate {k}"], data[f"deviation {k}"], COLORS[0])
        axes.set(xlabel="$x_1$", title=f"({letter}) K = {k}")
    panels[0].set_ylabel("$f_2$ (1/s)")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


FIGURE = Artefact(
    name="figure-6.1",
    title="Estimate of f_2 from K repetitions of each step",
    compute=_drift_picture,
    setting=(
        f"{ENV}, sigma = .2 and .2, {DATA}, input 0",
        f"{_SHOWN} states of the disk, {_IDENTIFICATIONS // 2} identifications; {_BANDS}",
    ),
    chosen=("steps of a trajectory 100",),
    corrections=FIT_ERRATA,
    draw=_draw_drift,
    size=(7.0, 3.2),
)

TABLE = Artefact(
    name="table-6.1",
    title="Errors of the identified drift",
    compute=_drift_errors,
    setting=(f"{ENV}, {DATA}, input 0", f"{_POINTS} states of the disk, {_IDENTIFICATIONS} identifications; {_BANDS}"),
    chosen=("steps of a trajectory 100", "e^-2 in print is read as 1e-2, and so on"),
    corrections=FIT_ERRATA,
    orderings=tuple((f"MSE of {name}, K = {a}", f"MSE of {name}, K = {b}") for name in _PRINTED_MSE for a, b in pairwise(REPETITIONS)),
)
