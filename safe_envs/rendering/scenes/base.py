"""What the scenes share: the states that they show, the part of the world that is seen, and the
trail.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.safe_set import Barriers, barriers_in
from safe_envs.rendering.scenes.ranges import first_range
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import (
    EXECUTED,
    INFEASIBLE,
    INK,
    INTERVENING,
    PAPER,
    SKY,
    VIOLATION,
    Color,
    mix,
)

_MOST_POINTS = 1000
_AGES = 12
_PADDING = 0.3


class Scene(ABC):
    """The left part of a picture.

    Args:
        problem: that is drawn. All geometry is read from it.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self.problem = problem
        self.names = [s.symbol.name for s in problem.states]

    @abstractmethod
    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw an instant within `style.SCENE`."""

    def index(self, name: str) -> int:
        """The index of a state.

        Raises:
            ConfigurationError: the problem has no such state.
        """
        if name not in self.names:
            raise ConfigurationError(
                f"the scene {self.problem.scene!r} shows a state {name!r}, and {self.problem.name}"
                f" has {', '.join(self.names)}; choose another scene"
            )
        return self.names.index(name)

    def unit(self, name: str) -> str:
        """The unit of a state."""
        return self.problem.states[self.index(name)].unit

    def range_of(self, i: int) -> Range:
        """The workspace of a state; where that has no end, the range that is explored, or else one
        around the starts.
        """
        state = self.problem.states[i]
        if math.isfinite(state.low) and math.isfinite(state.high):
            return state.low, state.high
        try:
            return self.problem.exploration.region[i]
        except SystemDefinitionError:
            return first_range(self.problem, i)

    def window(self, i: int, j: int) -> tuple[Range, Range]:
        """The part of a plane of two states to look at: around the safe set if that is bounded in
        it, else the workspace.
        """
        shown = self.range_of(i), self.range_of(j)
        chosen = barriers_in(self.problem, (i, j))
        if not chosen:
            return shown
        x, y = (np.linspace(*r, 121) for r in shown)
        components = [
            x[:, None] if k == i else y[None, :] if k == j else 0.0 for k in range(len(self.names))
        ]
        safe = np.broadcast_to(
            (Barriers(self.problem, chosen)(components) >= 0.0).all(axis=0), (len(x), len(y))
        )
        if not safe.any():
            return shown
        return _around(x[safe.any(axis=1)], shown[0]), _around(y[safe.any(axis=0)], shown[1])


def _around(values: np.ndarray, limits: Range) -> Range:
    pad = _PADDING * max(float(values[-1] - values[0]), 0.05 * (limits[1] - limits[0]))
    return max(float(values[0]) - pad, limits[0]), min(float(values[-1]) + pad, limits[1])


def warning_color(snapshot: EpisodeSnapshot, usual: Color = EXECUTED) -> Color:
    """Of what moves: a warning while the filter intervenes or has no feasible action."""
    return INFEASIBLE if snapshot.infeasible else INTERVENING if snapshot.intervening else usual


def draw_trail(canvas: Canvas, axes: Axes, x: np.ndarray, y: np.ndarray, h: np.ndarray) -> None:
    """Draw where the state was, the darker the later, and in the warning colour where it was not
    safe.

    Args:
        canvas: to draw on.
        axes: of the scene.
        x: along the axis to the right, shape (k,).
        y: along the axis upwards, shape (k,).
        h: smallest barrier there, shape (k,).
    """
    kept = thinned(len(x))
    places, unsafe = axes.places(x[kept], y[kept]), np.minimum.reduceat(h, kept) < 0.0
    canvas.within(axes.box)
    for age, part in enumerate(np.array_split(np.arange(len(places)), _AGES), start=1):
        if part.size:
            canvas.path(
                places[part[0] : part[-1] + 2], mix(EXECUTED, mix(SKY, PAPER, 0.45), age / _AGES), 2
            )
    for run in runs(unsafe):
        canvas.path(places[run], VIOLATION, 3)
    canvas.within(None)


def thinned(count: int, most: int = _MOST_POINTS) -> np.ndarray:
    """Indices of the points of a trail that are drawn: at most so many, the last one among them."""
    # A power of two: points once drawn stay as the trail grows.
    stride = 1 << max(0, (count - 1) // most).bit_length()
    kept = np.arange(0, count, stride)
    return kept if kept[-1] == count - 1 else np.append(kept, count - 1)


def runs(flags: np.ndarray) -> list[slice]:
    """Where flags are set, with a point before, so that short runs are lines too."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [slice(max(int(a) - 1, 0), int(b)) for a, b in edges.reshape(-1, 2)]


def draw_violation(canvas: Canvas, axes: Axes, where: tuple[float, float]) -> None:
    """Mark where the first violation was."""
    canvas.within(axes.box)
    at = axes.place(*where)
    canvas.cross(at, 8, PAPER, 7)
    canvas.cross(at, 7, VIOLATION, 4)
    canvas.within(None)


def draw_point(canvas: Canvas, at: tuple[float, float], color: Color) -> None:
    """Mark the state."""
    canvas.disk(at, 8, PAPER)
    canvas.disk(at, 7, color, INK, 1)
