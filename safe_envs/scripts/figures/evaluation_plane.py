"""The plane of an evaluation: the safe set and the trajectories of the first episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.labels import quantity
from safe_envs.scripts.figures.style import UNSAFE, drawable

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
