"""Figures 5.1 and 5.2: the learned noise part of the generator of a barrier, and its errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient, ito_correction
from safe_envs.filters.learning.collection import draw_states
from safe_envs.scripts.figures.style import COLORS, QUIET, add_legend, labelled, quantity
from thesis.artefact import Claim, Number, Outcome, Sample, settings
from thesis.chapter_5 import noise
from thesis.chapter_5.noise import LEARNING, Identification

PENDULUM, CUBIC = settings(5, "pendulum"), settings(5, "cubic")
_CLOSE = 0.1  # largest rms error of a learned term, as part of the term: a limit of ours


def pendulum_term(theta: Any) -> Any:
    """Return Eq. (5.19) at sigma = .1, for theta in rad."""
    return -math.sqrt(3) * (0.1 * theta) ** 2


def cubic_term(x_2: Any) -> Any:
    """Return the last term of the printed A h, -sigma(x_2)^2, at the first level."""
    return -((CUBIC.levels[0] * x_2) ** 2)


def compute(
    env_id: str,
    level: float,
    state: int,
    said: str,
    formula: Callable[[Any], Any],
    sample: Sample,
) -> tuple[Outcome, Any]:
    """Compute how near the learned term is to the true one, which depends on one state alone.

    `said` is the printed term in words, and `formula` the same as a function of the state.
    """
    problem = make_problem(env_id, noise=level)
    learned = noise.identifications(env_id, level, sample)
    first = learned[0]
    x = [
        draw_states(problem, LEARNING.validation, np.random.default_rng(each.seed))
        for each in learned
    ]
    truth, repaired = _compared(problem, learned, "martingale", x)
    _, printed = _compared(problem, learned, "printed", x)
    expression = ito_correction(problem.plant, problem.barriers[0].expression)
    term = compile_function(
        (problem.plant.states[state],), (problem.plant.numeric(expression),), "arrays"
    )
    missed = {name: each - term(first.x[:, state])[0] for name, each in first.labels.items()}
    grid = np.linspace(*problem.sampling_domain.region[state], 200)
    error, labels = "rms error of the network", "rms error of the training data"
    outcome = Outcome(
        numbers=[
            root_mean_square("rms of the analytic term", truth.ravel()),
            Number.mean(error, _errors(repaired, truth), "1/s", least=0.0),
            root_mean_square(labels, missed["martingale"]),
            root_mean_square(f"{labels}, centred only", missed["centred"]),
        ],
        claims=[
            as_derived(said, term(grid)[0], formula(grid)),
            learnable(_errors(repaired, truth), truth),
            near(_errors(repaired, truth), truth),
        ],
        printed_formula=[
            Number.mean(error, _errors(printed, truth), "1/s", least=0.0),
            root_mean_square(labels, missed["printed"]),
        ],
        notes=[_why_printed_fails(problem, first, missed["printed"])],
    )
    panels = (first.labels["martingale"], repaired[0]), (first.labels["printed"], printed[0])
    curve = grid, term(grid)[0]
    return outcome, partial(_draw, problem, state, curve, first.x[:, state], x[0][:, state], panels)


def _compared(
    problem: SafetyProblem,
    learned: Sequence[Identification],
    estimator: str,
    x: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true term and the networks, each at P states of its own, shape (K, P) both."""
    pairs = [
        next(iter(each.learned[estimator].compare(problem, states).values()))
        for each, states in zip(learned, x, strict=True)
    ]
    truth, estimates = zip(*pairs, strict=True)
    return np.array(truth), np.array(estimates)


def _errors(estimates: np.ndarray, truth: np.ndarray) -> list[float]:
    """Return the rms error of each network: its states are not independent, only networks are."""
    return [_rms(row) for row in estimates - truth]


def as_derived(said: str, term: np.ndarray, printed: np.ndarray) -> Claim:
    """Return the claim that the printed term follows from the system and h, at some states."""
    return Claim(
        f"the analytic term is {said}",
        np.allclose(printed, term, rtol=1e-9, atol=1e-15),
        f"off by {np.abs(term - printed).max():.1g} 1/s at most",
    )


def learnable(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Return the claim that networks are nearer to the term than the best constant.

    Then they learned something of its shape.
    """
    constant, error = float(np.std(truth)), Number.mean("", errors, "1/s", least=0.0)
    return Claim(
        "what the noise adds to the generator of h can be learned from data",
        error.is_below(constant),
        f"rms error of the network {error.text}, of the best constant {constant:.3g} 1/s",
    )


def near(errors: Sequence[float], truth: np.ndarray) -> Claim:
    """Return the claim that networks are near to the term, by a limit of ours."""
    share = float(np.mean(errors)) / _rms(truth)
    return Claim(
        f"the rms error of the network is below {_CLOSE:.0%} of the term's rms",
        share < _CLOSE,
        f"it is {share:.1%} of it",
        printed=False,
    )


def _why_printed_fails(problem: SafetyProblem, first: Identification, missed: np.ndarray) -> str:
    """Return the printed estimator's error, its bias in closed form, and its noise, in words."""
    plant = problem.plant
    bend = gradient(plant, problem.barriers[0].expression).jacobian(plant.states)
    bias = plant.numeric((plant.drift.T * bend * plant.drift)[0, 0] / 2 * problem.dt)
    predicted = compile_function(plant.states, (bias,), "arrays")(*np.ascontiguousarray(first.x.T))
    recorded = first.learned["printed"].record.errors
    random = next(value for name, value in recorded.items() if "standard error" in name)
    signal, missed_by, biased = map(_rms, (first.labels["martingale"], missed, predicted[0]))
    return (
        f"Eq. (5.17), (5.18) miss by {missed_by:.2g} 1/s rms, {missed_by / signal:.3g} times the"
        f" term itself: the bias dt/2 f' h_xx f is {biased:.2g} 1/s, and the noise of the"
        f" transitions {random:.2g} 1/s; the bias is proportional to dt, the noise to 1/sqrt(dt)"
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def root_mean_square(name: str, values: np.ndarray) -> Number:
    """Return that of independent values in 1/s, with the normal interval of their mean square."""
    square = np.square(values)
    mean, half = float(square.mean()), 1.96 * float(square.std(ddof=1)) / math.sqrt(len(square))
    low, high = math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half)
    return Number(name, math.sqrt(mean), low, high, unit="1/s")


def _draw(
    problem: SafetyProblem,
    state: int,
    curve: tuple[np.ndarray, np.ndarray],
    points: np.ndarray,
    validation: np.ndarray,
    panels: tuple[tuple[np.ndarray, np.ndarray], ...],
    figure: Figure,
) -> None:
    """Draw the learned term over its state, by the repaired and by the printed estimator."""
    all_axes = figure.subplots(1, 2)
    for axes, (labels, network) in zip(all_axes, panels, strict=True):
        wide: dict[str, Any] = {"color": COLORS[3], "linewidth": 4.0, "alpha": 0.7}
        axes.plot(*curve, label="analytic term", **wide)
        axes.plot(points, labels, "k.", markersize=3.5, label="training data")
        dots: dict[str, Any] = {"color": COLORS[0], "markersize": 2.2}
        axes.plot(validation, network, ".", label="network, other states", **dots)
        axes.axhline(0.0, color=QUIET, linewidth=0.6, zorder=0)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
        variable = problem.states[state]
        axes.set_xlabel(quantity(variable.symbol.name, variable.unit))
    low, high = (float(np.ptp(axes.get_ylim())) for axes in all_axes)
    all_axes[0].set_ylabel(labelled("noise part of the generator of $h$", "1/s"))
    all_axes[0].set_title("(a) repaired estimator")
    scale = f"other scale: {high / low:.3g} times that of (a)"
    all_axes[1].set_title(f"(b) printed estimator\n({scale})")
    add_legend(figure, all_axes[0].get_legend_handles_labels()[0])


ARTEFACTS = {
    "figure-5.1": partial(
        compute, PENDULUM.env, PENDULUM.noise, 0, "-sqrt(3) (.1 theta)^2", pendulum_term
    ),
    "figure-5.2": partial(
        compute,
        CUBIC.env,
        CUBIC.levels[0],
        1,
        f"-sigma(x_2)^2 at sigma = {CUBIC.levels[0]:g} x_2",
        cubic_term,
    ),
}
