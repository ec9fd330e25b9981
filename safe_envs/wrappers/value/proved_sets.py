"""Cells that lie in the safe set for certain, and what is outside of the grid.

A cell counts that lies wholly in C. Where an edge of C runs along the edge of a cell, rounding
hides it; such a cell counts if it does so without a strip of `SKIN` of its width there. That is
made good:

- Along an axis with noise of standard deviation s, the next state is in one of N strips of width d
  with probability N d/(s sqrt(2 pi)) at most, N d (1/(s sqrt(2 pi)) + 1/P) with a period P, which
  is taken off.
- Along another axis strips are allowed only next to a slab of the grid in which no cell counts, or
  to its outer end. Images are widened by the strip, so that one that reaches it counts as 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.wrappers.value.cell_sets import halved
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.reduction import ReducedProblem

SKIN = 1e-9
_HALVINGS = 2
_AT_ONCE = 500_000
_MOST_BOXES, _MOST_HALVINGS = 400_000, 40


class ProvedSets:
    """What the cells of a grid lie in, for certain.

    Args:
        small: the problem; its sets do not depend on time.
        leaving: see `ValueSettings`.
        grid: of the coordinates.
        blur: standard deviation of the noise along each axis; 0 for none.

    Attributes:
        inside: cells wholly in the safe set, and in the workspace where leaving is a violation, but
            for strips; bool (cells,), as for all others.
        touches: cells that may be in part.
        ends: cells wholly where episodes end.
        may_end: cells that may be in part.
        lost: probability of the strips in a step, at most.
        widening: of images along each axis.
    """

    def __init__(
        self, small: ReducedProblem, leaving: str, grid: Grid, blur: Sequence[float]
    ) -> None:
        self._grid, self._stays, self._blur = grid, leaving == "violation", blur
        symbols = tuple(c.symbol for c in small.coordinates)
        goal = () if small.goal is None else (small.goal,)
        self._barriers = len(small.barriers)
        self._function = interval_function(symbols, (*small.barriers, small.outside, *goal))
        self._ranges = [(c.low, c.high) for c in small.coordinates]
        low, high = self.corners(np.arange(grid.cells))
        parts = [
            self.read([c[a : a + _AT_ONCE] for c in low], [c[a : a + _AT_ONCE] for c in high])
            for a in range(0, grid.cells, _AT_ONCE)
        ]
        found = (np.concatenate(each) for each in zip(*parts, strict=True))
        self.inside, self.touches, self.ends, self.may_end = found
        self.lost, self.widening = 0.0, [0.0] * len(blur)
        self._keep_edges()

    def corners(self, cells: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the ends of closed cells; the turns of a periodic axis leave no gap.

        Args:
            cells: their numbers, shape (B,).
        """
        low, high = (list(map(np.array, ends)) for ends in self._grid.corners(cells))
        for i, axis in enumerate(self._grid.axes):
            if axis.period:
                gap = 8.0 * np.spacing(axis.period)
                low[i] = np.where(low[i] == axis.edges[0], low[i] - gap, low[i])
                high[i] = np.where(high[i] == axis.edges[-1], high[i] + gap, high[i])
        return low, high

    def read(
        self, low: Sequence[np.ndarray], high: Sequence[np.ndarray], halvings: int = _HALVINGS
    ) -> np.ndarray:
        """Return inside, touches, ends and may_end of closed boxes, shape (4, B).

        Args:
            low: least coordinates, n arrays (B,).
            high: largest coordinates.
            halvings: of boxes of which this is not clear.
        """
        found = np.ones((4, len(low[0])), dtype=bool)
        found[2:] = False
        values = self._function([Interval(a, b) for a, b in zip(low, high, strict=True)])
        outside = values[self._barriers]
        for h in values[: self._barriers]:
            found[0] &= h.low > 0.0
            found[1] &= h.high >= 0.0
        if self._stays:
            found[0] &= outside.high <= 0.0
            found[1] &= outside.low <= 0.0
        else:
            found[2] |= outside.low > 0.0
            found[3] |= outside.high > 0.0
        for goal in values[self._barriers + 1 :]:
            found[2] |= goal.low >= 0.0
            found[3] |= goal.high >= 0.0
        unclear = np.flatnonzero((found[0] != found[1]) | (found[2] != found[3]))
        if halvings and unclear.size:
            boxes = [a[unclear] for a in low], [b[unclear] for b in high]
            halves = [self.read(*halved(*boxes, i), halvings - 1) for i in range(2 ** len(low))]
            found[::2, unclear] = np.logical_and.reduce([half[::2] for half in halves])
            found[1::2, unclear] = np.logical_or.reduce([half[1::2] for half in halves])
        return found

    def _keep_edges(self) -> None:
        """Count cells that are in the safe set but for strips, and see what these cost."""
        grid = self._grid
        rows = np.flatnonzero(self.touches & ~self.inside)
        if not rows.size:
            return
        places = np.unravel_index(rows, grid.shape)
        low, high = self.corners(rows)
        strips, empty = [], self._empty_slabs(rows, places)
        for i, (axis, blur, place) in enumerate(zip(grid.axes, self._blur, places, strict=True)):
            skin = SKIN * np.diff(axis.edges)
            if blur:
                below = above = np.ones(axis.count, dtype=bool)
            elif axis.period:
                below = above = np.zeros(axis.count, dtype=bool)
            else:
                below, above = empty[i][:-2], empty[i][2:]
            low[i] = low[i] + np.where(below[place], skin[place], 0.0)
            high[i] = high[i] - np.where(above[place], skin[place], 0.0)
            strips.append((skin, place))
        kept = self.read(low, high)[0]
        if not kept.any():
            return
        self.inside[rows[kept]] = True
        for i, (skin, place) in enumerate(strips):
            widest = 2.0 * float(skin.max())
            if self._blur[i]:
                density = 0.4 / self._blur[i]
                if grid.axes[i].period:
                    density += 1.0 / grid.axes[i].period
                self.lost += 2.0 * len(np.unique(place[kept])) * widest * density
            else:
                self.widening[i] = widest

    def _empty_slabs(self, rows: np.ndarray, places: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return for each axis which slabs hold no cell that could count, with one at each end."""
        grid = self._grid
        low, high = self.corners(rows)
        for i, (axis, place) in enumerate(zip(grid.axes, places, strict=True)):
            skin = SKIN * np.diff(axis.edges)[place]
            low[i], high[i] = low[i] + skin, high[i] - skin
        counted = np.array(self.inside)
        counted[rows] |= self.read(low, high)[0]
        found = []
        for i in range(len(grid.axes)):
            others = tuple(j for j in range(len(grid.axes)) if j != i)
            empty = ~counted.reshape(grid.shape).any(axis=others)
            found.append(np.concatenate([[True], empty, [True]]))
        return found

    def covered(self) -> bool:
        """Return whether all safe states of the workspace are on the grid, for certain."""
        return all(
            self._is_empty(i, end)
            for i, axis in enumerate(self._grid.axes)
            if not axis.period
            for end in ((self._ranges[i][0], axis.edges[0]), (axis.edges[-1], self._ranges[i][1]))
            if end[0] < end[1]
        )

    def _is_empty(self, i: int, end: tuple[float, float]) -> bool:
        """Return whether no safe state has its coordinate i between two ends, for certain."""
        low = [np.array([a]) for a, _ in self._ranges]
        high = [np.array([b]) for _, b in self._ranges]
        low[i], high[i] = np.array([end[0]]), np.array([end[1]])
        for _ in range(_MOST_HALVINGS):
            if not len(low[0]) or len(low[0]) > _MOST_BOXES:
                break
            open_ = self.read(low, high, 0)[1]
            low, high = [a[open_] for a in low], [b[open_] for b in high]
            halves = [halved(low, high, number) for number in range(2 ** len(low))]
            low = [np.concatenate([h[0][j] for h in halves]) for j in range(len(low))]
            high = [np.concatenate([h[1][j] for h in halves]) for j in range(len(high))]
        return not len(low[0])
