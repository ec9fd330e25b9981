"""What the noise adds to the generator of a barrier, learned by Algorithm 2 of the thesis (Figures
5.1, 5.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, get_args

import numpy as np
import sympy as sp
from matplotlib.figure import Figure

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient, ito_correction
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS, QUIET, add_legend
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number, Outcome, Sample
from safe_envs.wrappers.learning.data.collection import collect, draw_states
from safe_envs.wrappers.learning.estimators import Estimator, ito_part, rates
from safe_envs.wrappers.learning.generator import learn_generator
from safe_envs.wrappers.learning.models.generator import GeneratorModel

POINTS, REPETITIONS = 200, 50_000
"""Of Algorithm 2: start states, and one-step transitions from each."""
VALIDATION = 400
"""States at which the errors of an identification are measured."""
CLOSE = 0.1
"""Largest rms error of a learned term, as part of the term: a limit of ours."""

FIT_ERRATA = (
    (
        "Eq. (5.17), (5.18): the change of h is taken from where the known drift leads, less its"
        " linear part in the noise"
    ),
    "Eq. (5.17): j = 1..n in place of 0..n",
)

_LABELS = "rms error of the training data"
_NETWORK = "rms error of the network"


@dataclass(frozen=True)
class Lesson:
    """What an identification learned: models by estimator, and of a whole lesson the labels at the
    states x of its data."""

    seed: int
    learned: dict[str, GeneratorModel]
    x: np.ndarray
    labels: dict[str, np.ndarray]


@dataclass(frozen=True)
class _Errors:
    """How far the networks of several identifications are from the true term, each at states of its
    own, shape (K, P)."""

    truth: np.ndarray
    estimates: np.ndarray

    @property
    def each(self) -> list[float]:
        """Rms error of each network, in 1/s."""
        return [_rms(row) for row in self.estimates - self.truth]

    @property
    def number(self) -> Number:
        """Their mean. The states at which one network is looked at are not independent of each
        other: only networks are."""
        return Number.mean(_NETWORK, self.each, "1/s", least=0.0)


@lru_cache(maxsize=16)
def lesson(
    env_id: str, noise: float, points: int, repetitions: int, seed: int, whole: bool
) -> Lesson:
    """Follow Algorithm 2 at one noise level, by the repaired and by the printed estimator; `whole`
    adds all labels."""
    problem = make_problem(env_id, noise=noise)
    data = collect(problem, points, repetitions, [[0.0]], seed=seed)
    estimators: tuple[Estimator, ...] = ("martingale", "printed")
    learned = {
        name: learn_generator(problem, data=data, estimator=name, seed=seed) for name in estimators
    }
    if not whole:
        return Lesson(seed, learned, data.x, {})
    h, plant = problem.barriers[0].expression, problem.plant
    value, slopes = (
        compile_function(plant.states, tuple(plant.numeric(e) for e in part), "arrays")
        for part in ([h], gradient(plant, h))
    )
    rate = rates(problem.model, data)
    labels = {
        e: ito_part(data, rate, lambda x: value(*x)[0], lambda x: slopes(*x), e).values
        for e in get_args(Estimator)
    }
    return Lesson(seed, learned, data.x, labels)


def identifications(sample: Sample) -> int:
    """How often is learned; at least twice, since intervals are over it."""
    return 2 if sample.quick else 3


def lessons(env_id: str, noise: float, sample: Sample) -> list[Lesson]:
    """Several identifications, the first of them whole."""
    children = (
        np.random.SeedSequence(sample.seed, spawn_key=(r, 0)).generate_state(1)[0]
        for r in range(1, identifications(sample))
    )
    seeds = [sample.seed, *map(int, children)]
    return [
        lesson(env_id, noise, sample.work(POINTS), sample.work(REPETITIONS), seed, r == 0)
        for r, seed in enumerate(seeds)
    ]


def models(learned: Sequence[Lesson], estimator: Estimator = "martingale") -> list[GeneratorModel]:
    """What was learned by an estimator."""
    return [each.learned[estimator] for each in learned]


def learning_setting(sample: Sample, where: str, noise: str) -> tuple[str, ...]:
    """How a term is learned, and its error measured."""
    return (
        (
            f"{sample.work(POINTS)} states uniform in {where}, {sample.work(REPETITIONS)} Euler"
            f" steps of 10 ms from each, u = 0, {noise}"
        ),
        (
            f"network 100-30, 500 epochs at most; {identifications(sample)} identifications, each"
            f" with data of its own; the error of each at {VALIDATION} other states"
        ),
    )


def learning_outcome(
    env_id: str, noise: float, state: int, said: str, formula: Callable[[Any], Any], sample: Sample
) -> Outcome:
    """How near the learned term is to the true one, which depends on one state alone.

    Args:
        env_id: of the system.
        noise: its level.
        state: on which the term depends.
        said: the printed term, in words.
        formula: the same as a function of the state.
        sample: how much is simulated.
    """
    problem, learned = make_problem(env_id, noise=noise), lessons(env_id, noise, sample)
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
    grid = np.linspace(*problem.exploration.region[state], 200)
    unit = f" ({problem.states[state].unit})" if problem.states[state].unit else ""
    return Outcome(
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
        as_printed=[printed.number, root_mean_square(_LABELS, missed["printed"])],
        data={
            "state": f"${sp.latex(problem.plant.states[state])}${unit}",
            "grid": grid.tolist(),
            "term": term(grid)[0].tolist(),
            "points": first.x[:, state].tolist(),
            "validation": x[0][:, state].tolist(),
            "repaired": {
                "labels": first.labels["martingale"].tolist(),
                "network": repaired.estimates[0].tolist(),
            },
            "printed": {
                "labels": first.labels["printed"].tolist(),
                "network": printed.estimates[0].tolist(),
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
    """Whether the printed formula of the term is that which follows from the system and h, at some
    states."""
    largest = float(np.abs(term - printed).max())
    return Claim(
        f"the analytic term is {said}",
        bool(np.allclose(printed, term, rtol=1e-9, atol=1e-15)),
        f"off by {largest:.1g} 1/s at most",
    )


def learnable(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Whether networks are nearer to the term than the best constant: then they learned something
    of its shape."""
    constant = float(np.std(truth))
    found = Number.mean("", errors, least=0.0)
    holds = found.high is not None and found.high < constant
    evidence = (
        f"rms error of the network {found.ours:.2g} 1/s [{found.low:.2g}, {found.high:.2g}], of the"
        f" best constant {constant:.2g} 1/s"
    )
    return Claim(
        "what the noise adds to the generator of h can be learned from data", holds, evidence
    )


def near(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Whether networks are near to the term, by a limit of ours."""
    share = float(np.mean(errors)) / _rms(truth)
    sentence = f"the rms error of the network is below {CLOSE:.0%} of the term's rms"
    return Claim(sentence, share < CLOSE, f"it is {share:.1%} of it", printed=False)


def _why_printed_fails(
    problem: SafetyProblem, first: Lesson, missed: np.ndarray, repetitions: int
) -> list[str]:
    """The printed estimator's error, its bias in closed form, and its noise."""
    plant, h = problem.plant, problem.barriers[0].expression
    bias = (
        (plant.drift.T * gradient(plant, h).jacobian(plant.states) * plant.drift)[0, 0]
        / 2
        * problem.dt
    )
    read = compile_function(plant.states, (plant.numeric(bias), plant.numeric(h)), "arrays")
    predicted, level = read(*np.ascontiguousarray(first.x.T))
    noise = next(
        value
        for name, value in first.learned["printed"].record.errors.items()
        if "standard error" in name
    )
    signal, added = _rms(first.labels["martingale"]), _rms(level / (repetitions * problem.dt))
    return [
        (
            f"Eq. (5.17), (5.18) miss by {_rms(missed):.2g} 1/s rms, {_rms(missed) / signal:.3g}"
            f" times the term itself: the bias dt/2 f' h_xx f is {_rms(predicted):.2g} 1/s,"
            f" {_rms(predicted) / signal:.3g} times the term, and the noise of {repetitions}"
            f" transitions {noise:.2g} 1/s, {noise / signal:.2g} of it; the bias is proportional to"
            " dt, the noise to 1/sqrt(dt)"
        ),
        (
            f"the sum of Eq. (5.17) from j = 0 would add h/(n dt), {added:.2g} 1/s rms: not in"
            " these numbers"
        ),
    ]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def root_mean_square(name: str, values: np.ndarray) -> Number:
    """Of independent values in 1/s, with the normal interval of their mean square."""
    square = np.square(values)
    mean, half = float(square.mean()), 1.96 * float(square.std(ddof=1)) / math.sqrt(len(square))
    return Number(
        name, math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half), unit="1/s"
    )


def draw_learning(figure: Figure, outcome: Outcome) -> None:
    """The learned term over the state that it depends on: by the repaired estimator, and by the
    printed one."""
    data = outcome.data
    panels = list(figure.subplots(1, 2))
    for axes, key in zip(panels, ("repaired", "printed"), strict=True):
        axes.plot(
            data["grid"],
            data["term"],
            color=COLORS[3],
            linewidth=5.0,
            alpha=0.7,
            label="analytic term",
        )
        axes.plot(
            data["points"],
            data[key]["labels"],
            ".",
            color="black",
            markersize=5,
            label="training data",
        )
        axes.plot(
            data["validation"],
            data[key]["network"],
            ".",
            color=COLORS[0],
            markersize=2.2,
            label="network, other states",
        )
        axes.axhline(0.0, color=QUIET, linewidth=0.6, zorder=0)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
        axes.set_xlabel(data["state"])
    low, high = (float(np.ptp(axes.get_ylim())) for axes in panels)
    panels[0].set(title="(a) repaired estimator", ylabel="noise part of the generator of h (1/s)")
    panels[1].set_title(
        f"(b) estimator as printed\n(other scale: {high / low:.3g} times that of (a))"
    )
    add_legend(figure, panels[0].get_legend_handles_labels()[0])
