"""Proved lower bounds of expected values under noise of constant size along single coordinates.

The formula is that of `smoothing`: a rising step counts from the lower end of the means, a falling
one from the upper end. Three things are added.

*Far edges.* Let f' be f on the cells around [m - r s, m + r s], and constant beyond them. Then
|E f(m + s v) - E f'(m + s v)| <= 2 Phi(-r) max|f|, since f' - f is 0 unless |v| > r, and f does not
change its sign. E f' is the value of f before the first of these edges, and the sum over them.

*Rounding.* The products of chances A >= 0 and of steps d of one sign have, in whatever
order they are added, a sum within (n + 2) 2^-53/(1 - (n + 2) 2^-53) of the exact one, relative to
it, with 2^-53 for the rounding of each step. Underflow adds less than 1e-300.

*Sizes and edges.* Standard deviations, and the edges of the copies of a periodic axis, are known to
1e-14 of them: each chance is taken at the end that makes the bound smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.wrappers.value.grid import Axis, Grid
from safe_envs.wrappers.value.normal_bounds import normal_above, normal_below
from safe_envs.wrappers.value.smoothing import Smoothing

REACH = 8.5
"""Standard deviations beyond which steps are taken as passed, or not."""

SIZE_ERROR = 1e-14
_UNIT = 2.0**-52
_AT_ONCE = 96


class _Block(NamedTuple):
    """Consecutive intervals of means, and the steps that noise may or may not pass from them.

    Attributes:
        means: the intervals.
        edges: numbers of the edges, modulo the cells of a periodic axis.
        before: cell before the first of the edges.
        at_low: least chances to pass each edge from the lower end of each interval.
        at_high: largest chances from the upper end.
    """

    means: slice
    edges: np.ndarray
    before: int
    at_low: np.ndarray
    at_high: np.ndarray


class ProvedSmoothing:
    """Bounds expected values on the cells of a grid of means, for certain.

    Args:
        grid: of the values.
        blur: standard deviation of the noise along each axis, to `SIZE_ERROR` of it; 0 for none.
        refined: parts of a cell of the means along each axis with noise. Bounds for several of them
            are closer than one for all.

    Attributes:
        means: the grid of means.
        beyond: chance to reach the grid from means outside of that of the means, at most.
    """

    def __init__(self, grid: Grid, blur: Sequence[float], refined: int = 1) -> None:
        axes = Smoothing(grid, blur).means.axes
        self.means = Grid(
            tuple(
                axis.refined(refined) if size else axis
                for axis, size in zip(axes, blur, strict=True)
            )
        )
        self._shape = grid.shape
        self._blocks = [
            (i, bool(axis.period), _blocks(axis, self.means.axes[i], size))
            for i, (axis, size) in enumerate(zip(grid.axes, blur, strict=True))
            if size
        ]
        self.beyond = 0.0
        for i, periodic, _ in self._blocks:
            if not periodic:
                own, wide = grid.axes[i].edges, self.means.axes[i].edges
                margin = min(own[0] - wide[0], wide[-1] - own[-1]) * (1.0 - 4.0 * SIZE_ERROR)
                self.beyond = max(self.beyond, float(normal_above(-margin / blur[i])))

    def smoothed(self, values: np.ndarray) -> np.ndarray:
        """Return lower bounds of the expected values, of the shape of the grid of means.

        Args:
            values: on the cells of the grid, all in [0, 1], or all in [-1, 0]; 0 is outside.
        """
        found = values.reshape(self._shape).astype(np.float64)
        for i, periodic, blocks in self._blocks:
            found = np.moveaxis(found, i, 0)
            others = found.shape[1:]
            bound = _passed(blocks, periodic, np.ascontiguousarray(found.reshape(len(found), -1)))
            found = np.moveaxis(bound.reshape(-1, *others), 0, i)
        return found


def _passed(blocks: list[_Block], periodic: bool, values: np.ndarray) -> np.ndarray:
    count = len(values)
    if periodic:
        steps = values - np.roll(values, 1, axis=0)
    else:
        steps = np.diff(values, axis=0, prepend=0.0, append=0.0)
    rising, falling = np.maximum(steps, 0.0), np.minimum(steps, 0.0)
    nonnegative = bool(values.min(initial=0.0) >= 0.0)
    found = np.empty((blocks[-1].means.stop, values.shape[1]))
    missed = 2.0 * float(normal_above(-REACH)) * float(np.abs(values).max(initial=0.0))
    for block in blocks:
        up = block.at_low @ rising[block.edges]
        down = block.at_high @ falling[block.edges]
        base: Any = 0.0
        if periodic or 0 <= block.before < count:
            base = values[block.before]
        # (n + 2) 2^-53 for the products, and some more for the sums here, with room.
        slack = (len(block.edges) + 20) * _UNIT * (up - down + np.abs(base)) + (missed + 1e-300)
        bound = base + up + down - slack
        found[block.means] = np.maximum(bound, 0.0) if nonnegative else np.maximum(bound, -1.0)
    return found


def _blocks(axis: Axis, means: Axis, size: float) -> list[_Block]:
    edges, numbers, error = _unrolled(axis, size)
    found = []
    reach = REACH * size * (1.0 + 1e-9)
    for first in range(0, means.count, _AT_ONCE):
        part = slice(first, min(first + _AT_ONCE, means.count))
        low, high = means.edges[part], means.edges[part.start + 1 : part.stop + 1]
        begin = int(np.searchsorted(edges, low[0] - reach))
        end = int(np.searchsorted(edges, high[-1] + reach))
        own, slack = edges[None, begin:end], error[None, begin:end]
        at_low = normal_below(_quotient(low[:, None], own, slack, size, -1.0))
        at_high = normal_above(_quotient(high[:, None], own, slack, size, 1.0))
        before = int(numbers[begin - 1]) if axis.period else begin - 1
        found.append(_Block(part, numbers[begin:end], before, at_low, at_high))
    return found


def _quotient(
    means: np.ndarray, edges: np.ndarray, errors: np.ndarray, size: float, side: float
) -> np.ndarray:
    """Return bounds of (mean - edge)/size, from below for the side -1, from above for 1."""
    gap = means - edges
    gap = gap + side * (np.abs(gap) * _UNIT + errors)
    gap = gap + side * np.abs(gap) * _UNIT
    found = gap / size
    return found + side * np.abs(found) * (2.0 * SIZE_ERROR)


def _unrolled(axis: Axis, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return edges, also of the copies of a periodic axis, their numbers, and their errors.

    The number of an edge is that of the step at it: from the cell before to that cell.
    """
    if not axis.period:
        return axis.edges, np.arange(axis.count + 1), np.zeros(axis.count + 1)
    copies = int(np.ceil(REACH * 1.01 * size / axis.period)) + 1
    turns = axis.period * np.arange(-copies, copies + 1)
    edges = (axis.edges[:-1] + turns[:, None]).ravel()
    numbers = np.tile(np.arange(axis.count), len(turns))
    # The period is the float next to the true one; a turn's last edge is the next one's first. What
    # lies between the two is narrower than these errors, also for means.
    errors = 4.0 * _UNIT * (np.abs(edges) + axis.period * (copies + 1))
    return edges, numbers, errors
