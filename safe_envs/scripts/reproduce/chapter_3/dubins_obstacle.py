"""Figure 3.2: a Dubins vehicle of unknown speed on its way past a moving obstacle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import labelled, quantity
from safe_envs.scripts.figures.style import COLORS, HALO, QUIET, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_3 import learned_runs
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.drawing import SHADED, draw_lines

_SETTINGS = learned_runs.CHAPTER.settings["obstacle"]
OBSTACLE, OBSTACLE_RATES, SPEED = (_SETTINGS[name] for name in ("env", "rates", "speed"))
OBSTACLE_RADIUS, GOAL, GOAL_RADIUS = (
    _SETTINGS[name] for name in ("obstacle_radius", "goal", "goal_radius")
)
AT_REST = "a model that takes the obstacle for at rest, as the printed derivatives do"
_ROUNDING = 1e-9  # m/s


@lru_cache(maxsize=2)
def passages(sample: Workload, **model: float) -> dict[str, list[learned_runs.Trajectory]]:
    """Return the trajectories around the obstacle.

    Args:
        sample: how much is learned.
        model: parameters of the model.
    """
    problem = make_problem(OBSTACLE, start="thesis", model=model or None)
    return learned_runs.trajectories(
        problem, OBSTACLE_RATES, learned_runs.residuals(OBSTACLE, sample, **model)
    )


def compute_passage(sample: Workload) -> Findings:
    """Compute the paths around the obstacle."""
    found, problem = passages(sample), make_problem(OBSTACLE)
    learned, none = found["learned"], found["none"][0]
    times = [run.steps * problem.dt for run in learned]
    return Findings(
        numbers=[
            Number.mean("path, learned", _paths(learned), "m", 0.0),
            *(
                Number(f"path, {kind}", _paths(found[kind])[0], unit="m")
                for kind in ("nominal", "true", "none")
            ),
            Number.mean("time to the goal, learned", times, "s", 0.0),
            Number("time to the goal, none", none.steps * problem.dt, unit="s"),
            Number("lowest speed, learned", float(_speeds(learned, problem.dt).min()), unit="m/s"),
            *learned_runs.rates_around(
                problem, sample, learned_runs.residuals(OBSTACLE, sample), OBSTACLE_RATES
            ),
        ],
        claims=passage_claims(found, problem),
        data={
            kind: {
                name: learned_runs.thinned(found[kind][0].states[:, column])
                for column, name in enumerate(("x", "y"))
            }
            for kind in ("learned", "nominal")
        }
        | {"instants": [_at(learned[0], time, problem.dt) for time in _SETTINGS["pauses"]]},
    )


def passage_claims(found: learned_runs.Trajectories, problem: SafetyProblem) -> list[Claim]:
    """Return the claims of the text about the path, and why it takes longer.

    Args:
        found: all trajectories.
        problem: of them.
    """
    learned, unfiltered = found["learned"], _paths(found["none"])[0]
    lengths, miss = _paths(learned), max(map(_miss, learned))
    lowest, nominal = min(run.smallest for run in learned), found["nominal"][0].smallest
    longer = min(lengths) > unfiltered and not any(_slows(run, problem) for run in learned)
    paths = {"shortest": min(lengths), "longest": max(lengths), "unfiltered": unfiltered}
    claim = partial(learned_runs.CHAPTER.claim, "figure-3.2a")
    return [
        claim("avoids", lowest > 0, h=lowest),
        claim("arrives", miss <= GOAL_RADIUS, miss=miss),
        claim("collides", nominal < 0, h=nominal),
        claim("longer", longer, speeds=_describe_speeds(learned, problem), **paths),
    ]


def _paths(each: Sequence[learned_runs.Trajectory]) -> list[float]:
    return [float(run.lengths.sum()) for run in each]


def _miss(run: learned_runs.Trajectory) -> float:
    """Return how far from the goal's centre a run ends, in m."""
    return math.dist(run.states[-1, :2], GOAL)


def _speeds(each: Sequence[learned_runs.Trajectory], dt: float) -> np.ndarray:
    """Return the distance between control instants over the period, in m/s, for all periods."""
    return np.concatenate([run.lengths for run in each]) / dt


def _chord_speed(problem: SafetyProblem) -> float:
    """Return the apparent speed in the sharpest turn, in m/s: a chord is shorter than its arc."""
    return float(SPEED * np.sinc(problem.box[0][1] * problem.dt / (2 * math.pi)))


def _slows(run: learned_runs.Trajectory, problem: SafetyProblem) -> bool:
    """Return whether a run has a period that is slower than a turn explains."""
    return bool(_speeds([run], problem.dt).min() < _chord_speed(problem) - _ROUNDING)


def _describe_speeds(each: Sequence[learned_runs.Trajectory], problem: SafetyProblem) -> str:
    speeds = _speeds(each, problem.dt)
    return (
        f"speed {speeds.min():.4f} to {speeds.max():.4f} m/s, of which a chord of the sharpest turn"
        f" has {_chord_speed(problem):.4f}"
    )


def _at(run: learned_runs.Trajectory, time: float, dt: float) -> dict[str, Any]:
    """Return where vehicle and obstacle are at an instant, or at the end before it."""
    x, y, _, x_o, y_o = run.states[min(round(time / dt), run.steps)].tolist()
    return {"time": time, "vehicle": [x, y], "obstacle": [x_o, y_o]}


def compute_clearance(sample: Workload) -> Findings:
    """Compute the barrier on the way around the obstacle."""
    found, at_rest, problem = passages(sample), passages(sample, v_o=0.0), make_problem(OBSTACLE)
    true_speed = make_problem(OBSTACLE, start="thesis", model={"v": SPEED, "v_o": 0.0})
    blind = learned_runs.runs(true_speed, [f"hocbf:p={OBSTACLE_RATES}"])[0]
    shown = {**{kind: run for kind, (run, *_) in found.items()}, "printed": blind}
    note = partial(learned_runs.CHAPTER.note, "figure-3.2b")
    return Findings(
        numbers=_clearance_numbers(found),
        claims=clearance_claims(found, problem),
        alternative_settings={
            AT_REST: Findings(_clearance_numbers(at_rest), _printed(at_rest, problem))
        },
        printed_formula=[
            Number("smallest h, nominal", at_rest["nominal"][0].smallest, unit="m^2"),
            Number("smallest h, true", blind.smallest, unit="m^2"),
        ],
        data={kind: run.over_time(problem.dt, h=run.h) for kind, run in shown.items()},
        notes=[
            note("blind", blind=blind.smallest, true=found["true"][0].smallest),
            note("held", here=_held(found, problem), there=_held(at_rest, problem), other=AT_REST),
        ],
    )


def clearance_claims(found: learned_runs.Trajectories, problem: SafetyProblem) -> list[Claim]:
    """Return the claims of the text about the barrier, and its reason for the number of steps.

    Args:
        found: all trajectories.
        problem: of them.
    """
    learned, nominal, none = found["learned"], found["nominal"][0], found["none"][0]
    steps, lowest = [run.steps for run in learned], min(run.smallest for run in learned)
    counts = {"least": min(steps), "most": max(steps), "nominal": nominal.steps, "none": none.steps}
    misses = max(map(_miss, learned)), _miss(nominal), _miss(none)
    slows = all(_slows(run, problem) for run in learned)
    claim = partial(learned_runs.CHAPTER.claim, "figure-3.2b")
    return [
        claim("positive", lowest > 0, h=lowest),
        claim("negative", nominal.smallest < 0, h=nominal.smallest),
        claim("steps", min(steps) > nominal.steps, misses=misses, **counts),
        claim("slows", slows, speeds=_describe_speeds(learned, problem)),
    ]


def _printed(found: learned_runs.Trajectories, problem: SafetyProblem) -> list[Claim]:
    return [claim for claim in clearance_claims(found, problem) if claim.printed]


def _held(found: learned_runs.Trajectories, problem: SafetyProblem) -> str:
    claims = _printed(found, problem)
    return f"{sum(claim.holds for claim in claims)} of {len(claims)}"


def _clearance_numbers(found: learned_runs.Trajectories) -> list[Number]:
    steps = [float(run.steps) for run in found["learned"]]
    return [
        *learned_runs.smallest_numbers(found, "m^2"),
        Number.mean("time steps, learned", steps, "", 0.0),
        Number("time steps, nominal", float(found["nominal"][0].steps)),
    ]


def _draw_passage(figure: Figure, outcome: Findings) -> None:
    """Draw the paths past the obstacle, with both at three instants."""
    axes, shade = figure.add_subplot(), {"alpha": 0.45, "linewidth": 0}
    axes.add_patch(Circle(GOAL, GOAL_RADIUS, facecolor="#56B4E9", **shade))
    axes.text(GOAL[0] - 0.4, GOAL[1], "goal", ha="right", va="center", color=QUIET)
    lines = (
        ("nominal", learned_runs.NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("learned", learned_runs.LEARNED_COLOR, "-", 1.8, "learned derivatives"),
    )
    draw_lines(axes, outcome.data, lines, "x", "y")
    for instant, color in zip(
        outcome.data["instants"], (COLORS[2], "black", COLORS[1]), strict=True
    ):
        at, label = instant["obstacle"], f"{instant['time']:g} s"
        edge = {"fill": False, "edgecolor": color, "linewidth": 1.5}
        axes.add_patch(Circle(at, OBSTACLE_RADIUS, facecolor=UNSAFE, zorder=0, **shade))
        axes.add_patch(Circle(at, OBSTACLE_RADIUS, **edge))
        above = at[1] + OBSTACLE_RADIUS + 0.1
        axes.text(at[0], above, label, ha="center", color="black", path_effects=HALO)
        star: dict[str, Any] = {"color": color, "markersize": 8, "zorder": 3}
        axes.plot(*instant["vehicle"], "*", label=f"learned, $t$ = {label}", **star)
    axes.set(aspect="equal", xlim=(-2.4, 5.2), ylim=(-2.4, 2.2))
    axes.set(xlabel=quantity("x", "m"), ylabel=quantity("y", "m"))
    add_legend(figure, axes.get_legend_handles_labels()[0])


def _draw_clearance(figure: Figure, outcome: Findings) -> None:
    """Draw the barrier over time."""
    axes = figure.add_subplot()
    lines = (
        ("learned", learned_runs.LEARNED_COLOR, "-", 1.8, "learned derivatives"),
        ("nominal", learned_runs.NOMINAL_COLOR, "--", 1.8, "nominal derivatives"),
        ("true", learned_runs.TRUE_COLOR, "-.", 1.8, "true derivatives"),
        ("printed", learned_runs.PRINTED_COLOR, ":", 1.8, "true speed, printed derivatives"),
    )
    draw_lines(axes, outcome.data, lines, "time", "h")
    curves = [outcome.data[kind] for kind, *_ in lines]
    lowest, last = min(min(c["h"]) for c in curves), max(c["time"][-1] for c in curves)
    # The fall from the far start would flatten what matters.
    bottom = min(lowest, 0.0) - 0.15
    axes.set(xlim=(0.0, last), ylim=(bottom, 2.5), xlabel=labelled("time", "s"))
    axes.set_ylabel(labelled("barrier $h$", "m^2"))
    axes.axhspan(bottom, 0.0, label="collision", **SHADED)
    axes.axhline(0.0, color="black", linewidth=1.2)
    add_legend(figure, axes.get_legend_handles_labels()[0])


def _values(sample: Workload) -> dict[str, Any]:
    return learned_runs.setting_values(make_problem(OBSTACLE), sample)


ARTEFACTS = (
    learned_runs.CHAPTER.artefact("figure-3.2a", compute_passage, _values, _draw_passage),
    learned_runs.CHAPTER.artefact("figure-3.2b", compute_clearance, _values, _draw_clearance),
)
