"""Figure 3.1: a Dubins vehicle of unknown speed in a disk, under learned derivatives of the HOCBF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from agents.problems import load_problem
from safe_envs.calculus import derivatives, drift_derivative, input_derivative
from safe_envs.codegen import compile_function, stacked
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from scripts.figure import COLORS, QUIET, UNSAFE, add_legend
from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome, Sample
from scripts.reproduce.learned_runs import CORRECTED, LEARNING, Run, over_learnings, residuals, runs, seeds, settings, thinned
from wrappers import HOCBF
from wrappers.learning.base import Record
from wrappers.learning.collect import collect_paths, draw_states
from wrappers.learning.files import Signature
from wrappers.learning.residual import LearnedResidual, ResidualModel
from wrappers.learning.training import train

DISK = "DubinsDisk-v0"
RATES = (0.5, 1.0, 5.0)  # p_1 = p_2, 1/s
PRINTED_START, VALID_START = (0.9, 0.1, 0.0), (0.0, 0.1, 0.0)  # m, m, rad
SHOWN = 400  # control instants in the picture
WIDE, NARROW = (-20.0, 20.0), (-math.pi, math.pi)  # turn rate, rad/s


def compute_disk(sample: Sample) -> Outcome:
    """Trajectories of the disk for each gain, from both starts."""
    models = residuals(DISK, sample)
    world = load_problem(DISK)
    world = world.configured(horizon=world.dt * sample.work(world.steps))
    nominal, learned, bare = ([f"{kind}:p={p},{p}{end}" for p in RATES] for kind, end in (("hocbf", ""), ("learned-hocbf", ""), _NO_MARGIN))
    at = {start: world.configured(start=start, box=WIDE) for start in (PRINTED_START, VALID_START)}
    ours = {start: [runs(problem, learned, model, "zero") for model in models] for start, problem in at.items()}
    believed = runs(at[VALID_START], nominal, policy="zero")
    exact = {start: runs(problem, nominal, policy="zero", knowledge="plant") for start, problem in at.items()}
    narrow = {start: runs(world.configured(start=start, box=NARROW), learned, models[0], "zero") for start in at}
    without = runs(at[PRINTED_START], bare, models[0], "zero")
    estimated = [printed_residuals(load_problem(DISK), sample, seed) for seed in seeds(sample)]
    by_print = [runs(at[PRINTED_START], bare, model, "zero") for model, _ in estimated]
    printed, valid = ([min(each) for each in zip(*_smallest(ours[start]), strict=True)] for start in at)
    return Outcome(
        numbers=_disk_numbers(ours[PRINTED_START], printed=3),
        elsewhere={
            f"start {VALID_START}": Outcome(_disk_numbers(ours[VALID_START], printed=3)),
            f"start {VALID_START}, |omega| <= pi": Outcome(_disk_numbers([narrow[VALID_START]], printed=3)),
            "|omega| <= pi": Outcome(_disk_numbers([narrow[PRINTED_START]], printed=3)),
            "without the margin of Eq. (3.20)": Outcome(_disk_numbers([without], printed=3)),
        },
        as_printed=_disk_numbers(by_print),
        claims=[
            Claim(
                f"All trajectories from {PRINTED_START} stay safe under the learned derivatives",
                min(printed) > 0,
                f"smallest h over the learnings: {_by_rate(printed)}",
            ),
            Claim(
                f"From {VALID_START}, a start that the theory covers, all stay safe under the learned derivatives, none under the nominal",
                min(valid) > 0 > max(run.smallest for run in believed),
                f"smallest h, learned: {_by_rate(valid)}; nominal: {_by_rate([run.smallest for run in believed])}",
            ),
        ],
        data={
            "curves": [
                {"panel": panel, "kind": kind, "p": p, "x": thinned(run.states[:SHOWN, 0]), "y": thinned(run.states[:SHOWN, 1])}
                for panel, kind, found in (
                    (0, "learned", ours[PRINTED_START][0]),
                    (1, "learned", by_print[0]),
                    (2, "learned", ours[VALID_START][0]),
                    (2, "nominal", believed),
                )
                for p, run in zip(RATES, found, strict=True)
            ],
            "starts": [PRINTED_START, PRINTED_START, VALID_START],
            "radius": 1.0,
        },
        notes=[
            *(outside(world, start) for start in at),
            f"with exact derivatives from {PRINTED_START} the smallest h is {_by_rate([run.smallest for run in exact[PRINTED_START]])}, "
            f"from {VALID_START} it is {_by_rate([run.smallest for run in exact[VALID_START]])}",
            binding(world),
            f"the differences of Eq. (3.28) give {estimated[0][1]:.2g} of the input's gain (median), so that the filter turns more than "
            f"the condition asks for: without a margin, as printed, {min(map(_safe, by_print))} of {len(RATES)} runs from "
            f"{PRINTED_START} are safe in the worst learning",
        ],
    )


def printed_residuals(problem: SafetyProblem, sample: Sample, seed: int) -> tuple[ResidualModel, float]:
    """What is learned from the differences of Eq. (3.28) over control periods, and the median share of the input's gain in them.

    The backward period is driven straight on, the forward one under either of two inputs.
    """
    dt, count, epochs = problem.dt, *settings(sample)
    before = draw_states(problem, count, np.random.default_rng(seed))

    def stepped(states: np.ndarray, omega: float) -> np.ndarray:
        return collect_paths(problem, states, np.full((count, 1), omega), 1, dt)[:, 1]

    x = stepped(before, 0.0)
    first, second = problem.exploration.inputs[0][0], problem.exploration.inputs[-1][0]
    h_before, h, *h_after = (_barrier(problem, states) for states in (before, x, stepped(x, first), stepped(x, second)))
    known, true = (_lie_derivatives(system, problem, x) for system in (problem.model, problem.plant))
    excess = [(after + h_before - 2 * h) / dt**2 - known[2] - known[3] * u for after, u in zip(h_after, (first, second), strict=True)]
    gain = (excess[1] - excess[0]) / (second - first)
    targets = np.stack([(h - h_before) / dt - known[1], excess[0] - gain * first, gain], axis=1)
    coordinates = problem.exploration.coordinates
    inputs = stacked(compile_function(problem.plant.states, coordinates, "arrays")(*np.ascontiguousarray(x.T)), count)
    trained = train(inputs, targets, epochs=epochs, seed=seed)
    part = LearnedResidual(problem.plant.states, coordinates, 2, trained.network, trained.heldout)
    record = Record(3 * count, 3 * count * dt, 0.0, seed)
    return ResidualModel(Signature.of(problem), record, (part,)), float(np.median((gain + known[3]) / true[3]))


def _barrier(problem: SafetyProblem, states: np.ndarray) -> np.ndarray:
    return compile_function(problem.plant.states, [problem.barriers[0].expression], "arrays")(*np.ascontiguousarray(states.T))[0]


def _lie_derivatives(system: ControlAffineSDE, problem: SafetyProblem, states: np.ndarray) -> np.ndarray:
    """h, L_f h, L_f^2 h and L_g L_f h at states, shape (4, B)."""
    along = derivatives(system, problem.barriers[0].expression, 2, drift_derivative)
    expressions = [system.numeric(e) for e in (*along, *input_derivative(system, along[1]))]
    return stacked(compile_function(system.states, expressions, "arrays")(*np.ascontiguousarray(states.T)), len(states)).T


_NO_MARGIN = ("learned-hocbf", ":eps=0")


def _smallest(found: Sequence[Sequence[Run]]) -> list[list[float]]:
    return [[run.smallest for run in each] for each in found]


def _safe(each: Sequence[Run]) -> int:
    return sum(run.smallest > 0 for run in each)


def _by_rate(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g} (p = {p:g})" for p, value in zip(RATES, values, strict=True))


def _disk_numbers(found: Sequence[Sequence[Run]], printed: float | None = None) -> list[Number]:
    """Number of safe trajectories and smallest h of each gain, for each learning; of one alone without an interval."""
    values = _smallest(found)
    safe = [float(_safe(each)) for each in found]
    if len(values) == 1:
        # One trajectory is a fact: the count is exact.
        rest = [Number(f"smallest h, p = {p:g}", h, unit="m^2") for p, h in zip(RATES, values[0], strict=True)]
        return [Number("safe trajectories of 3", safe[0], safe[0], safe[0], printed), *rest]
    each = zip(RATES, zip(*values, strict=True), strict=True)
    return [
        over_learnings("safe trajectories of 3", safe, "", printed),
        *(over_learnings(f"smallest h, p = {p:g}", h, "m^2") for p, h in each),
    ]


def chain_at(problem: SafetyProblem, p: float, start: Sequence[float]) -> tuple[float, float, float]:
    """h, b_1 and b_2 without the input at a state, for the plant and p_1 = p_2 = p."""
    constraint = HOCBF((p, p)).constraint(problem.plant, problem.barriers[0])
    values = dict(zip(problem.plant.states, map(sp.Float, start), strict=True))
    h, b_1, b_2 = (float(problem.plant.numeric(e).subs(values)) for e in (*constraint.chain, constraint.offset))
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

    Then b_1 = b_1(0) exp(-p t) and h = (h(0) + b_1(0) t) exp(-p t), of which the least is at t = h(0)/-b_1(0) + 1/p.
    """
    h, b_1, _ = chain_at(problem, p, start)
    time = -h / b_1
    return time, b_1 / p * math.exp(-p * time - 1)


def binding(problem: SafetyProblem) -> str:
    """What exact derivatives and the control 0 make of the printed start."""
    rows = [chain_at(problem, p, PRINTED_START)[2] for p in RATES]
    times, depths = zip(*[crossing(problem, p, PRINTED_START) for p in RATES], strict=True)
    return (
        f"driving straight on breaks the exact condition at {PRINTED_START}, by b_2 = {_by_rate(rows)}; while it binds, in continuous time "
        f"h = (h(0) + b_1(0) t) exp(-p t), which is negative from t = {_by_rate(times)} s on and falls to {_by_rate(depths)} if it binds "
        "so long: only a coarse control period or a control that turns more than the condition asks for keeps such a run safe"
    )


def draw_disk(figure: Figure, outcome: Outcome) -> None:
    """Panels for the printed start, with our estimates and with the printed ones, and for a valid start."""
    colors = dict(zip(RATES, COLORS, strict=False))
    names = ("our estimates", "estimates as printed", "our estimates")
    panels = figure.subplots(1, len(names), sharey=True)
    for panel, (axes, name, start) in enumerate(zip(panels, names, outcome.data["starts"], strict=True)):
        axes.set(aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.65, 1.65), xlabel="x (m)")
        axes.axvspan(-1.65, 1.65, color=UNSAFE, alpha=0.35, linewidth=0, zorder=0)
        axes.add_patch(Circle((0, 0), outcome.data["radius"], facecolor="white", edgecolor="black", linewidth=1.2, zorder=0.5))
        for curve in (curve for curve in outcome.data["curves"] if curve["panel"] == panel):
            learned = curve["kind"] == "learned"
            style: dict[str, Any] = {"linewidth": 1.3} if learned else {"linewidth": 0.8, "linestyle": (0, (4, 2)), "alpha": 0.8}
            axes.plot(curve["x"], curve["y"], color=colors[curve["p"]], zorder=2 if learned else 1.5, **style)
        axes.plot(*start[:2], "*", color="black", markersize=9, zorder=3)
        axes.text(-1.6, -1.6, "unsafe", color=QUIET, va="bottom")
        axes.set_title(f"({'abc'[panel]}) start ({start[0]:g}, {start[1]:g})\n{name}")
    panels[0].set_ylabel("y (m)")
    handles = [Line2D([], [], color=colors[p], linewidth=1.8, label=f"$p_1 = p_2 = {p:g}$ 1/s") for p in RATES]
    add_legend(figure, [*handles, Line2D([], [], color=QUIET, linewidth=0.8, linestyle="--", label="nominal")])


FIGURE = Artefact(
    name="figure-3.1",
    title="Dubins vehicle in the unit disk under learned derivatives of the HOCBF",
    compute=compute_disk,
    draw=draw_disk,
    setting=(
        f"{DISK}: plant .8 m/s, model .5 m/s, dt .05 s, 50 s; p_1 = p_2 = .5, 1 and 5 1/s; starts {PRINTED_START} and {VALID_START}",
        LEARNING,
        "the picture shows the first 20 s",
    ),
    chosen=(
        "nominal control 0",
        "|omega| <= 20 rad/s, the box |omega| <= pi beside it",
        "network inputs x, y, cos(theta), sin(theta)",
        "for Eq. (3.28) as printed: differences over the control period, the backward one driven straight on, no margin",
    ),
    corrections=(
        f"Sec. 3.5.1: the start {PRINTED_START} is outside C_2 for all three gains, where no safety follows; {VALID_START} is shown too",
        "Sec. 3.5.1: the relative degree is not 2 where the heading is radial; the row is infeasible there unless b_2 >= 0",
        *CORRECTED,
    ),
    argument="With exact derivatives, too, a run from the printed start leaves the set: see the closed form in the notes.",
    size=(7.0, 3.2),
)
