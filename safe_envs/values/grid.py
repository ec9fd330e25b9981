"""Rectilinear grids over a few coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safe_envs.values.expected_value_kernel import AXES

_FINEST = 4
"""Places of the uniform table of an axis for a cell."""

_MOST_PLACES = 1 << 20


@dataclass(frozen=True, eq=False)
class Axis:
    """The cells of one coordinate.

    Attributes:
        edges: N + 1 increasing numbers, the edges of the N cells.
        period: of the coordinate, the distance from the first edge to the last; 0 without one.
    """

    edges: np.ndarray
    period: float = 0.0

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.edges) - 1

    @cached_property
    def places(self) -> np.ndarray:
        """Cell at the lower end of each of a number of equal intervals, int32.

        From there the cell of a number in that interval is found in a few steps.
        """
        edges = self.edges
        extent = edges[-1] - edges[0]
        wanted = _FINEST * extent / np.median(np.diff(edges))
        places = int(min(max(wanted, self.count), _MOST_PLACES))
        if np.allclose(np.diff(edges), extent / self.count, rtol=1e-9, atol=0.0):
            places = self.count
        lows = edges[0] + extent * np.arange(places) / places
        # One cell less, for rounding: the search goes upwards.
        found = np.searchsorted(edges, lows, side="right") - 2
        return np.clip(found, 0, self.count - 1).astype(np.int32)

    def cell_of(self, values: Any) -> np.ndarray:
        """Return the cell of each value; -1 below the first edge, N above the last.

        A cell holds its lower edge. Values of a periodic coordinate are taken modulo its period.

        Args:
            values: any shape.
        """
        values = self.wrapped(np.asarray(values, dtype=np.float64))
        found = np.searchsorted(self.edges, values, side="right") - 1
        return np.where(values == self.edges[-1], self.count - 1, found)

    def wrapped(self, values: np.ndarray) -> np.ndarray:
        """Return the values, moved by whole periods to between the edges."""
        if not self.period:
            return values
        low = self.edges[0]
        turned = values - self.period * np.floor((values - low) / self.period)
        return np.clip(turned, low, np.nextafter(self.edges[-1], low))

    def refined(self, factor: int) -> Axis:
        """Return the axis with each cell cut into equal parts.

        Args:
            factor: number of parts.
        """
        if factor == 1:
            return self
        parts = np.arange(factor) / factor
        fine = self.edges[:-1, None] + np.diff(self.edges)[:, None] * parts
        return Axis(np.append(fine.ravel(), self.edges[-1]), self.period)

    def widened(self, margin: float, coarse: float = 0.0) -> Axis:
        """Return the axis with more cells on both sides; a periodic one needs none.

        Args:
            margin: to cover on each side at least.
            coarse: width of the new cells, unless those of the axis are wider.
        """
        if self.period or not margin:
            return self
        # The outermost cells may be very narrow.
        width = max(float(np.median(np.diff(self.edges))), coarse)
        more = width * np.arange(1, int(np.ceil(margin / width)) + 1)
        return Axis(np.concatenate([self.edges[0] - more[::-1], self.edges, self.edges[-1] + more]))


@dataclass(frozen=True, eq=False)
class Grid:
    """The product of the cells of some axes, of which the last one varies fastest.

    Attributes:
        axes: of each coordinate.
    """

    axes: tuple[Axis, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of cells along each axis."""
        return tuple(axis.count for axis in self.axes)

    @property
    def cells(self) -> int:
        """Number of all cells."""
        return int(np.prod(self.shape))

    def corners(self, cells: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Return the least and the largest coordinates of cells.

        Args:
            cells: their numbers, shape (B,).

        Returns:
            For each axis an array (B,).
        """
        places = np.unravel_index(cells, self.shape)
        low = tuple(a.edges[i] for a, i in zip(self.axes, places, strict=True))
        high = tuple(a.edges[i + 1] for a, i in zip(self.axes, places, strict=True))
        return low, high

    def cell_of(self, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return the number of the cell of each point; -1 outside the grid.

        Args:
            q: for each axis an array (B,).
        """
        places = [axis.cell_of(values) for axis, values in zip(self.axes, q, strict=True)]
        inside = np.ones(len(places[0]), dtype=bool)
        for axis, place in zip(self.axes, places, strict=True):
            inside &= (place >= 0) & (place < axis.count)
        kept = [
            np.clip(place, 0, axis.count - 1) for axis, place in zip(self.axes, places, strict=True)
        ]
        return np.where(inside, np.ravel_multi_index(kept, self.shape), -1)


ROUNDING = 1e-13
"""Of the largest number of an axis: how far a sum of a few numbers may be off."""

POINT_SLACK = 4e-7
"""The same for states and inputs that pass through single precision, as observations and actions
do. It is for problems without noise, where a little off may be outside for good; with noise a
state is as likely at one place as at another so near to it."""

CELL_SLACK = 1e-6
"""The same for cells: a state that is read off an observation may lie next to its cell by the
slack of a point, and goes as far as that from there."""


class GridArrays(NamedTuple):
    """A grid as arrays, with axes of one cell in place of those that it does not have.

    Attributes:
        counts: for each axis the number of cells, the place of its first edge, that of its first
            entry in `places`, the number of these entries, and the cells of a block for which an
            entry of the tables stands; int64, shape (5 * AXES,).
        places: of all axes, see `Axis.places`, int32.
        edges: of all axes.
        scales: for each axis the first edge, the entries of `places` for a unit, the period, and
            by how much intervals are widened; shape (AXES, 4).
    """

    counts: np.ndarray
    places: np.ndarray
    edges: np.ndarray
    scales: np.ndarray


def grid_arrays(
    grid: Grid, slack: float = ROUNDING, blocks: Sequence[int] | None = None
) -> GridArrays:
    """Return a grid as arrays.

    Args:
        grid: to describe.
        slack: by which intervals are widened, of the largest number of an axis.
        blocks: cells along each axis for which an entry of the tables stands; None for one.
    """
    counts = np.zeros((5, AXES), dtype=np.int64)
    counts[0] = counts[4] = 1
    counts[4, : len(grid.axes)] = blocks or 1
    scales = np.zeros((AXES, 4))
    edges = np.concatenate([axis.edges for axis in grid.axes])
    places = np.concatenate([axis.places for axis in grid.axes])
    first_edge = first_place = 0
    for i, axis in enumerate(grid.axes):
        extent = axis.edges[-1] - axis.edges[0]
        counts[:4, i] = axis.count, first_edge, first_place, len(axis.places)
        size = max(abs(axis.edges[0]), abs(axis.edges[-1]))
        scales[i] = axis.edges[0], len(axis.places) / extent, axis.period, slack * size
        first_edge += axis.count + 1
        first_place += len(axis.places)
    return GridArrays(counts.ravel(), places, edges, scales)
