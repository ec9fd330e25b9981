"""Thesis Sec. 4.3.1: what SRCBF and SCBF cost in adaptive cruise control (Figure 4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_envs.agents import NominalController
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS, QUIET, add_legend
from safe_envs.scripts.reproduce.chapter_4 import cruise_setting as car
from safe_envs.scripts.reproduce.chapter_4.effort_claims import (
    DISTANCES,
    EffortRecord,
    EffortRecords,
    outcome_of,
)
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload
from safe_envs.scripts.reproduce.framework.drawing import SHADED, draw_interval
from safe_envs.scripts.reproduce.framework.episodes import periods
from safe_envs.wrappers import SafetyFilter, parse_conditions

NEAR = 20.0  # speed of both cars at which the force is shown against h, in m/s
_BLOCK = 10  # control instants of which the figure shows the largest effort


def run(setting: car.CruiseSettings, text: str, episodes: int, seed: int) -> EffortRecord:
    """Return what a filter over the goal's controller does.

    Args:
        setting: of the car.
        text: of the condition.
        episodes: how many.
        seed: of all of them.
    """
    problem = setting.problem(car.UNBOUNDED)
    effort, acting, barrier = (np.full((problem.steps, episodes), np.nan) for _ in range(3))
    safe = np.ones(episodes, dtype=bool)
    for k, period in enumerate(periods(problem, text, "nominal", range(episodes), seed)):
        safe &= period.before > 0.0
        counts = safe & period.running
        square = period.info["safe_action"][:, 0] ** 2
        np.copyto(effort[k], square, where=counts)
        np.copyto(acting[k], square, where=counts & period.info["intervention"])
        np.copyto(barrier[k], period.before, where=counts)
    return EffortRecord(effort, acting, barrier)


def needed(setting: car.CruiseSettings, text: str) -> np.ndarray:
    """Return the force that a condition needs at equal speeds, at each of `DISTANCES`, in N.

    Args:
        setting: of the car.
        text: of the condition.
    """
    problem = setting.problem(car.UNBOUNDED)
    speed = np.full_like(DISTANCES, NEAR)
    states = np.stack([speed, speed, setting.tau * NEAR + DISTANCES], axis=1)
    wanted = NominalController(problem).predict(states)[0] * car.UNBOUNDED
    answer = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    return answer.filter(states, wanted).action[:, 0]


def compute_figure(sample: Workload) -> Findings:
    """Compute the effort over time, and against the distance to the edge."""
    episodes = sample.size(car.EPISODES)
    runs, forces = simulated(car.ASSUMED, episodes, sample.seed)
    others = {
        car.BY_PRINTED_QP: car.PRINTED_QP,
        "the goal, tau and gamma that we fitted to Table 4.1, not to this figure": car.FITTED,
    }
    return replace(
        outcome_of(runs, forces),
        alternative_settings={
            name: _printed_claims(outcome_of(*simulated(setting, episodes, sample.seed)))
            for name, setting in others.items()
        },
        data={
            "time": (np.arange(len(runs["SCBF"].effort) // _BLOCK) * _BLOCK * car.STEP).tolist(),
            "h": DISTANCES.tolist(),
            "effort": {name: _bands(r.effort) for name, r in runs.items()},
            "forces": {name: values.tolist() for name, values in forces.items()},
        },
        notes=[_strict_note(), _ends_note(runs)],
    )


def _printed_claims(outcome: Findings) -> Findings:
    return replace(outcome, claims=[claim for claim in outcome.claims if claim.printed])


def simulated(
    setting: car.CruiseSettings, episodes: int, seed: int
) -> tuple[EffortRecords, Mapping[str, np.ndarray]]:
    """Return runs of both conditions, and the forces that they need at the edge.

    Args:
        setting: of the car.
        episodes: how many.
        seed: of all of them.
    """
    runs = {name: run(setting, text, episodes, seed) for name, text in setting.filters.items()}
    return runs, {name: needed(setting, text) for name, text in setting.filters.items()}


def _strict_note() -> str:
    settings = {"assumed": car.ASSUMED, "fitted": car.FITTED}
    return car.CHAPTER.note("figure-4.1", "strict", goal=car.FITTED_GOAL, **settings)


def _ends_note(runs: EffortRecords) -> str:
    running = ", ".join(
        f"{name} {np.isfinite(r.effort[-1]).sum()} of {r.effort.shape[1]}"
        for name, r in runs.items()
    )
    first, other = (float(np.median(runs[name].effort[0])) for name in ("SRCBF", "SCBF"))
    return car.CHAPTER.note("figure-4.1", "ends", running=running, first=first, other=other)


def _bands(effort: np.ndarray) -> list[list[float]]:
    """Return quantiles over running episodes of the largest effort in a block, at least 1 N^2."""
    blocks = effort[: len(effort) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, effort.shape[1])
    largest = np.nan_to_num(blocks, nan=-1.0).max(axis=1)
    largest[largest < 0.0] = np.nan
    largest[~np.isfinite(largest).any(axis=1)] = 1.0
    return np.maximum(np.nanquantile(largest, (0.05, 0.5, 0.95), axis=1), 1.0).tolist()


def _draw_figure(figure: Figure, outcome: Findings) -> None:
    """Draw the effort over time, and against h with the edge at the left."""
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    data = outcome.data
    for name, color in {"SRCBF": COLORS[3], "SCBF": COLORS[0]}.items():
        label = f"{name}: median, and 5 to 95 %"
        ends = np.array(data["effort"][name])
        draw_interval(left, data["time"], ends, color, 0.2, linewidth=1.3, label=label)
        right.plot(data["h"], np.square(data["forces"][name]), color=color, linewidth=1.5)
    for axes, label in ((left, r"$|u| = 0.3\,M g$"), (right, None)):
        axes.axhline(car.ASSUMED.limit**2, color=QUIET, linestyle=":", label=label)
    labels: dict[str, Any] = {"xlabel": labelled("time", "s")}
    left.set_ylabel(labelled("effort $J = u^2$", "N^2"))
    left.set(yscale="log", xlim=(0, car.HORIZON), title="(a)", **labels)
    right.set(xscale="log", yscale="log", xlim=(DISTANCES[0], DISTANCES[-1]), title="(b)")
    right.set_xlabel(f"{labelled('barrier $h$', 'm')}, edge at the left")
    _mark_step(right)
    handles = [each for axes in (left, right) for each in axes.get_legend_handles_labels()[0]]
    add_legend(figure, handles)


def _mark_step(axes: Axes) -> None:
    """Shade the distances that the noise of one control period crosses."""
    end = car.ASSUMED.tau * car.NOISE * math.sqrt(car.STEP)
    axes.axvspan(DISTANCES[0], end, label="within the noise of one step", **SHADED)


ARTEFACTS = (
    car.CHAPTER.artefact(
        "figure-4.1",
        compute_figure,
        lambda sample: car.setting_values(sample, car.STEP),
        _draw_figure,
    ),
)
