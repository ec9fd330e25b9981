"""Figure 3.1: a Dubins vehicle of unknown speed in a disk, under a learned HOCBF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import quantity, unit_text
from safe_envs.scripts.figures.style import COLORS, QUIET, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_3.disk_starts import (
    PRINTED_START,
    RATES,
    VALID_START,
    binding,
    by_rate,
    outside,
)
from safe_envs.scripts.reproduce.chapter_3.learned_runs import (
    CHAPTER,
    Trajectory,
    residuals,
    runs,
    seeds,
    setting_values,
    thinned,
)
from safe_envs.scripts.reproduce.chapter_3.printed_differences import printed_residuals
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.drawing import SHADED
from safe_envs.wrappers.learning.residual import ResidualModel

_SETTINGS = CHAPTER.settings["disk"]
DISK = _SETTINGS["env"]
WIDE, NARROW = (-_SETTINGS["turn_rate"], _SETTINGS["turn_rate"]), (-math.pi, math.pi)  # rad/s
_SAFE_RUNS = CHAPTER.printed("figure-3.1")["safe_runs"]
_SHOWN = 400  # control instants in the figure
SAFE_COUNT = f"safe trajectories of {len(RATES)}, in the worst learning"
_NOMINAL = [f"hocbf:p={p},{p}" for p in RATES]
_LEARNED = [f"learned-{text}" for text in _NOMINAL]
_NO_MARGIN = [f"{text}:eps=0" for text in _LEARNED]

Learnings = Sequence[Sequence[Trajectory]]  # one run for each gain, for each learning


def disk(sample: Workload) -> SafetyProblem:
    """Return the problem, as long as the sample lets it be."""
    world = make_problem(DISK)
    return world.configured(horizon=world.dt * sample.work(world.steps))


def compute_disk(sample: Workload) -> Findings:
    """Compute the trajectories of the disk for each gain, from both starts."""
    world, models = disk(sample), residuals(DISK, sample)
    at = {start: world.configured(start=start, box=WIDE) for start in (PRINTED_START, VALID_START)}
    found = {start: trajectories(problem, models) for start, problem in at.items()}
    nominal = runs(at[VALID_START], _NOMINAL, policy="zero")
    exact = {
        start: runs(problem, _NOMINAL, policy="zero", knowledge="plant")
        for start, problem in at.items()
    }
    estimates, shares = zip(
        *(printed_residuals(make_problem(DISK), sample, seed) for seed in seeds(sample)),
        strict=True,
    )
    by_formula = trajectories(at[PRINTED_START], estimates, _NO_MARGIN)
    return Findings(
        numbers=disk_numbers(found[PRINTED_START], printed=_SAFE_RUNS),
        claims=[all_safe(found[PRINTED_START]), theory_holds(found[VALID_START], nominal)],
        alternative_settings=_alternatives(at, models, found[VALID_START]),
        printed_formula=disk_numbers(by_formula),
        data=_panels(found[PRINTED_START][0], by_formula[0], found[VALID_START][0], nominal),
        notes=[
            *(outside(world, start) for start in at),
            *(
                CHAPTER.note("figure-3.1", "exact", start=start, smallest=by_rate(_smallest(each)))
                for start, each in exact.items()
            ),
            binding(world),
            _by_printed_differences(shares, by_formula),
        ],
    )


def trajectories(
    problem: SafetyProblem, models: Sequence[ResidualModel], filters: Sequence[str] = _LEARNED
) -> list[list[Trajectory]]:
    """Return a run for each gain with each learning, the nominal control being 0.

    Args:
        problem: with a fixed start.
        models: learned ones.
        filters: text for each gain.
    """
    return [runs(problem, filters, model, "zero") for model in models]


def _alternatives(
    at: dict[tuple[float, ...], SafetyProblem], models: Sequence[ResidualModel], valid: Learnings
) -> dict[str, Findings]:
    """Return the outcomes with another start, other input bounds, and without a margin."""
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
        name: Findings(disk_numbers(each, printed=_SAFE_RUNS), [all_safe(each)])
        for name, each in found.items()
    }


def disk_numbers(found: Learnings, printed: float | None = None) -> list[Number]:
    """Return how many runs are safe in the worst learning, and the smallest h of each gain.

    The first is a fact without an interval.

    Args:
        found: runs of each learning.
        printed: number of safe runs in the thesis.
    """
    each = zip(RATES, zip(*map(_smallest, found), strict=True), strict=True)
    return [
        Number(SAFE_COUNT, float(min(_counts(found))), printed=printed),
        *(Number.mean(f"smallest h, p = {p:g}", h, "m^2") for p, h in each),
    ]


def all_safe(found: Learnings) -> Claim:
    """Return the claim of the text about the figure."""
    counts, lowest = ", ".join(map(str, _counts(found))), worst(found)
    values = {"counts": counts, "runs": len(RATES), "smallest": by_rate(lowest)}
    return CHAPTER.claim("figure-3.1", "safe", min(lowest) > 0, **values)


def theory_holds(found: Learnings, nominal: Sequence[Trajectory]) -> Claim:
    """Return the claim of the theory, where it applies.

    Args:
        found: runs of each learning.
        nominal: runs with nominal derivatives.
    """
    learned, other = worst(found), _smallest(nominal)
    values = {"learned": by_rate(learned), "nominal": by_rate(other)}
    return CHAPTER.claim("figure-3.1", "theory", min(learned) > 0 > max(other), **values)


def worst(found: Learnings) -> list[float]:
    """Return the smallest h of each gain over all learnings."""
    return [min(each) for each in zip(*map(_smallest, found), strict=True)]


def _smallest(each: Sequence[Trajectory]) -> list[float]:
    return [run.smallest for run in each]


def _counts(found: Learnings) -> list[int]:
    return [sum(run.smallest > 0 for run in each) for each in found]


def _by_printed_differences(shares: Sequence[float], found: Learnings) -> str:
    counts = {"safe": min(_counts(found)), "runs": len(RATES)}
    share = max(shares)
    return CHAPTER.note("figure-3.1", "differences", share=share, excess=1 / share, **counts)


def _panels(
    printed: Sequence[Trajectory],
    by_formula: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    nominal: Sequence[Trajectory],
) -> dict[str, Any]:
    """Return the curves of the three panels."""
    shown = (
        (0, "learned", printed),
        (1, "learned", by_formula),
        (2, "learned", valid),
        (2, "nominal", nominal),
    )
    return {
        "curves": [
            {
                "panel": panel,
                "kind": kind,
                "p": p,
                "x": thinned(run.states[:_SHOWN, 0]),
                "y": thinned(run.states[:_SHOWN, 1]),
            }
            for panel, kind, found in shown
            for p, run in zip(RATES, found, strict=True)
        ],
        "starts": [PRINTED_START, PRINTED_START, VALID_START],
        "radius": 1.0,
    }


def _draw_disk(figure: Figure, outcome: Findings) -> None:
    """Draw panels for the start of the thesis, by both estimates, and for a valid start."""
    colors = dict(zip(RATES, COLORS, strict=False))
    names = ("our estimates", "printed estimates", "our estimates")
    panels = figure.subplots(1, len(names), sharey=True)
    for panel, (axes, name, start) in enumerate(
        zip(panels, names, outcome.data["starts"], strict=True)
    ):
        axes.set(aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.65, 1.65), xlabel=quantity("x", "m"))
        axes.axvspan(-1.65, 1.65, **SHADED)
        edge: dict[str, Any] = {"facecolor": "white", "edgecolor": "black", "linewidth": 1.2}
        axes.add_patch(Circle((0, 0), outcome.data["radius"], zorder=0.5, **edge))
        for curve in (curve for curve in outcome.data["curves"] if curve["panel"] == panel):
            learned: dict[str, Any] = {"linewidth": 1.3, "zorder": 2}
            nominal = {"linewidth": 0.8, "linestyle": (0, (4, 2)), "alpha": 0.8, "zorder": 1.5}
            style = learned if curve["kind"] == "learned" else nominal
            axes.plot(curve["x"], curve["y"], color=colors[curve["p"]], **style)
        axes.plot(*start[:2], "*", color="black", markersize=7, zorder=3)
        axes.set_title(f"({'abc'[panel]}) start ({start[0]:g}, {start[1]:g})\n{name}")
    panels[0].set_ylabel(quantity("y", "m"))
    handles = [
        Line2D(
            [], [], color=colors[p], linewidth=1.8, label=f"$p_1 = p_2 = {p:g}$ {unit_text('1/s')}"
        )
        for p in RATES
    ]
    nominal = Line2D([], [], color=QUIET, linewidth=0.8, linestyle="--", label="nominal")
    unsafe = Patch(color=UNSAFE, alpha=0.35, label="unsafe")
    add_legend(figure, [*handles, nominal, unsafe])


def _values(sample: Workload) -> dict[str, Any]:
    world = disk(sample)
    return {
        **setting_values(world, sample),
        "gains": ", ".join(f"{p:g}" for p in RATES),
        "shown": min(_SHOWN * world.dt, world.horizon),
    }


ARTEFACTS = (CHAPTER.artefact("figure-3.1", compute_disk, _values, _draw_disk),)
