"""Figure 3.1: a Dubins vehicle of unknown speed in a disk, under a learned HOCBF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from safe_envs import ControlAffineSDE, SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.lie import derivatives, lie_derivative_f, lie_derivative_g
from safe_envs.filters.learning.collection import collect_paths, draw_states
from safe_envs.filters.learning.data import Signature
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.residual import LearnedResidual, ResidualModel
from safe_envs.filters.learning.residual import AdamSettings, train
from safe_envs.scripts.figures.style import COLORS, QUIET, UNSAFE, add_legend, quantity, unit_text
from thesis.artefact import Claim, Number, Outcome, Sample, settings, texts
from thesis.chapter_3 import learning
from thesis.chapter_3.learning import Trajectory, runs
from thesis.drawing import SHADED

DISK = settings(3, "disk")
RATES = DISK.rates
WIDE, NARROW = (-DISK.turn_rate, DISK.turn_rate), (-math.pi, math.pi)  # rad/s
_SHOWN = 400  # control instants in the figure
_NOMINAL = [f"hocbf:alpha={p},{p}" for p in RATES]
_LEARNED = [f"learned-{text}" for text in _NOMINAL]
_NO_MARGIN = [f"{text}:eps=0" for text in _LEARNED]


def disk(sample: Sample) -> SafetyProblem:
    """Return the problem, as long as the sample lets it be."""
    problem = make_problem(DISK.env)
    return problem.configured(horizon=problem.dt * sample.work(problem.steps))


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute the trajectories of the disk for each gain, from both starts."""
    world, models = disk(sample), learning.residuals(DISK.env, sample)
    printed, valid = (
        world.configured(start=start, input_bounds=WIDE) for start in (DISK.start, DISK.valid_start)
    )
    shown, from_printed = _learned(printed, models)
    shown_valid, from_valid = _learned(valid, models)
    by_differences = [
        printed_residuals(make_problem(DISK.env), sample, seed) for seed in learning.seeds(sample)
    ]
    shown_formula, by_formula = _learned(printed, [m for m, _ in by_differences], _NO_MARGIN)
    share = max(share for _, share in by_differences)
    nominal = runs(valid, _NOMINAL, policy="zero")
    others = {
        f"start {DISK.valid_start}": from_valid,
        f"start {DISK.valid_start}, |omega| <= pi rad/s": _learned(
            valid.configured(input_bounds=NARROW), models
        )[1],
        "|omega| <= pi rad/s": _learned(printed.configured(input_bounds=NARROW), models)[1],
        "without the margin of Eq. (3.20)": _learned(printed, models, _NO_MARGIN)[1],
    }
    exact = {
        start: runs(problem, _NOMINAL, policy="zero", knowledge="plant")
        for start, problem in ((DISK.start, printed), (DISK.valid_start, valid))
    }
    safe_runs = texts()["figure-3.1"].printed["safe_runs"]
    outcome = Outcome(
        numbers(from_printed, safe_runs),
        [all_safe(from_printed), theory_holds(from_valid, smallest(nominal))],
        {name: Outcome(numbers(h, safe_runs), [all_safe(h)]) for name, h in others.items()},
        numbers(by_formula),
        notes=[
            *(
                f"with exact derivatives from {start} the smallest h is {by_rate(smallest(each))}"
                for start, each in exact.items()
            ),
            f"the differences of Eq. (3.28) give at most {share:.2g} of the input's gain (median"
            f" over states), so that the filter turns about {1 / share:.2g} times as much as the"
            " condition asks for",
        ],
    )
    return outcome, partial(_draw, shown, shown_formula, shown_valid, nominal)


def _learned(
    problem: SafetyProblem, models: Iterable[ResidualModel], filters: Sequence[str] = _LEARNED
) -> tuple[list[Trajectory], np.ndarray]:
    """Return the runs of the first learning, and the smallest h of all, (learnings, gains).

    The nominal control is 0.
    """
    found = [runs(problem, filters, model, "zero") for model in models]
    return found[0], np.array([smallest(each) for each in found])


def smallest(each: Iterable[Trajectory]) -> np.ndarray:
    """Return the smallest h of each run."""
    return np.array([run.smallest for run in each])


def by_rate(values: Iterable[float]) -> str:
    """Return a value for each of `RATES`, as text."""
    return ", ".join(f"{value:.3g} (p = {p:g})" for p, value in zip(RATES, values, strict=True))


def numbers(h: np.ndarray, printed: float | None = None) -> list[Number]:
    """Return how many runs are safe in the worst learning, and the smallest h of each gain.

    `h` is that of all runs, shape (learnings, gains), here and below.
    """
    count = f"safe trajectories of {len(RATES)}, in the worst learning"
    return [
        Number(count, float((h > 0).sum(axis=1).min()), printed=printed),
        *(Number.mean(f"smallest h, p = {p:g}", h[:, i], "m^2") for i, p in enumerate(RATES)),
    ]


def all_safe(h: np.ndarray) -> Claim:
    """Return the claim of the text about the figure."""
    counts = ", ".join(map(str, (h > 0).sum(axis=1)))
    return Claim(
        "All trajectories stay safe under the learned derivatives",
        h.min() > 0,
        f"safe in each learning: {counts} of {len(RATES)}; smallest h over all:"
        f" {by_rate(h.min(axis=0))}",
    )


def theory_holds(h: np.ndarray, nominal: np.ndarray) -> Claim:
    """Return the claim of the theory where it applies, with the smallest h by nominal models."""
    return Claim(
        f"From {DISK.valid_start}, a start that the theory covers, all stay safe under the learned"
        " derivatives, none under the nominal",
        h.min() > 0 > nominal.max(),
        f"smallest h over the learnings: {by_rate(h.min(axis=0))}; nominal: {by_rate(nominal)}",
        printed=False,
    )


def printed_residuals(
    problem: SafetyProblem, sample: Sample, seed: int
) -> tuple[ResidualModel, float]:
    """Return what is learned from differences over control periods, and the share of the gain.

    The backward period is driven straight on, the forward one under either of two inputs. The share
    is the median over states of the input's gain in the differences, as part of the true one.

    Source: thesis Eq. (3.28), with Eq. (3.24).
    """
    size, domain = learning.sizes(sample), problem.sampling_domain
    before = draw_states(problem, size["states"], np.random.default_rng(seed))
    x = _stepped(problem, before, 0.0)
    first, second = domain.inputs[0][0], domain.inputs[-1][0]
    known, true = (_lie_derivatives(each, problem, x) for each in (problem.model, problem.plant))
    h_before, h = _barrier(problem, before), _barrier(problem, x)
    excess = []
    for u in (first, second):
        bend = (_barrier(problem, _stepped(problem, x, u)) + h_before - 2 * h) / problem.dt**2
        excess.append(bend - known[2] - known[3] * u)
    gain = (excess[1] - excess[0]) / (second - first)
    slope = (h - h_before) / problem.dt
    targets = np.stack([slope - known[1], excess[0] - gain * first, gain], axis=1)
    inputs = _values(problem.plant, domain.coordinates, x).T
    trained = train(inputs, targets, AdamSettings(epochs=size["epochs"]), seed=seed)
    part = LearnedResidual(
        problem.plant.states, domain.coordinates, 2, trained.network, trained.heldout
    )
    record = Record(3 * len(x), 3 * len(x) * problem.dt, 0.0, seed)
    model = ResidualModel(Signature.of(problem), record, (part,))
    return model, float(np.median((gain + known[3]) / true[3]))


def _stepped(problem: SafetyProblem, states: np.ndarray, u: float) -> np.ndarray:
    """Return states, shape (B, n), a control period later under one held input."""
    return collect_paths(problem, states, np.full((len(states), 1), u), 1, problem.dt)[:, 1]


def _values(system: ControlAffineSDE, expressions: Iterable[Any], x: np.ndarray) -> np.ndarray:
    """Return expressions of the states of a system at states (B, n), shape (expressions, B)."""
    numeric = [system.numeric(each) for each in expressions]
    compiled = compile_function(system.states, numeric, "arrays")
    return stacked(compiled(*np.ascontiguousarray(x.T)), len(x)).T


def _barrier(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    return _values(problem.plant, [problem.barriers[0].expression], x)[0]


def _lie_derivatives(system: ControlAffineSDE, problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """Return h, L_f h, L_f^2 h and L_g L_f h at states, shape (4, B)."""
    along = derivatives(system, problem.barriers[0].expression, 2, lie_derivative_f)
    return _values(system, (*along, *lie_derivative_g(system, along[1])), x)


def _draw(
    printed: Sequence[Trajectory],
    by_formula: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    nominal: Sequence[Trajectory],
    figure: Figure,
) -> None:
    """Draw panels for the start of the thesis, by both estimates, and for a valid start."""
    learned: dict[str, Any] = {"linewidth": 1.3, "zorder": 2}
    dashed: dict[str, Any] = {"linewidth": 0.8, "linestyle": (0, (4, 2)), "alpha": 0.8}
    panels = (
        (DISK.start, "our estimates", [(printed, learned)]),
        (DISK.start, "printed estimates", [(by_formula, learned)]),
        (DISK.valid_start, "our estimates", [(valid, learned), (nominal, dashed)]),
    )
    all_axes = figure.subplots(1, len(panels), sharey=True)
    for letter, axes, (start, name, shown) in zip("abc", all_axes, panels, strict=True):
        axes.set(aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.65, 1.65), xlabel=quantity("x", "m"))
        axes.axvspan(-1.65, 1.65, **SHADED)
        edge: dict[str, Any] = {"facecolor": "white", "edgecolor": "black", "linewidth": 1.2}
        axes.add_patch(Circle((0, 0), 1.0, zorder=0.5, **edge))
        for each, style in shown:
            for run, color in zip(each, COLORS, strict=False):
                axes.plot(*run.states[:_SHOWN, :2].T, color=color, **style)
        axes.plot(*start[:2], "*", color="black", markersize=7, zorder=3)
        axes.set_title(f"({letter}) start ({start[0]:g}, {start[1]:g})\n{name}")
    all_axes[0].set_ylabel(quantity("y", "m"))
    handles = [
        Line2D([], [], color=color, linewidth=1.8, label=f"$p_1 = p_2 = {p:g}$ {unit_text('1/s')}")
        for p, color in zip(RATES, COLORS, strict=False)
    ]
    line = Line2D([], [], color=QUIET, linewidth=0.8, linestyle="--", label="nominal")
    add_legend(figure, [*handles, line, Patch(color=UNSAFE, alpha=0.35, label="unsafe")])


ARTEFACTS = {"figure-3.1": compute}
