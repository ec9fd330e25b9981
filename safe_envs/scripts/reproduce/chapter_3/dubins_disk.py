"""Figure 3.1: a Dubins vehicle of unknown speed in a disk, under learned derivatives of the HOCBF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import sympy as sp
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS, QUIET, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_3.learned_runs import (
    CORRECTED,
    Run,
    learning,
    parameters,
    residuals,
    runs,
    seeds,
    thinned,
)
from safe_envs.scripts.reproduce.chapter_3.printed_differences import printed_residuals
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.wrappers import HOCBF
from safe_envs.wrappers.learning.models.residual import ResidualModel

DISK = "DubinsDisk-v0"
RATES = (0.5, 1.0, 5.0)  # p_1 = p_2, 1/s
PRINTED_START, VALID_START = (0.9, 0.1, 0.0), (0.0, 0.1, 0.0)  # m, m, rad
SHOWN = 400  # control instants in the picture
WIDE, NARROW = (-20.0, 20.0), (-math.pi, math.pi)  # turn rate, rad/s
SAFE_COUNT = f"safe trajectories of {len(RATES)}, in the worst learning"
_NOMINAL = [f"hocbf:p={p},{p}" for p in RATES]
_LEARNED = [f"learned-{text}" for text in _NOMINAL]
_NO_MARGIN = [f"{text}:eps=0" for text in _LEARNED]

Learnings = Sequence[Sequence[Run]]  # one run for each gain, for each learning


def disk(sample: Sample) -> SafetyProblem:
    """The problem, as long as the sample lets it be."""
    world = make_problem(DISK)
    return world.configured(horizon=world.dt * sample.work(world.steps))


def compute_disk(sample: Sample) -> Outcome:
    """Trajectories of the disk for each gain, from both starts."""
    world, models = disk(sample), residuals(DISK, sample)
    at = {start: world.configured(start=start, box=WIDE) for start in (PRINTED_START, VALID_START)}
    found = {start: trajectories(problem, models) for start, problem in at.items()}
    believed = runs(at[VALID_START], _NOMINAL, policy="zero")
    exact = {
        start: runs(problem, _NOMINAL, policy="zero", knowledge="plant")
        for start, problem in at.items()
    }
    estimates, shares = zip(
        *(printed_residuals(make_problem(DISK), sample, seed) for seed in seeds(sample)),
        strict=True,
    )
    by_print = trajectories(at[PRINTED_START], estimates, _NO_MARGIN)
    return Outcome(
        numbers=disk_numbers(found[PRINTED_START], printed=len(RATES)),
        claims=[all_safe(found[PRINTED_START]), theory_holds(found[VALID_START], believed)],
        elsewhere=_elsewhere(at, models, found[VALID_START]),
        as_printed=disk_numbers(by_print),
        data=_pictures(found[PRINTED_START][0], by_print[0], found[VALID_START][0], believed),
        notes=[
            *(outside(world, start) for start in at),
            *(
                f"with exact derivatives from {start} the smallest h is {_by_rate(_smallest(each))}"
                for start, each in exact.items()
            ),
            binding(world),
            _by_printed_differences(shares, by_print),
        ],
    )


def trajectories(
    problem: SafetyProblem, models: Sequence[ResidualModel], filters: Sequence[str] = _LEARNED
) -> list[list[Run]]:
    """A run for each gain with each learning, the nominal control being 0."""
    return [runs(problem, filters, model, "zero") for model in models]


def _elsewhere(
    at: dict[tuple[float, ...], SafetyProblem], models: Sequence[ResidualModel], valid: Learnings
) -> dict[str, Outcome]:
    """What comes out with another start, with another box of the input, and without a margin."""
    narrow = {
        start: trajectories(problem.configured(box=NARROW), models) for start, problem in at.items()
    }
    found = {
        f"start {VALID_START}": valid,
        f"start {VALID_START}, |omega| <= pi rad/s": narrow[VALID_START],
        "|omega| <= pi rad/s": narrow[PRINTED_START],
        "without the margin of Eq. (3.20)": trajectories(at[PRINTED_START], models, _NO_MARGIN),
    }
    return {
        name: Outcome(disk_numbers(each, printed=len(RATES)), [all_safe(each)])
        for name, each in found.items()
    }


def disk_numbers(found: Learnings, printed: float | None = None) -> list[Number]:
    """How many are safe, a fact without an interval, which is all of them only if it is so in every
    learning; and the smallest h."""
    each = zip(RATES, zip(*map(_smallest, found), strict=True), strict=True)
    return [
        Number(SAFE_COUNT, float(min(_counts(found))), printed=printed),
        *(Number.mean(f"smallest h, p = {p:g}", h, "m^2") for p, h in each),
    ]


def all_safe(found: Learnings) -> Claim:
    """The text about the figure."""
    return Claim(
        "All trajectories stay safe under the learned derivatives",
        min(worst(found)) > 0,
        f"safe in each learning: {', '.join(map(str, _counts(found)))} of {len(RATES)}; smallest h"
        f" over all: {_by_rate(worst(found))}",
    )


def theory_holds(found: Learnings, believed: Sequence[Run]) -> Claim:
    """What the theory has to say, where it says something."""
    return Claim(
        f"From {VALID_START}, a start that the theory covers, all stay safe under the learned"
        " derivatives, none under the nominal",
        min(worst(found)) > 0 > max(_smallest(believed)),
        f"smallest h over the learnings: {_by_rate(worst(found))}; nominal:"
        f" {_by_rate(_smallest(believed))}",
        printed=False,
    )


def worst(found: Learnings) -> list[float]:
    """The smallest h of each gain over all learnings."""
    return [min(each) for each in zip(*map(_smallest, found), strict=True)]


def _smallest(each: Sequence[Run]) -> list[float]:
    return [run.smallest for run in each]


def _counts(found: Learnings) -> list[int]:
    return [sum(run.smallest > 0 for run in each) for each in found]


def _by_rate(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g} (p = {p:g})" for p, value in zip(RATES, values, strict=True))


def _by_printed_differences(shares: Sequence[float], found: Learnings) -> str:
    return (
        f"the differences of Eq. (3.28) give at most {max(shares):.2g} of the input's gain (median"
        f" over states), so that the filter turns about {1 / max(shares):.2g} times as much as the"
        f" condition asks for: without a margin, as printed, {min(_counts(found))} of {len(RATES)}"
        f" runs from {PRINTED_START} are safe in the worst learning"
    )


def _pictures(
    printed: Sequence[Run], by_print: Sequence[Run], valid: Sequence[Run], believed: Sequence[Run]
) -> dict[str, Any]:
    """The curves of the three panels."""
    shown = (
        (0, "learned", printed),
        (1, "learned", by_print),
        (2, "learned", valid),
        (2, "nominal", believed),
    )
    return {
        "curves": [
            {
                "panel": panel,
                "kind": kind,
                "p": p,
                "x": thinned(run.states[:SHOWN, 0]),
                "y": thinned(run.states[:SHOWN, 1]),
            }
            for panel, kind, found in shown
            for p, run in zip(RATES, found, strict=True)
        ],
        "starts": [PRINTED_START, PRINTED_START, VALID_START],
        "radius": 1.0,
    }


def chain_at(
    problem: SafetyProblem, p: float, start: Sequence[float]
) -> tuple[float, float, float]:
    """h, b_1 and b_2 without the input at a state, for the plant and p_1 = p_2 = p."""
    constraint = HOCBF((p, p)).constraint(problem.plant, problem.barriers[0])
    values = dict(zip(problem.plant.states, map(sp.Float, start), strict=True))
    h, b_1, b_2 = (
        float(problem.plant.numeric(e).subs(values)) for e in (*constraint.chain, constraint.offset)
    )
    return h, b_1, b_2


def outside(problem: SafetyProblem, start: Sequence[float]) -> str:
    """Whether a start is in C_2 for each gain."""
    values = [chain_at(problem, p, start)[1] for p in RATES]
    where = (
        "outside C_2 for every gain"
        if max(values) < 0
        else "inside C_2 for every gain"
        if min(values) >= 0
        else "inside C_2 for some gains"
    )
    return f"the start {tuple(start)} is {where}: b_1 = {_by_rate(values)}, for the true speed"


def crossing(problem: SafetyProblem, p: float, start: Sequence[float]) -> tuple[float, float]:
    """When h passes 0 and how deep it gets while the exact condition binds.

    Then b_1 = b_1(0) exp(-p t) and h = (h(0) + b_1(0) t) exp(-p t), of which the least is at t =
    h(0)/-b_1(0) + 1/p.
    """
    h, b_1, _ = chain_at(problem, p, start)
    time = -h / b_1
    return time, b_1 / p * math.exp(-p * time - 1)


def binding(problem: SafetyProblem) -> str:
    """What exact derivatives and the control 0 make of the printed start."""
    rows = [chain_at(problem, p, PRINTED_START)[2] for p in RATES]
    times, depths = zip(*[crossing(problem, p, PRINTED_START) for p in RATES], strict=True)
    return (
        f"driving straight on breaks the exact condition at {PRINTED_START}, by b_2 ="
        f" {_by_rate(rows)}; while it binds, in continuous time h = (h(0) + b_1(0) t) exp(-p t),"
        f" which is negative from t = {_by_rate(times)} s on and falls to {_by_rate(depths)} if it"
        " binds so long: only a coarse control period or a control that turns more than the"
        " condition asks for keeps such a run safe"
    )


def draw_disk(figure: Figure, outcome: Outcome) -> None:
    """Panels for the printed start, with our estimates and with the printed ones, and for a valid
    start."""
    colors = dict(zip(RATES, COLORS, strict=False))
    names = ("our estimates", "estimates as printed", "our estimates")
    panels = figure.subplots(1, len(names), sharey=True)
    for panel, (axes, name, start) in enumerate(
        zip(panels, names, outcome.data["starts"], strict=True)
    ):
        axes.set(aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.65, 1.65), xlabel="x (m)")
        axes.axvspan(-1.65, 1.65, color=UNSAFE, alpha=0.35, linewidth=0, zorder=0)
        axes.add_patch(
            Circle(
                (0, 0),
                outcome.data["radius"],
                facecolor="white",
                edgecolor="black",
                linewidth=1.2,
                zorder=0.5,
            )
        )
        for curve in (curve for curve in outcome.data["curves"] if curve["panel"] == panel):
            learned = curve["kind"] == "learned"
            style: dict[str, Any] = (
                {"linewidth": 1.3}
                if learned
                else {"linewidth": 0.8, "linestyle": (0, (4, 2)), "alpha": 0.8}
            )
            axes.plot(
                curve["x"],
                curve["y"],
                color=colors[curve["p"]],
                zorder=2 if learned else 1.5,
                **style,
            )
        axes.plot(*start[:2], "*", color="black", markersize=9, zorder=3)
        axes.text(-1.6, -1.6, "unsafe", color=QUIET, va="bottom")
        axes.set_title(f"({'abc'[panel]}) start ({start[0]:g}, {start[1]:g})\n{name}")
    panels[0].set_ylabel("y (m)")
    handles = [
        Line2D([], [], color=colors[p], linewidth=1.8, label=f"$p_1 = p_2 = {p:g}$ 1/s")
        for p in RATES
    ]
    add_legend(
        figure,
        [*handles, Line2D([], [], color=QUIET, linewidth=0.8, linestyle="--", label="nominal")],
    )


def setting(sample: Sample) -> tuple[str, ...]:
    """How it is simulated."""
    world = disk(sample)
    speeds = [parameters(system)["v"] for system in (world.plant, world.model)]
    return (
        (
            f"{DISK}: plant {speeds[0]:g} m/s, model {speeds[1]:g} m/s, dt {world.dt:g} s,"
            f" {world.horizon:g} s; p_1 = p_2 = {', '.join(f'{p:g}' for p in RATES)} 1/s; start"
            f" {PRINTED_START}, and {VALID_START} beside it"
        ),
        learning(sample),
        "safe: h > 0 at every control instant",
        f"the picture shows the first learning, up to {min(SHOWN * world.dt, world.horizon):g} s",
    )


FIGURE = Artefact(
    name="figure-3.1",
    title="Dubins vehicle in the unit disk under learned derivatives of the HOCBF",
    compute=compute_disk,
    draw=draw_disk,
    setting=setting,
    chosen=(
        "nominal control 0",
        f"|omega| <= {WIDE[1]:g} rad/s, and |omega| <= pi rad/s beside it",
        "layers of 100 and 30 nodes, which the print gives for the quadrotor",
        (
            "for Eq. (3.28) as printed: differences over the control period, the backward one"
            " driven straight on, no margin"
        ),
    ),
    corrections=(
        (
            f"Sec. 3.5.1: the start {PRINTED_START} is outside C_2 for all three gains, where no"
            f" safety follows; {VALID_START} is shown too"
        ),
        (
            "Sec. 3.5.1: the relative degree is not 2 where the heading is radial; the row is"
            " infeasible there unless b_2 >= 0"
        ),
        (
            "Sec. 3.5.1: a network with 3 inputs; here 4, x, y, cos(theta) and sin(theta), for"
            " theta leaves the range that was learned as the vehicle turns on"
        ),
        *CORRECTED,
    ),
    argument=(
        "With exact derivatives, too, a run from the printed start leaves the set: see the closed"
        " form in the notes."
    ),
    size=(7.0, 3.2),
)
