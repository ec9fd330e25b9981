"""Which cells of a grid lie in the safe set, the workspace and the goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.value.grid import Axis, Grid
from safe_envs.wrappers.value.reduction import Coordinate, ReducedProblem

_HALVINGS = 2
"""Of cells that the edge of a set seems to cross: natural interval extensions are too wide."""

_SCAN = {1: 4096, 2: 256, 3: 48, 4: 20}
"""Cells along each coordinate that are looked at to find where the safe set ends."""

_LOOKS = 3

_SHARP = 1e-9
"""Of the extent of the safe set: how narrow the intervals are in which it ends."""

_AT_ONCE = 1_000_000

_SKIN = 1e-7
"""Of the width of a cell, and of the h in it."""

_ROUNDING = 1e-12
"""Of the distance to the edge of the workspace, on which edges of cells lie."""

_TINY = 1e-300
"""Farther out of the workspace is no rounding of an exact difference."""


class CellSets(NamedTuple):
    """For each cell of a grid, what it lies in; boolean arrays (cells,).

    Attributes:
        inside: wholly in the safe set and in the workspace.
        touches: in part at least.
        ends: wholly in the goal.
        may_end: in part at least.
    """

    inside: np.ndarray
    touches: np.ndarray
    ends: np.ndarray
    may_end: np.ndarray


class Sets:
    """The sets of a reduced problem as functions of boxes of its coordinates.

    Args:
        reduced: the problem.
        leaving: see `ValueSettings`.
    """

    def __init__(self, reduced: ReducedProblem, leaving: str) -> None:
        self._known = tuple(reduced.known.values())
        self._substeps = reduced.substeps
        symbols = (*(c.symbol for c in reduced.coordinates), *reduced.known)
        goal = () if reduced.goal is None else (reduced.goal,)
        self._barriers = len(reduced.barriers)
        self._stays = leaving == "violation"
        self._function = interval_function(symbols, (*reduced.barriers, reduced.outside, *goal))
        used = set().union(*(e.free_symbols for e in (*reduced.barriers, *goal)))
        self.depend_on_time = bool(used & set(reduced.known))

    def of_cells(self, grid: Grid, k: int) -> CellSets:
        """Classify the cells of a grid.

        Args:
            grid: of the coordinates.
            k: control instant.

        Returns:
            What each cell lies in.
        """
        parts = []
        for first in range(0, grid.cells, _AT_ONCE):
            cells = np.arange(first, min(first + _AT_ONCE, grid.cells))
            parts.append(self._classified(*grid.corners(cells), k, _HALVINGS))
        return CellSets(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def of_states(self, k: np.ndarray, q: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return whether states are in the safe set, and whether the episode ends in them.

        Args:
            k: control instants, int array (B,).
            q: their coordinates, arrays (B,).
        """
        known = [values[np.asarray(k) * self._substeps] for values in self._known]
        values = self._function([*q, *known])
        shape = np.shape(q[0])
        inside, ends = np.ones(shape, dtype=bool), np.zeros(shape, dtype=bool)
        for h in values[: self._barriers]:
            inside &= h.low > 0.0
        outside = values[self._barriers]
        if self._stays:
            inside &= outside.high <= _TINY
        else:
            ends |= outside.low > 0.0
        for goal in values[self._barriers + 1 :]:
            ends |= goal.low >= 0.0
        return inside, ends

    def may_hold(self, k: np.ndarray, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return whether states are in the safe set, or too close to its edge to tell.

        Args:
            k: control instants, int array (B,).
            q: their coordinates, arrays (B,).
        """
        known = [values[np.asarray(k) * self._substeps] for values in self._known]
        values = self._function([*q, *known])
        found = np.ones(np.shape(q[0]), dtype=bool)
        for h in values[: self._barriers]:
            found &= h.high >= 0.0
        if self._stays:
            found &= values[self._barriers].low <= 0.0
        return found

    def _classified(
        self, low: Sequence[np.ndarray], high: Sequence[np.ndarray], k: int, halvings: int
    ) -> CellSets:
        found = self._evaluated(low, high, k)
        unclear = np.flatnonzero((found.inside != found.touches) | (found.ends != found.may_end))
        if not halvings or not unclear.size:
            return found
        boxes = [a[unclear] for a in low], [b[unclear] for b in high]
        halves = [
            self._classified(*halved(*boxes, i), k, halvings - 1) for i in range(2 ** len(low))
        ]
        for wholly, partly in (("inside", "touches"), ("ends", "may_end")):
            getattr(found, wholly)[unclear] = np.logical_and.reduce(
                [getattr(each, wholly) for each in halves]
            )
            getattr(found, partly)[unclear] = np.logical_or.reduce(
                [getattr(each, partly) for each in halves]
            )
        return found

    def _evaluated(self, low: Sequence[np.ndarray], high: Sequence[np.ndarray], k: int) -> CellSets:
        boxes = [Interval(a, b) for a, b in zip(low, high, strict=True)]
        known = [float(values[k * self._substeps]) for values in self._known]
        values = self._function([*boxes, *known])
        barriers, outside, goal = (
            values[: self._barriers],
            values[self._barriers],
            values[self._barriers + 1 :],
        )
        shape = low[0].shape
        found = CellSets(*(np.full(shape, given) for given in (True, True, False, False)))
        for h in barriers:
            np.logical_and(found.inside, h.low > 0.0, out=found.inside)
            np.logical_and(found.touches, h.high >= 0.0, out=found.touches)
        self._keep_edges(found.inside, barriers, (low, high), known)
        if self._stays:
            np.logical_and(found.inside, outside.high <= _ROUNDING, out=found.inside)
            np.logical_and(found.touches, outside.low <= 0.0, out=found.touches)
        else:
            np.logical_or(found.ends, outside.low > 0.0, out=found.ends)
            np.logical_or(found.may_end, outside.high > _ROUNDING, out=found.may_end)
        for g in goal:
            np.logical_or(found.ends, g.low >= 0.0, out=found.ends)
            np.logical_or(found.may_end, g.high >= 0.0, out=found.may_end)
        return found

    def _keep_edges(
        self,
        inside: np.ndarray,
        barriers: Sequence[Interval],
        ends: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
        known: Sequence[float],
    ) -> None:
        """Mark cells that are in the safe set but for their edge, whose probability is nil."""
        least = np.minimum.reduce([np.broadcast_to(h.low, inside.shape) for h in barriers])
        most = np.minimum.reduce([np.broadcast_to(h.high, inside.shape) for h in barriers])
        near = np.flatnonzero((least <= 0.0) & (least >= -_SKIN * most))
        if near.size:
            skins = [_SKIN * (b[near] - a[near]) for a, b in zip(*ends, strict=True)]
            boxes = [
                Interval(a[near] + skin, b[near] - skin)
                for a, b, skin in zip(*ends, skins, strict=True)
            ]
            inner = self._function([*boxes, *known])[: self._barriers]
            inside[near] = np.logical_and.reduce([h.low > 0.0 for h in inner])


def halved(low: Sequence[Any], high: Sequence[Any], number: int) -> tuple[list[Any], list[Any]]:
    """Return one of the 2**n parts of boxes that are halved along each axis.

    Args:
        low: least coordinates, n arrays.
        high: largest coordinates.
        number: of the part.
    """
    below, above = [], []
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        middle = 0.5 * (a + b)
        below.append(middle if number >> i & 1 else a)
        above.append(b if number >> i & 1 else middle)
    return below, above


def hull_of(reduced: ReducedProblem, sets: Sets) -> list[np.ndarray]:
    """Return edges along each coordinate between which the safe part of the workspace lies.

    The outermost intervals may be very narrow: the safe set ends within them.

    Args:
        reduced: the problem.
        sets: of it.

    Raises:
        ConfigurationError: No state is safe.
    """
    ends = [_range(c) for c in reduced.coordinates]
    if sets.depend_on_time:
        return workspace_of(reduced)
    for _ in range(_LOOKS):
        grid = uniform_grid(reduced.coordinates, ends, [_SCAN[len(ends)]] * len(ends))
        touched = sets.of_cells(grid, 0).touches
        if not touched.any():
            raise ConfigurationError(
                f"no state of {reduced.problem.name} in its workspace is safe; check its barriers"
            )
        places = np.unravel_index(np.flatnonzero(touched), grid.shape)
        ends = [
            (a, b) if c.period else (float(x.edges[i.min()]), float(x.edges[i.max() + 1]))
            for c, (a, b), x, i in zip(reduced.coordinates, ends, grid.axes, places, strict=True)
        ]
    return [
        np.array(pair) if c.period else _ends_along(i, reduced, sets, ends)
        for i, (c, pair) in enumerate(zip(reduced.coordinates, ends, strict=True))
    ]


def workspace_of(reduced: ReducedProblem) -> list[np.ndarray]:
    """Return the ends of the workspace along each coordinate."""
    return [np.array(_range(c)) for c in reduced.coordinates]


def _ends_along(
    i: int, reduced: ReducedProblem, sets: Sets, ends: list[tuple[float, float]]
) -> np.ndarray:
    """Return the ends of the safe set along a coordinate, and ends just within, if it has some."""
    low, high = ends[i]
    found = {low, high}
    whole = _range(reduced.coordinates[i])
    for end, other in ((low, high), (high, low)):
        if end in whole:
            continue
        # No state between `end` and `empty` is safe, for all that is known.
        empty, full = end, end + (other - end) / _SCAN[len(ends)]
        while abs(full - empty) > _SHARP * (high - low):
            middle = 0.5 * (empty + full)
            slab = [*ends]
            slab[i] = (min(end, middle), max(end, middle))
            counts = [1 if j == i else _SCAN[len(ends)] for j in range(len(ends))]
            grid = uniform_grid(reduced.coordinates, slab, counts)
            if sets.of_cells(grid, 0).touches.any():
                full = middle
            else:
                empty = middle
        found -= {end}
        found |= {empty, full}
    return np.array(sorted(found))


def _range(coordinate: Coordinate) -> tuple[float, float]:
    if coordinate.period:
        return -0.5 * coordinate.period, 0.5 * coordinate.period
    return coordinate.low, coordinate.high


def uniform_grid(
    coordinates: Sequence[Coordinate],
    ends: Sequence[tuple[float, float]],
    counts: Sequence[int],
) -> Grid:
    """Return a grid of cells of one size.

    Args:
        coordinates: of the grid.
        ends: of each of them.
        counts: number of cells along each of them.
    """
    return Grid(
        tuple(
            Axis(np.linspace(low, high, count + 1), c.period)
            for c, (low, high), count in zip(coordinates, ends, counts, strict=True)
        )
    )
