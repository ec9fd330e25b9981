"""The safe set in a plane of two states: its edge h = 0, its inside tinted less towards the edge, its outside hatched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pygame

from safe_envs.codegen import compile_function, filled
from safe_envs.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.style import EDGE, GREEN, HATCH, PAPER, UNSAFE, mix

_CELL = 4
_RESOLUTION = 4
_NEAREST, _FURTHEST = -4, 96
_LEVELS = 4
_TINT = (0.07, 0.055)


def barriers_in(problem: SafetyProblem, states: Sequence[int]) -> list[int]:
    """Indices of the barriers that depend on none but some states."""
    allowed = {problem.plant.states[i] for i in states}
    return [k for k, b in enumerate(problem.barriers) if b.expression.free_symbols <= allowed]


class Barriers:
    """Barriers over arrays of states.

    Args:
        problem: whose barriers they are.
        chosen: indices of those that are read; None for all.
    """

    def __init__(self, problem: SafetyProblem, chosen: Sequence[int] | None = None) -> None:
        self.chosen = range(len(problem.barriers)) if chosen is None else chosen
        self._read = compile_function(problem.plant.states, [problem.barriers[k].expression for k in self.chosen], "arrays")

    def __call__(self, components: Sequence[np.ndarray | float]) -> np.ndarray:
        """Each barrier at states that broadcast against each other, with the barriers in front; NaN counts as unsafe."""
        shape = np.broadcast_shapes(*(np.shape(c) for c in components))
        with np.errstate(all="ignore"):
            values = self._read(*(np.asarray(c, dtype=float) for c in components))
        return np.nan_to_num(np.stack([filled(v, shape) for v in values]), nan=-1.0)

    def along(self, state: np.ndarray, i: int, values: np.ndarray) -> np.ndarray:
        """The smallest barrier where one state takes other values, shape (k,); of no barrier, infinite."""
        if not len(self.chosen):
            return np.full(len(values), np.inf)
        return self([values if j == i else float(v) for j, v in enumerate(state)]).min(axis=0)

    def intervals(self, state: np.ndarray, i: int, low: float, high: float) -> list[Range]:
        """Where one state may be within a range for h >= 0, the others as they are."""
        values = np.linspace(low, high, 401)
        h = self.along(state, i, values)
        safe = np.concatenate([[False], h >= 0.0, [False]])
        starts, ends = np.flatnonzero(safe[1:] & ~safe[:-1]), np.flatnonzero(safe[:-1] & ~safe[1:]) - 1
        return [(_crossing(values, h, s - 1, s), _crossing(values, h, e, e + 1)) for s, e in zip(starts, ends, strict=True)]


def _crossing(values: np.ndarray, h: np.ndarray, i: int, j: int) -> float:
    """Where h vanishes between two neighbours, or the end of the range."""
    if i < 0 or j >= len(values) or not np.isfinite(h[i] - h[j]):
        return float(values[max(i, 0) if j >= len(values) else j])
    return float(values[i] + (values[j] - values[i]) * h[i] / (h[i] - h[j]))


class SafeSet:
    """Draws the safe set onto a box of axes.

    The tint grows in steps of h/|grad h|, the distance from the edge to first order: levels of h that can be compared
    between barriers, whatever their units.

    Args:
        barriers: of the set.
        axes: where they are drawn.
        plane: indices of the states along x and y.
    """

    def __init__(self, barriers: Barriers, axes: Axes, plane: tuple[int, int]) -> None:
        self._barriers, self._plane = barriers, plane
        left, top, width, height = axes.box
        self._corner = (left, top)
        columns, rows = width // _CELL + 2, height // _CELL + 2
        right, up = axes.scale
        self._x = (axes.x[0] + np.arange(columns) * _CELL / right)[:, None]
        self._y = (axes.y[1] - np.arange(rows) * _CELL / up)[None, :]
        self._across, self._down = _between(width), _between(height)
        px, py = np.arange(width)[:, None], np.arange(height)[None, :]
        hatched = (px + py) % 10 < 2
        self._offset = np.where(hatched, _count(), 0) - _NEAREST * _RESOLUTION
        self._surface = pygame.Surface((width, height), 0, 32)
        self._colors = np.array([self._surface.map_rgb(c) for c in (*_colors(False), *_colors(True))], dtype=np.uint32)

    def draw(self, canvas: Canvas, state: np.ndarray) -> None:
        """Draw the set with all states but the two of the plane as they are."""
        x, y = self._plane
        h = self._barriers([self._x if i == x else self._y if i == y else float(v) for i, v in enumerate(state)])
        slope = np.hypot(np.gradient(h, _CELL, axis=1), np.gradient(h, _CELL, axis=2))
        distance = np.clip(h / np.maximum(slope, 1e-12), _NEAREST, _FURTHEST).min(axis=0)
        (i, v), (j, w) = self._across, self._down
        distance = distance[i] + v[:, None] * (distance[i + 1] - distance[i])
        distance = distance[:, j] + w * (distance[:, j + 1] - distance[:, j])
        pixels = pygame.surfarray.pixels2d(self._surface)
        pixels[:] = self._colors.take((distance * _RESOLUTION).astype(np.int32) + self._offset)
        del pixels
        canvas.surface.blit(self._surface, self._corner)


def _between(size: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel the knot before it, and how far it is on the way to the next one."""
    place = (np.arange(size) + 0.5) / _CELL
    return place.astype(np.intp), place % 1.0


def _count() -> int:
    return (_FURTHEST - _NEAREST) * _RESOLUTION + 1


def _colors(hatched: bool) -> list[tuple[int, int, int]]:
    """The colour of each distance from the edge, from outside to inside."""
    found = []
    for i in range(_count()):
        distance = _NEAREST + i / _RESOLUTION
        level = min(int(_LEVELS * max(distance, 0.0) / _FURTHEST), _LEVELS - 1)
        inside = mix(GREEN, PAPER, _TINT[0] + _TINT[1] * level)
        area = mix(inside, HATCH if hatched else UNSAFE, min(max(distance + 0.5, 0.0), 1.0))
        found.append(mix(EDGE, area, min(max(1.7 - abs(distance), 0.0), 1.0)))
    return found
