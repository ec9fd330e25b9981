"""Figures 5.1 and 5.2: the learned noise part of the generator of a barrier, and its errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient, ito_correction
from safe_envs.scripts.figures.labels import labelled, quantity
from safe_envs.scripts.figures.style import COLORS, QUIET, add_legend
from safe_envs.scripts.reproduce.chapter_5.noise_identification import (
    REPETITIONS,
    VALIDATION,
    NoiseIdentification,
    models,
    repeated,
)
from safe_envs.scripts.reproduce.chapter_5.paired_rates import CHAPTER
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import is_below
from safe_envs.wrappers.learning.data.collection import draw_states
from safe_envs.wrappers.learning.generator import GeneratorModel

_CLOSE = 0.1  # largest rms error of a learned term, as part of the term: a limit of ours

_LABELS = "rms error of the training data"
_NETWORK = "rms error of the network"


@dataclass(frozen=True)
class _Errors:
    """The networks of several identifications and the true term, each at P states of its own.

    Attributes:
        truth: shape (K, P).
        estimates: the same.
    """

    truth: np.ndarray
    estimates: np.ndarray

    @property
    def each(self) -> list[float]:
        """Return the rms error of each network, in 1/s."""
        return [_rms(row) for row in self.estimates - self.truth]

    @property
    def number(self) -> Number:
        """Return their mean over networks.

        The states at which one network is evaluated are not independent: only networks are.
        """
        return Number.mean(_NETWORK, self.each, "1/s", least=0.0)


def learning_outcome(
    env_id: str,
    noise: float,
    state: int,
    said: str,
    formula: Callable[[Any], Any],
    sample: Workload,
) -> Findings:
    """Return how near the learned term is to the true one, which depends on one state alone.

    Args:
        env_id: of the system.
        noise: its level.
        state: on which the term depends.
        said: the printed term, in words.
        formula: the same as a function of the state.
        sample: how much is simulated.
    """
    problem, learned = make_problem(env_id, noise=noise), repeated(env_id, noise, sample)
    first = learned[0]
    x = [draw_states(problem, VALIDATION, np.random.default_rng(each.seed)) for each in learned]
    repaired, printed = (
        _errors(problem, models(learned, name), x) for name in ("martingale", "printed")
    )
    expression = problem.plant.numeric(
        ito_correction(problem.plant, problem.barriers[0].expression)
    )
    term = compile_function((problem.plant.states[state],), (expression,), "arrays")
    missed = {name: values - term(first.x[:, state])[0] for name, values in first.labels.items()}
    grid = np.linspace(*problem.sampling_domain.region[state], 200)
    shown = problem.states[state]
    return Findings(
        numbers=[
            root_mean_square("rms of the analytic term", repaired.truth.ravel()),
            repaired.number,
            root_mean_square(_LABELS, missed["martingale"]),
            root_mean_square(f"{_LABELS}, centred only", missed["centred"]),
        ],
        claims=[
            as_derived(said, term(grid)[0], formula(grid)),
            learnable(repaired.each, repaired.truth),
            near(repaired.each, repaired.truth),
        ],
        printed_formula=[printed.number, root_mean_square(_LABELS, missed["printed"])],
        data={
            "state": quantity(shown.symbol.name, shown.unit),
            "grid": grid.tolist(),
            "term": term(grid)[0].tolist(),
            "points": first.x[:, state].tolist(),
            "validation": x[0][:, state].tolist(),
            **{
                name: {
                    "labels": first.labels[estimator].tolist(),
                    "network": errors.estimates[0].tolist(),
                }
                for name, estimator, errors in (
                    ("repaired", "martingale", repaired),
                    ("printed", "printed", printed),
                )
            },
        },
        notes=_why_printed_fails(problem, first, missed["printed"], sample.work(REPETITIONS)),
    )


def _errors(
    problem: SafetyProblem, learned: Sequence[GeneratorModel], x: Sequence[np.ndarray]
) -> _Errors:
    pairs = [
        next(iter(model.compare(problem, states).values()))
        for model, states in zip(learned, x, strict=True)
    ]
    return _Errors(*(np.array(part) for part in zip(*pairs, strict=True)))


def as_derived(said: str, term: np.ndarray, printed: np.ndarray) -> Claim:
    """Return the claim that the printed term follows from the system and h.

    Args:
        said: the term, in words.
        term: derived, at some states.
        printed: by the printed formula, there.
    """
    largest = float(np.abs(term - printed).max())
    holds = np.allclose(printed, term, rtol=1e-9, atol=1e-15)
    return CHAPTER.claim("figure-5.1", "derived", holds, said=said, largest=largest)


def learnable(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Return the claim that networks are nearer to the term than the best constant.

    Then they learned something of its shape.

    Args:
        errors: rms error of each, in 1/s.
        truth: the term at the validation states.
    """
    constant = float(np.std(truth))
    found = Number.mean("", errors, least=0.0)
    values = {"error": found, "constant": constant}
    return CHAPTER.claim("figure-5.1", "learnable", is_below(found, constant), **values)


def near(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Return the claim that networks are near to the term, by a limit of ours.

    Args:
        errors: rms error of each, in 1/s.
        truth: the term at the validation states.
    """
    share = float(np.mean(errors)) / _rms(truth)
    return CHAPTER.claim("figure-5.1", "near", share < _CLOSE, limit=_CLOSE, share=share)


def _why_printed_fails(
    problem: SafetyProblem, first: NoiseIdentification, missed: np.ndarray, repetitions: int
) -> list[str]:
    """Return the printed estimator's error, its bias in closed form, and its noise, in words."""
    plant, h = problem.plant, problem.barriers[0].expression
    bend = gradient(plant, h).jacobian(plant.states)
    bias = (plant.drift.T * bend * plant.drift)[0, 0] / 2 * problem.dt
    read = compile_function(plant.states, (plant.numeric(bias), plant.numeric(h)), "arrays")
    predicted, level = read(*np.ascontiguousarray(first.x.T))
    errors = first.learned["printed"].record.errors
    noise = next(value for name, value in errors.items() if "standard error" in name)
    signal, added = _rms(first.labels["martingale"]), _rms(level / (repetitions * problem.dt))
    errors = {"missed": _rms(missed), "bias": _rms(predicted), "noise": noise}
    shares = {f"{name}_share": error / signal for name, error in errors.items()}
    return [
        CHAPTER.note("figure-5.1", "printed", repetitions=repetitions, **errors, **shares),
        CHAPTER.note("figure-5.1", "first_term", added=added),
    ]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def root_mean_square(name: str, values: np.ndarray) -> Number:
    """Return that of independent values in 1/s, with the normal interval of their mean square.

    Args:
        name: of the number.
        values: shape (K,).
    """
    square = np.square(values)
    mean, half = float(square.mean()), 1.96 * float(square.std(ddof=1)) / math.sqrt(len(square))
    return Number(
        name, math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half), unit="1/s"
    )


def draw_learning(figure: Figure, outcome: Findings) -> None:
    """Draw the learned term over its state, by the repaired and by the printed estimator.

    Args:
        figure: empty.
        outcome: of the artefact.
    """
    data = outcome.data
    panels = list(figure.subplots(1, 2))
    for axes, key in zip(panels, ("repaired", "printed"), strict=True):
        wide: dict[str, Any] = {"color": COLORS[3], "linewidth": 4.0, "alpha": 0.7}
        labels, network = data[key]["labels"], data[key]["network"]
        axes.plot(data["grid"], data["term"], label="analytic term", **wide)
        axes.plot(data["points"], labels, "k.", markersize=3.5, label="training data")
        dots: dict[str, Any] = {"color": COLORS[0], "markersize": 2.2}
        axes.plot(data["validation"], network, ".", label="network, other states", **dots)
        axes.axhline(0.0, color=QUIET, linewidth=0.6, zorder=0)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
        axes.set_xlabel(data["state"])
    low, high = (float(np.ptp(axes.get_ylim())) for axes in panels)
    panels[0].set(
        title="(a) repaired estimator", ylabel=labelled("noise part of the generator of $h$", "1/s")
    )
    panels[1].set_title(f"(b) printed estimator\n(other scale: {high / low:.3g} times that of (a))")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])
