"""Figure 3.3: the altitude of a quadrotor of unknown mass, under learned derivatives of the HOCBF and under Eq. (3.33) as printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from agents.episodes import Recorder, run_episodes
from agents.policy import make_policy
from agents.problems import load_problem
from safe_envs.barrier import Barrier
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from safe_envs.systems.quadrotor_altitude import g, m, z, zdot
from safe_envs.vector import SafeVectorEnv
from scripts.figure import QUIET, UNSAFE, add_legend
from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome, Sample
from scripts.reproduce.learned_runs import (
    CORRECTED,
    LEARNED_COLOR,
    LEARNING,
    NOMINAL_COLOR,
    PRINTED_COLOR,
    TRUE_COLOR,
    Run,
    cut,
    over_learnings,
    rates_around,
    residuals,
    runs,
    thinned,
)
from wrappers import AffineConstraint, Condition, SafetyFilterVectorWrapper

QUADROTOR = "QuadrotorAltitude-v0"
GAINS = (2.0, 8.0)  # p_1, p_2, 1/s
CENTER, HALF_WIDTH = 5.0, 2.0  # c and p of the band, m
LEAST_STEPS = 140  # control periods: past the first time that the nominal derivatives leave the band
_GAINS = ",".join(f"{gain:g}" for gain in GAINS)


@dataclass(frozen=True)
class PrintedHOCBF(Condition):
    """The HOCBF of the altitude with the Lie derivatives as they are printed, two signs and a square of which are wrong.

    Attributes:
        p: rates p_1, p_2 in 1/s.

    Source: thesis Eq. (3.33), level flight.
    """

    p: tuple[float, float] = GAINS
    name = "printed-hocbf"

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """The row as printed, for the mass of a model."""
        first, second = self.p
        cubed, squared = 4 * (z - CENTER) ** 3 / HALF_WIDTH**4, 12 * (z - CENTER) ** 2 / HALF_WIDTH**4
        h, slope = barrier.expression, -cubed * zdot
        bend = -cubed * g - squared * zdot
        return AffineConstraint((cubed / m,), bend + (first + second) * slope + first * second * h, (h, slope + first * h))

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
    problem = load_problem(QUADROTOR, {"start": "thesis"})
    problem = problem.configured(horizon=problem.dt * max(LEAST_STEPS, sample.work(problem.steps)))
    models = residuals(QUADROTOR, sample)
    exact = f"hocbf:p={_GAINS}"
    nominal, none = runs(problem, [exact, "none"])
    (true,) = runs(problem, [exact], knowledge="plant")
    learned = [runs(problem, [f"learned-hocbf:p={_GAINS}"], model)[0] for model in models]
    printed = {"nominal": printed_run(problem, "model"), "true": printed_run(problem, "plant")}
    found = {"nominal": nominal, "true": true, "none": none}
    heights = np.concatenate([run.states[:, 0] for run in learned])
    wandering = printed["true"]
    return Outcome(
        numbers=[
            over_learnings("smallest h, learned", [run.smallest for run in learned], ""),
            *(Number(f"smallest h, {kind}", run.smallest) for kind, run in found.items()),
            Number("time in the workspace, true", true.steps * problem.dt, unit="s"),
            *rates_around(problem, sample, models, _GAINS),
        ],
        as_printed=[
            *(Number(f"smallest h, {kind}", run.smallest) for kind, run in printed.items()),
            Number("time in the workspace, true", wandering.steps * problem.dt, unit="s"),
        ],
        claims=[
            Claim(
                "With the nominal derivatives the altitude leaves the band",
                nominal.smallest < 0,
                f"smallest h {nominal.smallest:.3g}, altitude {_range(nominal.states[:, 0])}",
            ),
            Claim(
                "With the learned derivatives the altitude stays in the band",
                min(run.smallest for run in learned) > 0,
                f"smallest h over the learnings {min(run.smallest for run in learned):.3g}, altitude {_range(heights)}",
            ),
        ],
        data={
            kind: {"time": thinned(problem.dt * np.arange(len(run.h))), "z": thinned(run.states[:, 0])}
            for kind, run in {**found, "learned": learned[0], "printed": wandering}.items()
        },
        notes=[
            f"Eq. (3.33) as printed, with the true mass: h < 0 from t = {_fall(wandering, problem.dt)} s on, and the altitude leaves "
            f"[0, 10] m after {wandering.steps * problem.dt:.3g} s of {problem.horizon:g} s, at {wandering.states[-1, 0]:.3g} m"
            if wandering.steps < problem.steps
            else f"Eq. (3.33) as printed, with the true mass: smallest h {wandering.smallest:.3g}",
            f"without a filter the altitude goes from {_range(none.states[:, 0])}, for the thrust law, too, believes in the wrong mass",
        ],
    )


def _range(heights: np.ndarray) -> str:
    return f"{heights.min():.2f} to {heights.max():.2f} m"


def _fall(run: Run, dt: float) -> str:
    return f"{dt * int(np.argmax(run.h < 0)):.3g}" if run.smallest < 0 else "never"


def draw(figure: Figure, outcome: Outcome) -> None:
    """The altitude over time."""
    axes = figure.add_subplot()
    time = np.array(outcome.data["learned"]["time"])
    axes.plot(time, CENTER + 2.5 * np.sin(time), color=QUIET, linewidth=0.9, alpha=0.7, label="reference")
    # The true derivatives lie below the learned ones: the two are nearly the same.
    lines = (
        ("true", TRUE_COLOR, "-", 3.2, "true derivatives"),
        ("learned", LEARNED_COLOR, "-", 1.3, "learned derivatives"),
        ("nominal", NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("printed", PRINTED_COLOR, ":", 2.2, "true mass, Eq. (3.33) as printed"),
    )
    for kind, color, dash, width, label in lines:
        axes.plot(outcome.data[kind]["time"], outcome.data[kind]["z"], dash, color=color, linewidth=width, label=label)
    low, high = 1.5, 8.5
    for edge, end in ((CENTER - HALF_WIDTH, low), (CENTER + HALF_WIDTH, high)):
        axes.axhspan(min(edge, end), max(edge, end), color=UNSAFE, alpha=0.35, linewidth=0, zorder=0)
        axes.axhline(edge, color="black", linewidth=1.2, linestyle="--")
    axes.text(0.99, 0.02, "unsafe", transform=axes.transAxes, ha="right", va="bottom", color=QUIET)
    axes.set(xlim=(0.0, time[-1]), ylim=(low, high), xlabel="time (s)", ylabel="altitude z (m)")
    add_legend(figure, axes.get_legend_handles_labels()[0])


ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="figure-3.3",
        title="Altitude of a quadrotor with nominal and learned derivatives of the HOCBF",
        compute=compute,
        draw=draw,
        setting=(
            f"{QUADROTOR}: plant .6 kg, model .4 kg, band 5 +- 2 m, p_1 = 2, p_2 = 8 1/s, reference 5 + 2.5 sin(t) m, start (5 m, 0)",
            LEARNING,
        ),
        chosen=(
            "c = 5 m, g = 9.81 m/s^2, level flight, thrust U = m_model (g + 6 e + 4 edot), 0 <= U <= 12 N, dt .05 s, 30 s",
            "starts within .5 m and .5 m/s of the printed one for rates",
        ),
        corrections=(
            "Eq. (3.33): L_f^2 h is +4 (z-c)^3 g/p^4 - 12 (z-c)^2 zdot^2/p^4, and L_g L_f h has a minus; nothing here is derived by hand",
            "Eq. (3.34), (3.36): E stands inside its own argument, and hats are missing; E = hddot - hddot of the model",
            *CORRECTED,
        ),
        size=(7.0, 4.0),
    ),
)
