"""Figure 3.3: the altitude of a quadrotor of unknown mass, under a learned HOCBF."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.figures.style import QUIET, add_legend, labelled
from safe_envs.systems.quadrotor_altitude import g, m, z, zdot
from safe_envs.wrappers import AffineConstraint
from thesis.artefact import Claim, Number, Outcome, Sample, settings
from thesis.chapter_3 import learning
from thesis.chapter_3.learning import Trajectories, Trajectory
from thesis.drawing import SHADED
from thesis.rates import PrintedCondition

QUADROTOR = settings(3, "quadrotor")
GAINS, CENTER, HALF_WIDTH = QUADROTOR.gains, QUADROTOR.center, QUADROTOR.half_width
_LEAST_STEPS = 140  # past the first time that the nominal derivatives leave the band
_GAINS = ",".join(f"{gain:g}" for gain in GAINS)


def printed_hocbf(model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
    """Return the HOCBF of the altitude by the printed Lie derivatives: two signs, a square wrong.

    The mass of the model is a symbol.

    Source: thesis Eq. (3.33), level flight.
    """
    first, second = GAINS
    cubed, squared = (
        factor * (z - CENTER) ** power / HALF_WIDTH**4 for factor, power in ((4, 3), (12, 2))
    )
    h, slope, bend = barrier.expression, -cubed * zdot, -cubed * g - squared * zdot
    offset = bend + (first + second) * slope + first * second * h
    return AffineConstraint((cubed / m,), offset, (h, slope + first * h))


def hover(sample: Sample) -> SafetyProblem:
    """Return the problem from the start of the thesis, as long as the sample lets it be."""
    problem = make_problem(QUADROTOR.env, start="thesis")
    return problem.configured(horizon=problem.dt * max(_LEAST_STEPS, sample.work(problem.steps)))


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute the altitudes under all filters."""
    problem, models = hover(sample), learning.residuals(QUADROTOR.env, sample)
    found = learning.by_knowledge(problem, _GAINS, models)
    printed = {
        kind: learning.runs(problem, [PrintedCondition(printed_hocbf)], knowledge=knowledge)[0]
        for kind, knowledge in (("nominal", "model"), ("true", "plant"))
    }

    def time_in_workspace(run: Trajectory) -> Number:
        return Number("time in the workspace, true", run.steps * problem.dt, unit="s")

    outcome = Outcome(
        numbers=[
            *learning.smallest_numbers(found),
            time_in_workspace(found["true"][0]),
            *learning.rates_around(problem, sample, models, _GAINS),
        ],
        printed_formula=[
            *(Number(f"smallest h, {kind}", run.smallest) for kind, run in printed.items()),
            time_in_workspace(printed["true"]),
        ],
        claims=altitude_claims(found),
    )
    return outcome, partial(_draw, {**found, "printed": [printed["true"]]}, problem.dt)


def altitude_claims(found: Trajectories) -> list[Claim]:
    """Return the claims of the text about the figure."""
    nominal, lowest = found["nominal"][0].smallest, min(run.smallest for run in found["learned"])
    return [
        Claim(
            "With the nominal derivatives the altitude leaves the band",
            nominal < 0,
            f"smallest h {nominal:.3g}, altitude {_range(found['nominal'])}",
        ),
        Claim(
            "With the learned derivatives the altitude stays in the band",
            lowest > 0,
            f"smallest h over the learnings {lowest:.3g}, altitude {_range(found['learned'])}",
        ),
    ]


def _range(each: Sequence[Trajectory]) -> str:
    heights = np.concatenate([run.states[:, 0] for run in each])
    return f"{heights.min():.2f} to {heights.max():.2f} m"


def _draw(found: Trajectories, dt: float, figure: Figure) -> None:
    """Draw the altitude over time."""
    axes = figure.add_subplot()
    time = dt * np.arange(len(found["learned"][0].h))
    reference = CENTER + 2.5 * np.sin(time)
    axes.plot(time, reference, color=QUIET, linewidth=0.9, alpha=0.7, label="reference")
    # The true derivatives lie below the learned ones: the two are nearly the same.
    for name, color, dashes, width, label in (
        ("true", learning.TRUE_COLOR, "-", 3.2, "true derivatives"),
        ("learned", learning.LEARNED_COLOR, "-", 1.3, "learned derivatives"),
        ("nominal", learning.NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("printed", learning.PRINTED_COLOR, ":", 2.2, "true mass, printed Eq. (3.33)"),
    ):
        heights = found[name][0].states[:, 0]
        instants = dt * np.arange(len(heights))
        axes.plot(instants, heights, dashes, color=color, linewidth=width, label=label)
    low, high = 1.5, 8.5
    for edge, end in ((CENTER - HALF_WIDTH, low), (CENTER + HALF_WIDTH, high)):
        label = "unsafe" if end == low else None
        axes.axhspan(min(edge, end), max(edge, end), label=label, **SHADED)
        axes.axhline(edge, color="black", linewidth=1.2, linestyle="--")
    axes.set(xlim=(0.0, time[-1]), ylim=(low, high), xlabel=labelled("time", "s"))
    axes.set_ylabel(labelled("altitude $z$", "m"))
    add_legend(figure, axes.get_legend_handles_labels()[0])


ARTEFACTS = {"figure-3.3": compute}
