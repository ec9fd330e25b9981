"""The safe set in a plane of two states: its edge h = 0, a tinted inside and a hatched outside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pygame

from safe_envs.dynamics.codegen import compile_function, filled
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.style import EDGE, GREEN, HATCH, PAPER, UNSAFE, Color, mix

_CELL = 4
_RESOLUTION = 4
_NEAREST, _FURTHEST = -4, 96

LEVELS = 4
"""Number of tints of the safe set."""

STEP = _FURTHEST // LEVELS
"""Width of a tint in pixels; the innermost one has no end."""


def tint(level: int) -> Color:
    """Return the colour of the safe set between `level` and `level + 1` steps from its edge."""
    return mix(GREEN, PAPER, 0.07 + 0.055 * level)


def barriers_in(problem: SafetyProblem, states: Sequence[int]) -> list[int]:
    """Return the barriers that depend on certain states only.

    Args:
        problem: with the barriers.
        states: indices of the states.

    Returns:
        Indices of the barriers.
    """
    allowed = {problem.plant.states[i] for i in states}
    return [k for k, b in enumerate(problem.barriers) if b.expression.free_symbols <= allowed]


class Barriers:
    """Barriers over arrays of states.

    Args:
        problem: with the barriers.
        chosen: indices of those to evaluate; None for all.
    """

    def __init__(self, problem: SafetyProblem, chosen: Sequence[int] | None = None) -> None:
        self.chosen = range(len(problem.barriers)) if chosen is None else chosen
        self._read = compile_function(
            problem.plant.states, [problem.barriers[k].expression for k in self.chosen], "arrays"
        )

    def __call__(self, components: Sequence[np.ndarray | float]) -> np.ndarray:
        """Return each barrier at states that broadcast against each other; NaN counts as unsafe.

        The barriers are along the first axis.
        """
        shape = np.broadcast_shapes(*(np.shape(c) for c in components))
        with np.errstate(all="ignore"):
            values = self._read(*(np.array(c, dtype=float, ndmin=1) for c in components))
        return np.nan_to_num(np.stack([filled(v, shape) for v in values]), nan=-1.0)

    def along(self, state: np.ndarray, i: int, values: np.ndarray) -> np.ndarray:
        """Return the smallest barrier where one state takes other values.

        Args:
            state: shape (n,).
            i: index of the state that varies.
            values: of that state, shape (k,).

        Returns:
            Shape (k,); infinite if there is no barrier.
        """
        if not len(self.chosen):
            return np.full(len(values), np.inf)
        return self([values if j == i else float(v) for j, v in enumerate(state)]).min(axis=0)

    def intervals(self, state: np.ndarray, i: int, low: float, high: float) -> list[Range]:
        """Return where one state may be for h >= 0, with the others as they are.

        Args:
            state: shape (n,).
            i: index of the state that varies.
            low: end of the range that is searched.
            high: other end.

        Returns:
            The ends of each interval.
        """
        values = np.linspace(low, high, 401)
        h = self.along(state, i, values)
        safe = np.concatenate([[False], h >= 0.0, [False]])
        starts = np.flatnonzero(safe[1:] & ~safe[:-1]).tolist()
        ends = (np.flatnonzero(safe[:-1] & ~safe[1:]) - 1).tolist()
        return [
            (_crossing(values, h, s - 1, s), _crossing(values, h, e, e + 1))
            for s, e in zip(starts, ends, strict=True)
        ]


def _crossing(values: np.ndarray, h: np.ndarray, i: int, j: int) -> float:
    """Return where h vanishes between two neighbours, or the end of the range."""
    if i < 0 or j >= len(values) or not np.isfinite(h[i] - h[j]):
        return float(values[min(j, len(values) - 1)])
    return float(values[i] + (values[j] - values[i]) * h[i] / (h[i] - h[j]))


class SafeSet:
    """Draws the safe set onto a box of axes.

    The tint grows in steps of h/|grad h|, the distance from the edge to first order, which can be
    compared between barriers of different units.

    Args:
        barriers: of the set.
        axes: where they are drawn.
        plane: indices of the states along x and y; -1 for an axis of something else, such as time.
    """

    def __init__(self, barriers: Barriers, axes: Axes, plane: tuple[int, int]) -> None:
        self._barriers, self._plane = barriers, plane
        left, top, width, height = axes.box
        self._corner = (left, top)
        columns, rows = width // _CELL + 2, height // _CELL + 2
        right, up = axes.scale
        self._x = (axes.x[0] + np.arange(columns) * _CELL / right)[None, :]
        self._y = (axes.y[1] - np.arange(rows) * _CELL / up)[:, None]
        self._hatched = np.where(sum(np.ogrid[:height, :width]) % 10 < 2, _count(), 0).astype(
            np.int32
        )
        self._surface = pygame.Surface((width, height), 0, 32)
        self._colors = np.array(
            [self._surface.map_rgb(c) for c in (*_colors(False), *_colors(True))], dtype=np.uint32
        )

    def draw(self, canvas: Canvas, state: np.ndarray) -> None:
        """Draw the set, with the states outside the plane as they are.

        Args:
            canvas: to draw on.
            state: shape (n,).
        """
        x, y = self._plane
        height, width = self._hatched.shape
        h = self._barriers(
            [self._x if i == x else self._y if i == y else float(v) for i, v in enumerate(state)]
        )
        h = np.broadcast_to(h, (len(h), self._y.size, self._x.size))
        distance = np.clip(_to_edge(h), _NEAREST, _FURTHEST)
        knots = (distance - _NEAREST) * np.float32(_RESOLUTION)
        colors = _finer(_finer(knots.T).T)[:height, :width].astype(np.int32)
        colors += self._hatched
        pixels = pygame.surfarray.pixels2d(self._surface)
        pixels.T[:] = self._colors.take(colors)
        del pixels
        canvas.surface.blit(self._surface, self._corner)


def _to_edge(h: np.ndarray) -> np.ndarray:
    """Return the distance from the nearest edge in pixels, to first order."""
    down, across = np.gradient(h, _CELL, axis=(1, 2))
    slope = np.sqrt(np.maximum(down * down + across * across, 1e-24))
    return (h / slope).min(axis=0).astype(np.float32)


def _finer(knots: np.ndarray) -> np.ndarray:
    """Return values at the middles of the pixels between knots, along the last axis."""
    share = ((np.arange(_CELL) + 0.5) / _CELL).astype(np.float32)
    between = knots[:, :-1, None] + np.diff(knots)[:, :, None] * share
    return between.reshape(len(knots), -1)


def _count() -> int:
    return (_FURTHEST - _NEAREST) * _RESOLUTION + 1


def _colors(hatched: bool) -> list[Color]:
    """Return the colour of each distance from the edge, from outside to inside."""
    found = []
    for i in range(_count()):
        distance = _NEAREST + i / _RESOLUTION
        inside = tint(min(int(max(distance, 0.0) / STEP), LEVELS - 1))
        area = mix(inside, HATCH if hatched else UNSAFE, min(max(distance + 0.5, 0.0), 1.0))
        found.append(mix(EDGE, area, min(max(1.7 - abs(distance), 0.0), 1.0)))
    return found
