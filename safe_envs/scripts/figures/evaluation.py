"""The picture of an evaluation: h and safety rate over time, trajectories, first episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from safe_envs.agents.evaluation.evaluate import Evaluation
from safe_envs.agents.evaluation.statistics import percent
from safe_envs.agents.evaluation.table import describe_system
from safe_envs.agents.policies.names import POLICY_FILE
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.log import LogColors, LogPanels
from safe_envs.scripts.figures.style import (
    QUIET,
    STYLE,
    UNFILTERED_DASHES,
    UNSAFE,
    WARM,
    StyledFigure,
    add_legend,
    add_title,
    drawable,
    finished,
    labelled,
    look,
    mathematics,
    plain,
    quantity,
    wrapped,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

_SHOWN = 8
_GRID = 300


def draw_plane(axes: Axes, evaluation: Evaluation, looks: dict[str, dict[str, Any]]) -> None:
    """Draw trajectories of the first episodes, the same ones for every filter.

    Args:
        axes: to draw on.
        evaluation: of a problem with a plane.
        looks: colour and dashes of each filter.
    """
    problem = evaluation.problem
    names = [s.symbol.name for s in problem.states]
    units = [s.unit for s in problem.states]
    across, up = [names.index(name) for name in problem.plane or ()]
    paths = {name: each.states[:, :_SHOWN] for name, each in evaluation.trajectories.items()}
    for name, states in paths.items():
        axes.plot(states[:, :, across], states[:, :, up], **looks[name], linewidth=0.7, alpha=0.8)
    starts = next(iter(paths.values()))[0]
    axes.plot(starts[:, across], starts[:, up], "o", color="black", markersize=2.5, zorder=3)
    everywhere = np.concatenate([states.reshape(-1, problem.plant.n) for states in paths.values()])
    safe = _safe_function(problem, across, up, np.median(starts, axis=0))
    limits = _limits(safe, everywhere[:, [across, up]], alike=units[across] == units[up])
    if units[across] == units[up]:
        axes.set_aspect("equal")
    horizontal, vertical, h = _on_grid(safe, limits)
    axes.contourf(
        horizontal, vertical, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35, zorder=0
    )
    axes.contour(horizontal, vertical, h, levels=[0.0], colors="black", linewidths=0.9, zorder=1)
    axes.set(
        xlabel=quantity(names[across], units[across]),
        ylabel=quantity(names[up], units[up]),
        title=f"{_first(len(starts))}{_when(problem)}",
    )


def _first(episodes: int) -> str:
    if episodes == 1:
        return "First episode, a dot at its start"
    return f"First {episodes} episodes, dots at their starts"


def _when(problem: SafetyProblem) -> str:
    """Return a remark if the safe set in the plane changes with the other states."""
    used = set().union(*(b.expression.free_symbols for b in problem.barriers))
    return (
        "\n(safe set as at the start)" if {str(s) for s in used} - set(problem.plane or ()) else ""
    )


def _safe_function(
    problem: SafetyProblem, across: int, up: int, start: np.ndarray
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the smallest barrier over the plane, with the other states as at the start."""
    barriers = BarrierFunction(
        problem.plant.states, tuple(b.expression for b in problem.barriers), "arrays"
    )

    def smallest(horizontal: np.ndarray, vertical: np.ndarray) -> np.ndarray:
        state: list[Any] = list(start)
        state[across], state[up] = horizontal, vertical
        found = [np.broadcast_to(value, horizontal.shape) for value in barriers(*state)]
        return drawable(np.minimum.reduce(found))

    return smallest


def _on_grid(
    safe: Callable[[np.ndarray, np.ndarray], np.ndarray], limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    horizontal, vertical = np.meshgrid(*[np.linspace(low, high, _GRID) for low, high in limits])
    return horizontal, vertical, safe(horizontal, vertical)


def _limits(
    safe: Callable[[np.ndarray, np.ndarray], np.ndarray], points: np.ndarray, alike: bool
) -> np.ndarray:
    """Return limits (low, high) of both axes."""
    # They contain the trajectories, and the whole safe set if it is bounded and not far larger.
    limits = np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)], axis=1)
    width = np.maximum(limits[:, 1] - limits[:, 0], 1e-3)
    horizontal, vertical, h = _on_grid(safe, limits + np.outer(width, (-1.0, 1.0)))
    inside = h >= 0.0
    edge = inside[0].any() or inside[-1].any() or inside[:, 0].any() or inside[:, -1].any()
    if inside.any() and not edge:
        region = np.stack([horizontal[inside], vertical[inside]])
        limits = np.stack(
            [
                np.minimum(limits[:, 0], region.min(axis=1)),
                np.maximum(limits[:, 1], region.max(axis=1)),
            ],
            axis=1,
        )
    width = limits[:, 1] - limits[:, 0]
    # Equal scales fill the panel only if it shows a square.
    half = np.full(2, width.max() / 2) if alike else np.maximum(width, 1e-3) / 2
    return limits.mean(axis=1)[:, None] + 1.06 * np.outer(half, (-1.0, 1.0))


_MOST_EPISODES = {"single": 2, "double": 4}
"""Filters whose first episode is drawn, by the size of the figure."""

_EPISODE_HEIGHT = 0.85
"""In inches, of a panel of the first episodes; below are further panels."""

_BARRIER_HEIGHT, _CURVE_HEIGHT, _PLANE_HEIGHT = 2.1, 1.5, 3.3
_SIDE_HEIGHT = 3.6

_Looks = dict[str, dict[str, Any]]
"""Colour and dashes of each filter."""


def plot_evaluation(
    evaluation: Evaluation, out: Path | str | None = None, *, size: str = DEFAULT_SIZE
) -> StyledFigure:
    """Draw h and the safety rate over time, trajectories, and the first episodes.

    Args:
        evaluation: that recorded trajectories: of `evaluate(..., record=True)`.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: It recorded no trajectories, the file cannot be written, or there is no
            such size.
    """
    if not evaluation.trajectories:
        raise ConfigurationError(
            "the evaluation recorded no trajectories to draw; evaluate with record=True"
        )
    problem, config = evaluation.problem, evaluation.config
    width, looks = width_of(size), _looks(evaluation)
    with mpl.rc_context(STYLE):
        episodes = _first_episodes(evaluation, looks, _MOST_EPISODES[size])
        count = max(each.count for each in episodes.values())
        block = _EPISODE_HEIGHT * count + 0.5
        aside = bool(problem.plane) and size == "double"
        heights = [_BARRIER_HEIGHT, _CURVE_HEIGHT]
        heights += [_PLANE_HEIGHT] if problem.plane and not aside else []
        above = _SIDE_HEIGHT if aside else sum(heights)
        figure = StyledFigure(figsize=(width, above + block))
        upper, lower = figure.add_gridspec(2, 1, height_ratios=(above, block))
        grid = upper.subgridspec(len(heights), 1 + aside, height_ratios=heights)
        barrier = figure.add_subplot(grid[0, 0])
        _draw_barrier(barrier, evaluation, looks)
        _draw_curve(figure.add_subplot(grid[1, 0], sharex=barrier), evaluation, looks)
        if problem.plane:
            place = grid[:, 1] if aside else grid[2, 0]
            draw_plane(figure.add_subplot(place), evaluation, looks)
        panels = _draw_episodes(lower.subgridspec(count, len(episodes)), episodes)
        handles = barrier.get_legend_handles_labels()[0]
        unsafe = Patch(color=UNSAFE, alpha=0.35, label="unsafe")
        add_legend(figure, [*handles, unsafe, *_handles_of(evaluation, episodes, panels)])
        title = f"{evaluation.title}, {_policy_name(Path(config['policy']['name']))} policy"
        add_title(figure, f"{plain(title, 200)}\n{mathematics(describe_system(problem))}")
    return finished(figure, out)


def _first_episodes(evaluation: Evaluation, looks: _Looks, most: int) -> dict[str, LogPanels]:
    """Return the panels of the first episode under each filter, as many as fit."""
    colors = {name: look["color"] for name, look in looks.items()}
    return {
        name: LogPanels(each.log, LogColors(QUIET, colors[name], (colors[name],)))
        for name, each in list(evaluation.trajectories.items())[:most]
    }


def _draw_episodes(grid: Any, episodes: dict[str, LogPanels]) -> dict[str, list[Axes]]:
    """Draw the first episode under each filter in a column of its own, with common scales."""
    shape, h_at = grid.get_geometry(), next(iter(episodes.values())).barrier_panel
    panels = np.array([grid.figure.add_subplot(cell) for cell in grid]).reshape(shape)
    for (name, drawn), column in zip(episodes.items(), panels.T, strict=True):
        drawn.draw(list(column))
        room = grid.figure.get_figwidth() / len(episodes) - 0.4
        title = wrapped(
            grid.figure, f"{plain(name, 200)}, first episode", mpl.rcParams["axes.titlesize"], room
        )
        column[0].set_title(title)
    for i, row in enumerate(panels):
        low, high = np.transpose([panel.get_ylim() for panel in row])
        # As above, h far below 0 is cut off.
        bottom = max(low.min(), -high.max()) if i == h_at else low.min()
        for panel in row:
            panel.set_ylim(bottom, high.max())
            panel.label_outer()
    found = {name: list(column) for name, column in zip(episodes, panels.T, strict=True)}
    for name, drawn in episodes.items():
        drawn.note_cuts(found[name])
    return found


def _handles_of(
    evaluation: Evaluation, episodes: dict[str, LogPanels], panels: dict[str, list[Axes]]
) -> list[Any]:
    """Return the entries of the legend that the first episodes add to those of the filters."""
    marks: dict[str, Any] = {}
    seen: set[int] = set()
    for name, drawn in episodes.items():
        marks |= {mark.get_label(): mark for mark in drawn.handles(panels[name])}
        seen |= set(drawn.seen(panels[name]))
    barriers, grey = evaluation.problem.barriers, LogColors(barriers=(QUIET,))
    several = sorted(seen) if len(barriers) > 1 else []
    lines = grey.legend({i: plain(barriers[i].name) for i in several})
    return [*(mark for label, mark in marks.items() if "executed" not in label), *lines]


def _policy_name(path: Path) -> str:
    """Return the name of a file or folder; a file in a policy's folder is called by that."""
    return path.parent.name if path.name == POLICY_FILE else path.stem


def _looks(evaluation: Evaluation) -> _Looks:
    filters = [row.filter for row in evaluation.rows if row.kind == "filter"]
    looks = {name: look(i) for i, name in enumerate(filters)}
    unfiltered = {"color": WARM, "linestyle": UNFILTERED_DASHES}
    return {row.filter: looks.get(row.filter, unfiltered) for row in evaluation.rows}


def _faintness(evaluation: Evaluation) -> float:
    """Return the opacity of a band; many bands over each other must leave the lines seen."""
    return min(0.2, 0.6 / len(evaluation.rows))


def _draw_barrier(axes: Axes, evaluation: Evaluation, looks: _Looks) -> None:
    """Draw median and 5 to 95 % band of h, as long as half of the episodes are under way."""
    # Later quantiles would be of the survivors, and jump when one ends.
    lowest = highest = last = 0.0
    faint = _faintness(evaluation)
    for row in evaluation.rows:
        name = row.filter
        h = evaluation.trajectories[name].barrier
        h = drawable(h[np.isnan(h).mean(axis=1) <= 0.5])
        time = np.arange(len(h)) * evaluation.problem.dt
        low, median, high = np.nanquantile(h, (0.05, 0.5, 0.95), axis=1)
        color = looks[name]["color"]
        axes.fill_between(time, low, high, color=color, alpha=faint / 2, linewidth=0)
        axes.plot(time, np.stack([low, high], axis=1), color=color, linewidth=0.4, alpha=0.6)
        label = f"{plain(name, 200)}: {percent(row.safety_rate)} safe"
        axes.plot(time, median, **looks[name], linewidth=1.5, label=label)
        lowest, highest, last = (
            min(lowest, low.min()),
            max(highest, high.max()),
            max(last, time[-1]),
        )
    # Values far below 0 are cut off, so that they do not shrink the rest.
    bottom = max(lowest, -highest) if highest > 0.0 else lowest
    margin = 0.05 * max(highest - bottom, 1e-3)
    # Some of the unsafe side is always seen.
    bottom = min(bottom - margin, -2.0 * margin)
    axes.set(xlim=(0.0, max(last, evaluation.problem.dt)), ylim=(bottom, highest + margin))
    axes.axhspan(bottom, 0.0, color=UNSAFE, alpha=0.35, linewidth=0, zorder=0)
    axes.axhline(0.0, color="black", linewidth=0.9)
    axes.set(ylabel="barrier $h$", title="Median and 5 to 95 % of the episodes")


def _draw_curve(axes: Axes, evaluation: Evaluation, looks: _Looks) -> None:
    """Draw the rate of episodes that are safe so far, with its band, up to the last violation."""
    faint = _faintness(evaluation)
    for row in evaluation.rows:
        curve = row.curve
        look_of = looks[row.filter]
        low, rate, high = (100 * np.array(v) for v in (curve.ci_low, curve.rate, curve.ci_high))
        axes.fill_between(curve.time, low, high, color=look_of["color"], alpha=faint, linewidth=0)
        axes.plot(curve.time, rate, **look_of, linewidth=1.4)
        axes.set_xlim(right=max(axes.get_xlim()[1], curve.time[curve.safe.index(curve.safe[-1])]))
    lowest = min(row.curve.ci_low[-1] for row in evaluation.rows)
    bottom = 100 * lowest - 4 * (1 - lowest)
    axes.set(ylim=(bottom, 100 + 4 * (1 - lowest)), xlabel=labelled("time", "s"))
    axes.set(ylabel=labelled("safe so far", "%"))
    axes.set_title(
        f"Safe so far, with its pointwise {100 * evaluation.config['confidence']:.10g} % band"
    )
