"""Expected values under noise of constant size along one coordinate, bounded from below.

For values that are constant on cells, the expected value at a mean m is
sum_e d_e Phi((m - e)/s), where d_e is the step of the values at the edge e and s the
standard deviation. Each term is monotone in m: over an interval of means a rising step counts from
its lower end, a falling one from its upper end, and the sum is a lower bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.value.grid import Axis, Grid

REACH = 7.0
"""Standard deviations that noise is taken to reach; beyond is 3e-12."""

_MOST_TURNS = 2.0
"""Standard deviation in periods from which noise on a periodic axis is as good as uniform: the
density differs by exp(-2 (2 pi)^2) of it at most."""

_COARSE = 16
"""Cells of a standard deviation beyond the grid, at least, where the values are far away."""

_PARTS = 1
"""Of a cell along an axis with noise."""

_AT_ONCE = 96
"""Intervals of means of a block: so many share most of the edges that noise may pass."""


class _Block(NamedTuple):
    """Consecutive intervals of means, and the edges that noise may or may not pass from them.

    Attributes:
        means: the intervals.
        edges: the edges.
        at_low: for each interval, chance to pass each edge from its lower end.
        at_high: the same from its upper end.
        below: number of edges that are passed in any case.
    """

    means: slice
    edges: slice
    at_low: np.ndarray
    at_high: np.ndarray
    below: int


class Smoothing:
    """Bounds expected values on the cells of a grid of means.

    Along axes with noise the cells of the values are cut into parts, of which those that are not
    wholly in the safe set count as outside: so the edge of the set is resolved better than the
    values. The grid of means is as fine.

    Args:
        grid: of the values.
        blur: standard deviation of the noise along each axis; 0 for none.

    Attributes:
        fine: the grid of the parts.
        means: the grid of means, which reaches beyond the other by the noise.
        parts: of a cell along each axis.
        beyond: chance of noise beyond what is considered, at most.
    """

    def __init__(self, grid: Grid, blur: Sequence[float]) -> None:
        from scipy.special import ndtr

        self._shape = grid.shape
        self._blurs: list[tuple[int, list[_Block]]] = []
        self.parts = tuple(_PARTS if size else 1 for size in blur)
        fine = [axis.refined(cut) for axis, cut in zip(grid.axes, self.parts, strict=True)]
        self.fine, axes = Grid(tuple(fine)), list(fine)
        for i, size in enumerate(blur):
            if size:
                if fine[i].period:
                    size = min(size, _MOST_TURNS * fine[i].period)
                axes[i] = fine[i].widened(REACH * size, size / _COARSE)
                self._blurs.append((i, _blocks(axes[i], _unrolled(fine[i], size), size)))
        self.means = Grid(tuple(axes))
        self.beyond = 2.0 * len(self._blurs) * float(ndtr(-REACH))

    def smoothed(self, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Return lower bounds of the expected values on the grid of means, float32.

        Args:
            values: on the cells of the grid, shape (cells,), float32; 0 is outside.
            counts: which parts of cells count, shape (cells of `fine`,).
        """
        found = values.reshape(self._shape)
        for i, cut in enumerate(self.parts):
            if cut > 1:
                found = np.repeat(found, cut, axis=i)
        found = np.where(counts.reshape(found.shape), found, np.float32(0.0))
        if not self._blurs:
            return found.reshape(-1)
        for i, blocks in self._blurs:
            found = np.moveaxis(found, i, 0)
            others = found.shape[1:]
            bound = _passed(blocks, found.reshape(len(found), -1))
            found = np.moveaxis(bound.reshape(-1, *others), 0, i)
        return rounded_down(np.ascontiguousarray(found).reshape(-1))

    def least_around(self, means: np.ndarray) -> np.ndarray:
        """Return for each mean the least value of the block of `parts` cells that begins there.

        Args:
            means: on the grid of means, shape (cells of `means`,).
        """
        if not self._blurs:
            return means
        from scipy.ndimage import minimum_filter1d

        found = means.reshape(self.means.shape)
        for i, cut in enumerate(self.parts):
            if cut > 1:
                mode = "wrap" if self.means.axes[i].period else "nearest"
                found = minimum_filter1d(found, cut, i, mode=mode, origin=-(cut // 2))
        return np.ascontiguousarray(found).reshape(-1)


def rounded_down(values: np.ndarray) -> np.ndarray:
    """Return values in single precision, none of them larger than before."""
    found = values.astype(np.float32)
    return np.where(found > values, np.nextafter(found, np.float32(-np.inf)), found)


def _blocks(means: Axis, edges: np.ndarray, size: float) -> list[_Block]:
    from scipy.special import ndtr

    found = []
    for first in range(0, means.count, _AT_ONCE):
        part = slice(first, min(first + _AT_ONCE, means.count))
        low, high = means.edges[part], means.edges[part.start + 1 : part.stop + 1]
        begin = int(np.searchsorted(edges, low[0] - REACH * size))
        end = int(np.searchsorted(edges, high[-1] + REACH * size))
        at_low, at_high = (
            ndtr((ends[:, None] - edges[None, begin:end]) / size) for ends in (low, high)
        )
        found.append(_Block(part, slice(begin, end), at_low, at_high, begin))
    return found


def _passed(blocks: list[_Block], values: np.ndarray) -> np.ndarray:
    """Return lower bounds of the expected values of the columns of values."""
    edges = max(block.edges.stop for block in blocks)
    if edges > len(values) + 1:
        # A copy more than edges need: behind the last edge there is the next turn, not nothing.
        values = np.tile(values, (edges // len(values) + 1, 1))
    nothing = np.zeros((1, values.shape[1]))
    steps = np.diff(values.astype(np.float64), axis=0, prepend=nothing, append=nothing)
    rising, falling = np.maximum(steps, 0.0), np.minimum(steps, 0.0)
    found = np.empty((blocks[-1].means.stop, values.shape[1]))
    for block in blocks:
        part = block.at_low @ rising[block.edges]
        part += block.at_high @ falling[block.edges]
        # The steps that are passed in any case add up to the value behind the last of them.
        if 0 < block.below <= len(values):
            part += values[block.below - 1]
        found[block.means] = part
    return found


def _unrolled(axis: Axis, size: float) -> np.ndarray:
    """Return the edges of an axis, and of copies of a periodic one as far as noise reaches."""
    if not axis.period:
        return axis.edges
    copies = int(np.ceil(REACH * size / axis.period))
    turns = axis.period * np.arange(-copies, copies + 1)
    return np.append((axis.edges[:-1] + turns[:, None]).ravel(), axis.edges[-1] + turns[-1])
