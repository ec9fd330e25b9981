"""Rectilinear grids over a few coordinates."""

from __future__ import annotations

import itertools
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


@dataclass(frozen=True, eq=False)
class NodeGrid:
    """Equidistant nodes along some axes, of which the last one varies fastest.

    Attributes:
        low: first node along each axis.
        step: distance of the nodes.
        counts: number of nodes.
        periodic: whether the first node follows the last one.
    """

    low: tuple[float, ...]
    step: tuple[float, ...]
    counts: tuple[int, ...]
    periodic: tuple[bool, ...]

    @classmethod
    def over(
        cls,
        ends: Sequence[tuple[float, float]],
        counts: Sequence[int],
        periodic: Sequence[bool],
    ) -> NodeGrid:
        """Return a grid of so many nodes between two ends along each axis.

        Args:
            ends: first and last node; one turn apart where the axis is periodic.
            counts: number of nodes.
            periodic: whether the first node follows the last one.
        """
        steps = [
            (high - low) / (count if turns else count - 1)
            for (low, high), count, turns in zip(ends, counts, periodic, strict=True)
        ]
        return cls(tuple(a for a, _ in ends), tuple(steps), tuple(counts), tuple(periodic))

    @property
    def size(self) -> int:
        """Number of all nodes."""
        return int(np.prod(self.counts))

    def points(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Return the coordinates of nodes, an array (B,) for each axis."""
        places = np.unravel_index(numbers, self.counts)
        return [
            low + step * place for low, step, place in zip(self.low, self.step, places, strict=True)
        ]

    def nearest(self, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return the number of the node that is nearest to each point, shape (B,)."""
        places = []
        for values, low, step, count, turns in self._axes(q):
            place = np.rint((values - low) / step).astype(np.int64)
            places.append(place % count if turns else np.clip(place, 0, count - 1))
        return np.asarray(np.ravel_multi_index(places, self.counts))

    def corners(self, q: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes around points, and their shares in what is interpolated.

        Points beyond the ends of an axis are taken to its end.

        Args:
            q: an array (B,) for each axis.

        Returns:
            Numbers of nodes and their shares, shape (2^n, B) each.
        """
        sides = []
        for values, low, step, count, turns in self._axes(q):
            t = (values - low) / step
            t = t % count if turns else np.clip(t, 0.0, count - 1.0)
            first = np.minimum(t.astype(np.int64), count - 1 if turns else count - 2)
            share = t - first
            second = (first + 1) % count if turns else first + 1
            sides.append(((first, 1.0 - share), (second, share)))
        numbers, shares = [], []
        for corner in itertools.product(*sides):
            number = np.zeros(len(q[0]), dtype=np.int64)
            product = np.ones(len(q[0]))
            for (place, share), count in zip(corner, self.counts, strict=True):
                number = number * count + place
                product = product * share
            numbers.append(number)
            shares.append(product)
        return np.stack(numbers), np.stack(shares)

    def around(
        self, q: Sequence[np.ndarray], known: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return more nodes around points, and shares that are exact for cubic functions.

        Where such a node lies beyond the grid or is not known, the shares are those of `corners`.

        Args:
            q: an array (B,) for each axis.
            known: which nodes have values, shape (nodes,); None for all.

        Returns:
            Numbers of nodes and their shares, shape (4^n, B) each.
        """
        sides, linear = [], np.zeros(len(q[0]), dtype=bool)
        for values, low, step, count, turns in self._axes(q):
            t = (values - low) / step
            t = t % count if turns else np.clip(t, 0.0, count - 1.0)
            first = np.minimum(t.astype(np.int64), count - 1 if turns else count - 2)
            sides.append((first, t - first, count))
            if not turns:
                linear |= (first < 1) | (first > count - 3)
        number = np.zeros((1, len(q[0])), dtype=np.int64)
        for first, _, count in sides:
            places = np.stack([(first + j) % count for j in (-1, 0, 1, 2)])
            number = (number[:, None] * count + places).reshape(4 * len(number), -1)
        if known is not None:
            linear |= ~known[number].all(axis=0)
        share = np.ones((1, len(q[0])))
        for _, s, _ in sides:
            cubic = np.stack(
                [
                    -s * (s - 1.0) * (s - 2.0) / 6.0,
                    (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
                    -(s + 1.0) * s * (s - 2.0) / 2.0,
                    (s + 1.0) * s * (s - 1.0) / 6.0,
                ]
            )
            straight = np.stack([np.zeros_like(s), 1.0 - s, s, np.zeros_like(s)])
            own = np.where(linear, straight, cubic)
            share = (share[:, None] * own).reshape(4 * len(share), -1)
        return number, share

    def interpolated(self, table: np.ndarray, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return values at points.

        Args:
            table: on the nodes, shape (nodes, ...).
            q: an array (B,) for each axis.

        Returns:
            Shape (B, ...).
        """
        return np.sum(
            [
                table[number] * share.reshape(-1, *[1] * (table.ndim - 1))
                for number, share in zip(*self.corners(q), strict=True)
            ],
            axis=0,
        )

    def around_marked(self, marked: np.ndarray) -> np.ndarray:
        """Return which nodes are marked or next to one that is, also across a corner.

        Args:
            marked: of all nodes, bool (nodes,).

        Returns:
            Of the same shape.
        """
        found = marked.reshape(self.counts)
        for axis, turns in enumerate(self.periodic):
            sides = [(1, 1) if i == axis else (0, 0) for i in range(found.ndim)]
            wide = np.moveaxis(np.pad(found, sides, "wrap" if turns else "constant"), axis, 0)
            found = np.moveaxis(wide[:-2] | wide[1:-1] | wide[2:], 0, axis)
        return found.ravel()

    def _axes(self, q: Sequence[np.ndarray]) -> zip[tuple[np.ndarray, float, float, int, bool]]:
        return zip(q, self.low, self.step, self.counts, self.periodic, strict=True)
