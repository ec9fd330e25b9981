"""Figure 3.3: the altitude of a quadrotor of unknown mass, under a learned HOCBF."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import QUIET, add_legend
from safe_envs.scripts.reproduce.chapter_3 import learned_runs
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.drawing import SHADED, draw_lines
from safe_envs.scripts.reproduce.framework.printed_condition import PrintedCondition
from safe_envs.systems.quadrotor_altitude import g, m, z, zdot
from safe_envs.wrappers import AffineConstraint

_SETTINGS = learned_runs.CHAPTER.settings["quadrotor"]
QUADROTOR = _SETTINGS["env"]
GAINS = _SETTINGS["gains"]  # p_1, p_2, 1/s
CENTER, HALF_WIDTH = _SETTINGS["center"], _SETTINGS["half_width"]  # c and p of the band, m
_LEAST_STEPS = 140  # past the first time that the nominal derivatives leave the band
_GAINS = ",".join(f"{gain:g}" for gain in GAINS)


def printed_hocbf(model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
    """Return the HOCBF of the altitude by the printed Lie derivatives, for the mass of a model.

    Two signs and a square of these are wrong.

    Args:
        model: not needed; its mass is a symbol.
        barrier: of the altitude.

    Source: thesis Eq. (3.33), level flight.
    """
    first, second = GAINS
    cubed, squared = (
        factor * (z - CENTER) ** power / HALF_WIDTH**4 for factor, power in ((4, 3), (12, 2))
    )
    h, slope, bend = barrier.expression, -cubed * zdot, -cubed * g - squared * zdot
    offset = bend + (first + second) * slope + first * second * h
    return AffineConstraint((cubed / m,), offset, (h, slope + first * h))


def printed_run(problem: SafetyProblem, knowledge: str) -> learned_runs.Trajectory:
    """Return the trajectory under the printed formula.

    Args:
        problem: with a fixed start.
        knowledge: "model" for the mass of the model, "plant" for the true one.
    """
    return learned_runs.runs(problem, [PrintedCondition(printed_hocbf)], knowledge=knowledge)[0]


def compute(sample: Workload) -> Findings:
    """Compute the altitudes under all filters."""
    problem, models = hover(sample), learned_runs.residuals(QUADROTOR, sample)
    found = learned_runs.trajectories(problem, _GAINS, models)
    printed = {"nominal": printed_run(problem, "model"), "true": printed_run(problem, "plant")}
    shown = {**{kind: run for kind, (run, *_) in found.items()}, "printed": printed["true"]}
    note = partial(learned_runs.CHAPTER.note, "figure-3.3")

    def time_in_workspace(run: learned_runs.Trajectory) -> Number:
        return Number("time in the workspace, true", run.steps * problem.dt, unit="s")

    return Findings(
        numbers=[
            *learned_runs.smallest_numbers(found),
            time_in_workspace(found["true"][0]),
            *learned_runs.rates_around(problem, sample, models, _GAINS),
        ],
        printed_formula=[
            *(Number(f"smallest h, {kind}", run.smallest) for kind, run in printed.items()),
            time_in_workspace(printed["true"]),
        ],
        claims=altitude_claims(found),
        data={kind: run.over_time(problem.dt, z=run.states[:, 0]) for kind, run in shown.items()},
        notes=[
            note("formula", fate=fate(printed["true"], problem)),
            note("none", range=_range(found["none"])),
        ],
    )


def hover(sample: Workload) -> SafetyProblem:
    """Return the problem from the start of the thesis, as long as the sample lets it be."""
    problem = make_problem(QUADROTOR, start="thesis")
    return problem.configured(horizon=problem.dt * max(_LEAST_STEPS, sample.work(problem.steps)))


def altitude_claims(found: learned_runs.Trajectories) -> list[Claim]:
    """Return the claims of the text about the figure."""
    nominal, lowest = found["nominal"][0].smallest, min(run.smallest for run in found["learned"])
    claim = partial(learned_runs.CHAPTER.claim, "figure-3.3")
    return [
        claim("nominal", nominal < 0, h=nominal, range=_range(found["nominal"])),
        claim("learned", lowest > 0, h=lowest, range=_range(found["learned"])),
    ]


def fate(run: learned_runs.Trajectory, problem: SafetyProblem) -> str:
    """Return when a run leaves the band and the workspace, if it does, in words.

    Args:
        run: of the problem.
        problem: with its workspace.
    """
    low, high = problem.states[0].low, problem.states[0].high
    first = (
        f"h < 0 from t = {problem.dt * int(np.argmax(run.h < 0)):.3g} s"
        if run.smallest < 0
        else "h stays at 0 or above"
    )
    if run.steps >= problem.steps:
        return f"smallest h {run.smallest:.3g}; {first}"
    return (
        f"{first}, and the state leaves the workspace, of which the altitudes are [{low:g},"
        f" {high:g}] m, after {run.steps * problem.dt:.3g} s of {problem.horizon:g} s, at"
        f" {run.states[-1, 0]:.3g} m"
    )


def _range(each: Sequence[learned_runs.Trajectory]) -> str:
    heights = np.concatenate([run.states[:, 0] for run in each])
    return f"{heights.min():.2f} to {heights.max():.2f} m"


def _draw(figure: Figure, outcome: Findings) -> None:
    """Draw the altitude over time."""
    axes = figure.add_subplot()
    time = np.array(outcome.data["learned"]["time"])
    reference = CENTER + 2.5 * np.sin(time)
    axes.plot(time, reference, color=QUIET, linewidth=0.9, alpha=0.7, label="reference")
    # The true derivatives lie below the learned ones: the two are nearly the same.
    lines = (
        ("true", learned_runs.TRUE_COLOR, "-", 3.2, "true derivatives"),
        ("learned", learned_runs.LEARNED_COLOR, "-", 1.3, "learned derivatives"),
        ("nominal", learned_runs.NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("printed", learned_runs.PRINTED_COLOR, ":", 2.2, "true mass, printed Eq. (3.33)"),
    )
    draw_lines(axes, outcome.data, lines, "time", "z")
    low, high = 1.5, 8.5
    for edge, end in ((CENTER - HALF_WIDTH, low), (CENTER + HALF_WIDTH, high)):
        label = "unsafe" if end == low else None
        axes.axhspan(min(edge, end), max(edge, end), label=label, **SHADED)
        axes.axhline(edge, color="black", linewidth=1.2, linestyle="--")
    axes.set(xlim=(0.0, time[-1]), ylim=(low, high), xlabel=labelled("time", "s"))
    axes.set_ylabel(labelled("altitude $z$", "m"))
    add_legend(figure, axes.get_legend_handles_labels()[0])


ARTEFACTS = (
    learned_runs.CHAPTER.artefact(
        "figure-3.3",
        compute,
        lambda sample: learned_runs.setting_values(hover(sample), sample),
        _draw,
    ),
)
