"""The picture of an evaluation: h and safety rate over time, trajectories, first episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.policies.names import POLICY_FILE
from safe_envs.atomic_io import write_atomically
from safe_envs.dynamics.codegen import compile_function
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.log_panels import LogColors, LogPanels, plain
from safe_envs.scripts.figures.style import COLORS, QUIET, STYLE, UNSAFE, WARM, add_legend
from safe_envs.scripts.reports.evaluation_report import describe_system

_SHOWN = 8
_MOST_EPISODES = 4
_EPISODE_HEIGHT = 1.2
"""In inches, of a panel of the first episodes."""

_GRID = 300


def draw(evaluation: Evaluation, path: Path) -> None:
    """Draw an evaluation that recorded trajectories, and write the picture whole or not at all.

    Args:
        evaluation: to draw.
        path: of the picture; its suffix is the format.
    """
    problem, config = evaluation.problem, evaluation.config
    colors = _colors(evaluation)
    with mpl.rc_context(STYLE):
        episodes = _first_episodes(evaluation, colors)
        count = max(each.count for each in episodes.values())
        block = _EPISODE_HEIGHT * count + 0.6
        figure = Figure(figsize=(11.5 if problem.plane else 7.5, 6.6 + block))
        upper, lower = figure.add_gridspec(2, 1, height_ratios=(6.6, block))
        grid = upper.subgridspec(2, 2 if problem.plane else 1, height_ratios=(3, 2))
        barrier = figure.add_subplot(grid[0, 0])
        _draw_barrier(barrier, evaluation, colors)
        _draw_curve(figure.add_subplot(grid[1, 0], sharex=barrier), evaluation, colors)
        if problem.plane:
            _draw_plane(figure.add_subplot(grid[:, 1]), evaluation, colors)
        panels = _draw_episodes(lower.subgridspec(count, len(episodes)), episodes)
        handles = barrier.get_legend_handles_labels()[0]
        add_legend(figure, [*handles, *_handles_of(evaluation, episodes, panels)])
        title = f"{evaluation.title}, {_policy_name(Path(config['policy']['name']))} policy"
        figure.suptitle(f"{title}\n{describe_system(problem)}", fontsize=11)
        write_atomically(path, lambda part: figure.savefig(part, dpi=150))


def _first_episodes(evaluation: Evaluation, colors: dict[str, str]) -> dict[str, LogPanels]:
    """Return the panels of the first episode under each filter, as many as fit."""
    return {
        name: LogPanels(each.log, LogColors(QUIET, colors[name], (colors[name],)))
        for name, each in list(evaluation.trajectories.items())[:_MOST_EPISODES]
    }


def _draw_episodes(grid: Any, episodes: dict[str, LogPanels]) -> dict[str, list[Axes]]:
    """Draw the first episode under each filter in a column of its own, with common scales.

    Args:
        grid: for the panels.
        episodes: by filter.

    Returns:
        The panels, by filter.
    """
    shape, h_at = grid.get_geometry(), next(iter(episodes.values())).barrier_panel
    panels = np.array([grid.figure.add_subplot(cell) for cell in grid]).reshape(shape)
    for (name, drawn), column in zip(episodes.items(), panels.T, strict=True):
        drawn.draw(list(column))
        column[0].set_title(f"{name}, first episode")
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
    """Return the entries of the legend that the first episodes add to those of the filters.

    Args:
        evaluation: with the barriers.
        episodes: by filter.
        panels: of each.
    """
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


def _colors(evaluation: Evaluation) -> dict[str, str]:
    others = [row.filter for row in evaluation.rows if row.filter != UNFILTERED]
    return {UNFILTERED: WARM} | {name: COLORS[i % len(COLORS)] for i, name in enumerate(others)}


def _draw_barrier(axes: Axes, evaluation: Evaluation, colors: dict[str, str]) -> None:
    """Draw median and 5 to 95 % band of h, as long as half of the episodes are under way.

    Later quantiles would be of the survivors, and jump when one ends.
    """
    lowest = highest = last = 0.0
    for row in evaluation.rows:
        name = row.filter
        h = evaluation.trajectories[name].barrier
        h = h[np.isfinite(h).mean(axis=1) >= 0.5]
        time = np.arange(len(h)) * evaluation.problem.dt
        low, median, high = np.nanquantile(h, (0.05, 0.5, 0.95), axis=1)
        axes.fill_between(time, low, high, color=colors[name], alpha=0.09, linewidth=0)
        axes.plot(time, np.stack([low, high], axis=1), color=colors[name], linewidth=0.6, alpha=0.6)
        axes.plot(
            time,
            median,
            color=colors[name],
            linewidth=2.2,
            label=f"{name}: {percent(row.safety_rate)} safe",
        )
        lowest, highest, last = (
            min(lowest, low.min()),
            max(highest, high.max()),
            max(last, time[-1]),
        )
    # Values far below 0 are cut off, so that they do not shrink the rest.
    bottom = max(lowest, -highest) if highest > 0.0 else lowest
    margin = 0.05 * max(highest - bottom, 1e-3)
    # The unsafe side always has room for its name.
    bottom = min(bottom - margin, -2.0 * margin)
    axes.set(xlim=(0.0, max(last, evaluation.problem.dt)), ylim=(bottom, highest + margin))
    axes.axhspan(bottom, 0.0, color=UNSAFE, alpha=0.35, linewidth=0, zorder=0)
    axes.axhline(0.0, color="black", linewidth=1.2)
    axes.text(0.99, 0.02, "unsafe", transform=axes.transAxes, ha="right", va="bottom", color=QUIET)
    axes.set(ylabel="barrier h", title="Barrier: median, and 5 to 95 % of the episodes")


def _draw_curve(axes: Axes, evaluation: Evaluation, colors: dict[str, str]) -> None:
    """Draw the rate of episodes that are safe so far, with its band, up to the last violation."""
    for row in evaluation.rows:
        curve, color = row.curve, colors[row.filter]
        low, rate, high = (100 * np.array(v) for v in (curve.ci_low, curve.rate, curve.ci_high))
        axes.fill_between(curve.time, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(curve.time, rate, color=color, linewidth=1.8)
        axes.set_xlim(right=max(axes.get_xlim()[1], curve.time[curve.safe.index(curve.safe[-1])]))
    lowest = min(row.curve.ci_low[-1] for row in evaluation.rows)
    bottom = 100 * lowest - 4 * (1 - lowest)
    axes.set(ylim=(bottom, 100 + 4 * (1 - lowest)), xlabel="time (s)", ylabel="safe so far (%)")
    axes.set_title(
        f"Safety rate, with its pointwise {100 * evaluation.config['confidence']:.10g} % band"
    )


def _draw_plane(axes: Axes, evaluation: Evaluation, colors: dict[str, str]) -> None:
    """Draw trajectories of the first episodes, the same ones for every filter."""
    problem = evaluation.problem
    names = [s.symbol.name for s in problem.states]
    units = [s.unit for s in problem.states]
    across, up = [names.index(name) for name in problem.plane or ()]
    paths = {name: each.states[:, :_SHOWN] for name, each in evaluation.trajectories.items()}
    for name, states in paths.items():
        axes.plot(
            states[:, :, across], states[:, :, up], color=colors[name], linewidth=0.9, alpha=0.8
        )
    starts = next(iter(paths.values()))[0]
    axes.plot(starts[:, across], starts[:, up], "o", color="black", markersize=3.5, zorder=3)
    everywhere = np.concatenate([states.reshape(-1, problem.plant.n) for states in paths.values()])
    safe = _safe_function(problem, across, up, np.median(starts, axis=0))
    limits = _limits(safe, everywhere[:, [across, up]], alike=units[across] == units[up])
    if units[across] == units[up]:
        axes.set_aspect("equal")
    horizontal, vertical, h = _on_grid(safe, limits)
    axes.contourf(
        horizontal, vertical, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35, zorder=0
    )
    axes.contour(horizontal, vertical, h, levels=[0.0], colors="black", linewidths=1.2, zorder=1)
    labels = [f"{names[i]} ({units[i]})" if units[i] else names[i] for i in (across, up)]
    axes.set(
        xlabel=labels[0],
        ylabel=labels[1],
        title=f"Safe set{_when(problem)} and {len(starts)} episodes, dots at their starts",
    )


def _when(problem: SafetyProblem) -> str:
    """Return a remark if the safe set in the plane changes with the other states."""
    used = set().union(*(b.expression.free_symbols for b in problem.barriers))
    return " (at the start)" if {str(s) for s in used} - set(problem.plane or ()) else ""


def _safe_function(
    problem: SafetyProblem, across: int, up: int, start: np.ndarray
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the smallest barrier over the plane, with the other states as at the start."""
    barriers = compile_function(
        problem.plant.states, tuple(b.expression for b in problem.barriers), "arrays"
    )

    def smallest(horizontal: np.ndarray, vertical: np.ndarray) -> np.ndarray:
        state: list[Any] = list(start)
        state[across], state[up] = horizontal, vertical
        return np.minimum.reduce(
            [np.broadcast_to(value, horizontal.shape) for value in barriers(*state)]
        )

    return smallest


def _on_grid(
    safe: Callable[[np.ndarray, np.ndarray], np.ndarray], limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    horizontal, vertical = np.meshgrid(*[np.linspace(low, high, _GRID) for low, high in limits])
    return horizontal, vertical, safe(horizontal, vertical)


def _limits(
    safe: Callable[[np.ndarray, np.ndarray], np.ndarray], points: np.ndarray, alike: bool
) -> np.ndarray:
    """Return limits (low, high) of both axes.

    They contain the trajectories, and the whole safe set if it is bounded and not far larger.
    """
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
