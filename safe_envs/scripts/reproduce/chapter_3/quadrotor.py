"""Figure 3.3: the altitude of a quadrotor of unknown mass, under learned derivatives of the HOCBF
and under Eq. (3.33) as printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.rollout import Recorder, run_episodes
from safe_envs.agents.policies.registry import make_policy
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import QUIET, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_3.learned_runs import (
    CORRECTED,
    EPISODES,
    LEARNED_COLOR,
    NOMINAL_COLOR,
    PRINTED_COLOR,
    TRUE_COLOR,
    Run,
    cut,
    learning,
    parameters,
    rates_around,
    residuals,
    runs,
    thinned,
)
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.systems.quadrotor_altitude import g, m, z, zdot
from safe_envs.wrappers import AffineConstraint, Condition, SafetyFilterVectorWrapper
from safe_envs.wrappers.learning.models.residual import ResidualModel

QUADROTOR = "QuadrotorAltitude-v0"
GAINS = (2.0, 8.0)  # p_1, p_2, 1/s
CENTER, HALF_WIDTH = 5.0, 2.0  # c and p of the band, m
LEAST_STEPS = (
    140  # control periods: past the first time that the nominal derivatives leave the band
)
_GAINS = ",".join(f"{gain:g}" for gain in GAINS)

Altitudes = Mapping[
    str, Sequence[Run]
]  # by what the filter knows: one run for each learning, one each without learning


@dataclass(frozen=True)
class PrintedHOCBF(Condition):
    """The HOCBF of the altitude with the Lie derivatives as they are printed, two signs and a
    square of which are wrong.

    Attributes:
        p: rates p_1, p_2 in 1/s.

    Source: thesis Eq. (3.33), level flight.
    """

    p: tuple[float, float] = GAINS
    name = "printed-hocbf"

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """The row as printed, for the mass of a model."""
        first, second = self.p
        cubed, squared = (
            4 * (z - CENTER) ** 3 / HALF_WIDTH**4,
            12 * (z - CENTER) ** 2 / HALF_WIDTH**4,
        )
        h, slope = barrier.expression, -cubed * zdot
        bend = -cubed * g - squared * zdot
        return AffineConstraint(
            (cubed / m,),
            bend + (first + second) * slope + first * second * h,
            (h, slope + first * h),
        )

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedHOCBF:
        """The row with two rates."""
        return cls((gains[0], gains[1]))


def printed_run(problem: SafetyProblem, knowledge: str) -> Run:
    """The trajectory under the printed formula, with the mass of the model or of the plant."""
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 1), PrintedHOCBF(), knowledge)
    recorder = Recorder(problem.steps, problem.plant.n, 1)
    run_episodes(env, make_policy("nominal", problem), 1, 0, recorder=recorder)
    return cut(recorder.states[:, 0], recorder.barrier[:, 0])


def compute(sample: Sample) -> Outcome:
    """Altitudes under all filters."""
    problem, models = hover(sample), residuals(QUADROTOR, sample)
    found = altitudes(problem, models)
    printed = {"nominal": printed_run(problem, "model"), "true": printed_run(problem, "plant")}
    pictures = {**{kind: run for kind, (run, *_) in found.items()}, "printed": printed["true"]}
    return Outcome(
        numbers=[
            Number.mean("smallest h, learned", [run.smallest for run in found["learned"]], ""),
            *(
                Number(f"smallest h, {kind}", found[kind][0].smallest)
                for kind in ("nominal", "true", "none")
            ),
            Number("time in the workspace, true", found["true"][0].steps * problem.dt, unit="s"),
            *rates_around(problem, sample, models, _GAINS),
        ],
        as_printed=[
            *(Number(f"smallest h, {kind}", run.smallest) for kind, run in printed.items()),
            Number("time in the workspace, true", printed["true"].steps * problem.dt, unit="s"),
        ],
        claims=altitude_claims(found),
        data={
            kind: {
                "time": thinned(problem.dt * np.arange(len(run.h))),
                "z": thinned(run.states[:, 0]),
            }
            for kind, run in pictures.items()
        },
        notes=[
            f"Eq. (3.33) as printed, with the true mass: {fate(printed['true'], problem)}",
            (
                f"without a filter the altitude goes from {_range(found['none'])}, for the thrust"
                " law, too, believes in the wrong mass"
            ),
        ],
    )


def hover(sample: Sample) -> SafetyProblem:
    """The problem from the printed start, as long as the sample lets it be."""
    problem = make_problem(QUADROTOR, start="thesis")
    return problem.configured(horizon=problem.dt * max(LEAST_STEPS, sample.work(problem.steps)))


def altitudes(problem: SafetyProblem, models: Sequence[ResidualModel]) -> dict[str, list[Run]]:
    """Trajectories: with learned derivatives for each learning, one each with others and without a
    filter."""
    exact = f"hocbf:p={_GAINS}"
    nominal, none = runs(problem, [exact, "none"])
    learned = [runs(problem, [f"learned-hocbf:p={_GAINS}"], model)[0] for model in models]
    return {
        "nominal": [nominal],
        "true": runs(problem, [exact], knowledge="plant"),
        "none": [none],
        "learned": learned,
    }


def altitude_claims(found: Altitudes) -> list[Claim]:
    """The text about the figure."""
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


def fate(run: Run, problem: SafetyProblem) -> str:
    """When a run leaves the band and the workspace, if it does."""
    low, high = problem.states[0].low, problem.states[0].high
    first = (
        f"h < 0 from t = {problem.dt * int(np.argmax(run.h < 0)):.3g} s"
        if run.smallest < 0
        else "h stays at 0 or above"
    )
    if run.steps >= problem.steps:
        return f"smallest h {run.smallest:.3g}; {first}"
    end = (
        f"after {run.steps * problem.dt:.3g} s of {problem.horizon:g} s, at"
        f" {run.states[-1, 0]:.3g} m"
    )
    return (
        f"{first}, and the state leaves the workspace, of which the altitudes are [{low:g},"
        f" {high:g}] m, {end}"
    )


def _range(each: Sequence[Run]) -> str:
    heights = np.concatenate([run.states[:, 0] for run in each])
    return f"{heights.min():.2f} to {heights.max():.2f} m"


def draw(figure: Figure, outcome: Outcome) -> None:
    """The altitude over time."""
    axes = figure.add_subplot()
    time = np.array(outcome.data["learned"]["time"])
    axes.plot(
        time, CENTER + 2.5 * np.sin(time), color=QUIET, linewidth=0.9, alpha=0.7, label="reference"
    )
    # The true derivatives lie below the learned ones: the two are nearly the same.
    lines = (
        ("true", TRUE_COLOR, "-", 3.2, "true derivatives"),
        ("learned", LEARNED_COLOR, "-", 1.3, "learned derivatives"),
        ("nominal", NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("printed", PRINTED_COLOR, ":", 2.2, "true mass, Eq. (3.33) as printed"),
    )
    for kind, color, dash, width, label in lines:
        axes.plot(
            outcome.data[kind]["time"],
            outcome.data[kind]["z"],
            dash,
            color=color,
            linewidth=width,
            label=label,
        )
    low, high = 1.5, 8.5
    for edge, end in ((CENTER - HALF_WIDTH, low), (CENTER + HALF_WIDTH, high)):
        axes.axhspan(
            min(edge, end), max(edge, end), color=UNSAFE, alpha=0.35, linewidth=0, zorder=0
        )
        axes.axhline(edge, color="black", linewidth=1.2, linestyle="--")
    axes.text(0.99, 0.02, "unsafe", transform=axes.transAxes, ha="right", va="bottom", color=QUIET)
    axes.set(xlim=(0.0, time[-1]), ylim=(low, high), xlabel="time (s)", ylabel="altitude z (m)")
    add_legend(figure, axes.get_legend_handles_labels()[0])


def setting(sample: Sample) -> tuple[str, ...]:
    """How it is simulated."""
    problem = hover(sample)
    plant, model = parameters(problem.plant), parameters(problem.model)
    return (
        (
            f"{QUADROTOR}: plant {plant['m']:g} kg, model {model['m']:g} kg, band {CENTER:g} +-"
            f" {HALF_WIDTH:g} m, p_1 = {GAINS[0]:g}, p_2 = {GAINS[1]:g} 1/s, reference 5 + 2.5"
            f" sin(t) m, start (5 m, 0), dt {problem.dt:g} s, {problem.horizon:g} s"
        ),
        learning(sample),
        f"rates from {sample.size(EPISODES)} starts within .5 m and .5 m/s of the printed one",
        "the picture shows the first learning",
    )


ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="figure-3.3",
        title="Altitude of a quadrotor with nominal and learned derivatives of the HOCBF",
        compute=compute,
        draw=draw,
        setting=setting,
        chosen=(
            (
                "c = 5 m, the middle of the reference; g = 9.81 m/s^2, level flight, at rest at"
                " first; 0 <= U <= 12 N, dt and duration"
            ),
            (
                "thrust U = m_model (g + 6 e + 4 edot), where the print has a PID controller"
                " without its gains"
            ),
            "network inputs z and zdot",
        ),
        corrections=(
            (
                "Eq. (3.33): L_f^2 h is +4 (z-c)^3 g/p^4 - 12 (z-c)^2 zdot^2/p^4, and L_g L_f h has"
                " a minus; nothing here is derived by hand"
            ),
            (
                "Eq. (3.34), (3.36): E stands inside its own argument, and hats are missing; E ="
                " hddot - hddot of the model"
            ),
            (
                "Sec. 3.5.2: the two inputs that are learned from come of two PID controllers; here"
                " 3 and 9 N in every state, always far apart"
            ),
            *CORRECTED,
        ),
        size=(7.0, 4.0),
    ),
)
