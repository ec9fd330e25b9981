"""Common parts of the scenes: the states that they show, the part that is seen, and the trail."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range, nice_step
from safe_envs.rendering.canvas import Canvas, runs, thinned
from safe_envs.rendering.safe_set import Barriers, barriers_in
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

_DRAWN = 64
_HALF_POWERS = range(-16, 27)
"""Powers k of the reaches 2^(k/2), in the unit of the state, that are tried: .004 to 8192."""

_SPARE = 1.25


def first_range(problem: SafetyProblem, i: int) -> Range:
    """Return a range around the starts and the nearest edge of the safe set along a state.

    Args:
        problem: with starts and barriers.
        i: index of the state.

    Returns:
        A range with round ends.
    """
    starts = problem.starts[problem.start].proposals(_DRAWN)
    low, high, middle = float(starts[:, i].min()), float(starts[:, i].max()), starts.mean(axis=0)
    barriers = Barriers(problem)
    for power in _HALF_POWERS:
        reach = 2.0 ** (power / 2)
        ends = low - reach, high + reach
        if any(
            ends[0] < edge < ends[1]
            for safe in barriers.intervals(middle, i, *ends)
            for edge in safe
        ):
            return _rounded(low - _SPARE * reach, high + _SPARE * reach)
    return _rounded(low - 1.0, high + 1.0)


def _rounded(low: float, high: float) -> Range:
    step = nice_step(high - low, 5)
    return step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)


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
        """Draw an instant within `style.SCENE`.

        Args:
            canvas: to draw on.
            snapshot: of the episode.
        """

    def index(self, name: str) -> int:
        """Return the index of a state.

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
        """Return the unit of a state."""
        return self.problem.states[self.index(name)].unit

    def range_of(self, i: int) -> Range:
        """Return the workspace of a state, or its sampling range, or a range around the starts.

        The first of these that is finite.
        """
        state = self.problem.states[i]
        if math.isfinite(state.low) and math.isfinite(state.high):
            return state.low, state.high
        try:
            return self.problem.sampling_domain.region[i]
        except SystemDefinitionError:
            return first_range(self.problem, i)

    def window(self, i: int, j: int) -> tuple[Range, Range]:
        """Return the part of a plane to show: around the safe set if bounded, else the workspace.

        Args:
            i: index of the state to the right.
            j: index of the state upwards.

        Returns:
            The ranges of both.
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
    """Return a warning colour while the filter intervenes or has no feasible action.

    Args:
        snapshot: of the episode.
        usual: colour in other cases.

    Returns:
        The colour of what moves.
    """
    return INFEASIBLE if snapshot.infeasible else INTERVENING if snapshot.intervening else usual


def draw_trail(canvas: Canvas, axes: Axes, x: np.ndarray, y: np.ndarray, h: np.ndarray) -> None:
    """Draw where the state was: the later the darker, and in the warning colour where unsafe.

    Args:
        canvas: to draw on.
        axes: of the scene.
        x: along the axis to the right, shape (k,).
        y: along the axis upwards, shape (k,).
        h: smallest barrier there, shape (k,).
    """
    kept = thinned(len(x))
    places, unsafe = axes.places(x[kept], y[kept]), np.minimum.reduceat(h, kept) < 0.0
    with canvas.within(axes.box):
        for age, part in enumerate(np.array_split(np.arange(len(places)), _AGES), start=1):
            if part.size:
                canvas.path(
                    places[part[0] : part[-1] + 2],
                    mix(EXECUTED, mix(SKY, PAPER, 0.45), age / _AGES),
                    2,
                )
        for run in runs(unsafe):
            canvas.path(places[run], VIOLATION, 3)


def draw_violation(canvas: Canvas, axes: Axes, where: tuple[float, float]) -> None:
    """Mark the first violation.

    Args:
        canvas: to draw on.
        axes: of the scene.
        where: coordinates of the violation.
    """
    with canvas.within(axes.box):
        at = axes.place(*where)
        canvas.cross(at, 8, PAPER, 7)
        canvas.cross(at, 7, VIOLATION, 4)


def draw_point(canvas: Canvas, at: tuple[float, float], color: Color) -> None:
    """Mark the state.

    Args:
        canvas: to draw on.
        at: pixel of the state.
        color: of the mark.
    """
    canvas.disk(at, 8, PAPER)
    canvas.disk(at, 7, color, INK, 1)
