"""The cells that boxes touch on a grid, and the least values of a table over them.

Boxes are closed, and so are cells: a box that ends on an edge touches the cells on both sides. The
table gets a border, which stands for all that is outside of the grid; a periodic axis is written
twice instead. Everything here is exact but for the turns of periodic coordinates, for which boxes
are widened.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from safe_envs.values.grid import Axis, Grid

_UNIT = 2.0**-52


class Windows(NamedTuple):
    """First and last cells that boxes touch along each axis, in the numbering with a border.

    Attributes:
        first: shape (n, M), int32.
        last: the same.
    """

    first: np.ndarray
    last: np.ndarray


def windows_of(grid: Grid, low: np.ndarray, high: np.ndarray) -> Windows:
    """Return the cells that closed boxes touch.

    Args:
        grid: of the table.
        low: least coordinates, shape (M, n); may be infinite.
        high: largest ones.
    """
    ends = [
        (_turning if axis.period else _along)(axis, low[:, i], high[:, i])
        for i, axis in enumerate(grid.axes)
    ]
    first, last = zip(*ends, strict=True)
    return Windows(np.array(first, dtype=np.int32), np.array(last, dtype=np.int32))


def _along(axis: Axis, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # The border is cell 0, so that cell 0 of the axis is cell 1 here.
    first = np.searchsorted(axis.edges, low, side="left")
    last = np.searchsorted(axis.edges, high, side="right")
    return first, np.maximum(first, last)


def _turning(axis: Axis, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count, period, start = axis.count, axis.period, axis.edges[0]
    with np.errstate(all="ignore"):
        turns = np.floor((low - start) / period)
        # Of the turns, of the period's own rounding, and of the differences.
        slack = 8.0 * _UNIT * (np.abs(low) + np.abs(high) + 2.0 * period)
        a, b = low - turns * period - slack, high - turns * period + slack
        whole = ~(b - a < period * (1.0 - 1e-9))
        a, b = np.where(whole, start, a), np.where(whole, start, b)
        below = a < start
        a, b = np.where(below, a + period - slack, a), np.where(below, b + period + slack, b)
    twice = np.concatenate([axis.edges, axis.edges[1:] + period])
    first = np.clip(np.searchsorted(twice, a, side="left") - 1, 0, count - 1)
    # Edges of the second turn are off by little, too.
    last = np.searchsorted(twice, b + 4.0 * _UNIT * (np.abs(b) + period), side="right") - 1
    last = np.clip(last, first, first + count - 1)
    return np.where(whole, 0, first), np.where(whole, count - 1, last)


class Groups:
    """Windows in groups of like widths, of which the least values are looked up quickly.

    Each width w is covered by two windows of the largest power of two up to w.

    Args:
        grid: of the table.
        windows: of boxes.
    """

    def __init__(self, grid: Grid, windows: Windows) -> None:
        self._count = windows.first.shape[1]
        self._shape = tuple(2 * axis.count if axis.period else axis.count + 2 for axis in grid.axes)
        levels = np.frexp(windows.last - windows.first + 1)[1] - 1
        keys = np.zeros(self._count, dtype=np.int32)
        for level in levels:
            keys = keys * 32 + level
        self._groups: list[tuple[tuple[int, ...], np.ndarray, list[np.ndarray]]] = []
        order = np.argsort(keys, kind="stable")
        found, begins = np.unique(keys[order], return_index=True)
        for begin, end in zip(begins, [*begins[1:], self._count], strict=True):
            rows = order[begin:end]
            level = tuple(int(each[rows[0]]) for each in levels) if len(rows) else ()
            self._groups.append((level, rows, self._places(windows, level, rows)))
        del found

    def _places(
        self, windows: Windows, level: tuple[int, ...], rows: np.ndarray
    ) -> list[np.ndarray]:
        choices = []
        for i, j in enumerate(level):
            first, last = windows.first[i, rows], windows.last[i, rows] - ((1 << j) - 1)
            choices.append((first,) if np.array_equal(first, last) else (first, last))
        return [
            np.asarray(np.ravel_multi_index(each, self._shape), dtype=np.int32)
            for each in itertools.product(*choices)
        ]

    def least(self, table: Bordered) -> np.ndarray:
        """Return the least value of the table over each window, shape (M,).

        Args:
            table: of values, with a border.
        """
        found = np.empty(self._count)
        for level, rows, places in self._groups:
            values = table.at_level(level)
            least = values[places[0]]
            for other in places[1:]:
                np.minimum(least, values[other], out=least)
            found[rows] = least
        return found


class Bordered:
    """A table with a border, and its least values over windows of powers of two.

    Args:
        grid: of the table.
        values: of its cells, in the shape of the grid.
        outside: value outside of the grid.
    """

    def __init__(self, grid: Grid, values: np.ndarray, outside: float) -> None:
        for i, axis in enumerate(grid.axes):
            if axis.period:
                values = np.concatenate([values, values], axis=i)
            else:
                border = [(int(i == j), int(i == j)) for j in range(values.ndim)]
                values = np.pad(values, border, constant_values=outside)
        self._levels = {(0,) * values.ndim: np.ascontiguousarray(values)}

    def at_level(self, level: tuple[int, ...]) -> np.ndarray:
        """Return the least values of the windows that begin at each cell, as a flat array.

        Args:
            level: logarithm to base 2 of the width along each axis. Entries whose window leaves
                the array hold something else.
        """
        return self._of(level).reshape(-1)

    def _of(self, level: tuple[int, ...]) -> np.ndarray:
        if level not in self._levels:
            i = max(range(len(level)), key=lambda axis: level[axis])
            half = self._of((*level[:i], level[i] - 1, *level[i + 1 :]))
            moved = np.moveaxis(half, i, 0)
            step = 1 << (level[i] - 1)
            found = np.empty_like(half)
            kept = np.moveaxis(found, i, 0)
            np.minimum(moved[:-step], moved[step:], out=kept[:-step])
            kept[-step:] = moved[-step:]
            self._levels[level] = found
        return self._levels[level]
