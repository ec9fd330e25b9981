"""Expected values under noise of constant size along one coordinate, bounded from below.

For values that are constant on cells, the expected value at a mean m is
outside + sum_e d_e Phi((m - e)/s), where d_e is the step of the values at the edge e and s the
standard deviation. Each term is monotone in m: over an interval of means a rising step counts from
its lower end, a falling one from its upper end, and the sum is a lower bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.wrappers.value.grid import Axis, Grid

_REACH = 6.0
"""Standard deviations that noise is taken to reach."""


class _Blur(NamedTuple):
    """Noise along an axis.

    Attributes:
        axis: its place.
        at_low: for each interval of means, chance to pass each edge from its lower end, sparse.
        at_high: the same from its upper end.
        below: edges that are passed from anywhere in the interval.
    """

    axis: int
    at_low: Any
    at_high: Any
    below: np.ndarray


class Smoothing:
    """Bounds expected values on the cells of a grid of means.

    Args:
        grid: of the values.
        blur: standard deviation of the noise along each axis; 0 for none.
        parts: into which the cells are cut along axes with noise, for the grid of means.

    Attributes:
        means: the grid of means, which reaches beyond the other by the noise.
        beyond: chance of noise beyond what is considered, at most.
    """

    def __init__(self, grid: Grid, blur: Sequence[float], parts: int) -> None:
        from scipy.special import ndtr

        self._shape = grid.shape
        self._blurs: list[_Blur] = []
        axes = list(grid.axes)
        for i, size in enumerate(blur):
            if size:
                axes[i] = grid.axes[i].refined(parts).widened(_REACH * size)
                self._blurs.append(_blur(i, axes[i], _unrolled(grid.axes[i], size), size))
        self.means = Grid(tuple(axes))
        self.beyond = 2.0 * len(self._blurs) * float(ndtr(-_REACH))

    def smoothed(self, values: np.ndarray, outside: float) -> np.ndarray:
        """Return lower bounds of the expected values on the grid of means, float32.

        Args:
            values: on the cells of the grid, shape (cells,), float32.
            outside: value outside the grid.
        """
        if not self._blurs:
            return values
        found = values.reshape(self._shape).astype(np.float64)
        for blur in self._blurs:
            found = np.moveaxis(found, blur.axis, 0)
            others = found.shape[1:]
            steps = _steps(found.reshape(len(found), -1), outside, blur.at_low.shape[1])
            passed = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
            bound = outside + passed[blur.below]
            bound += blur.at_low @ np.maximum(steps, 0.0)
            bound += blur.at_high @ np.minimum(steps, 0.0)
            found = np.moveaxis(bound.reshape(-1, *others), 0, blur.axis)
        return rounded_down(np.ascontiguousarray(found).reshape(-1))


def rounded_down(values: np.ndarray) -> np.ndarray:
    """Return values in single precision, none of them larger than before."""
    found = values.astype(np.float32)
    return np.where(found > values, np.nextafter(found, np.float32(-np.inf)), found)


def _blur(i: int, means: Axis, edges: np.ndarray, size: float) -> _Blur:
    from scipy.sparse import csr_matrix
    from scipy.special import ndtr

    low, high = means.edges[:-1], means.edges[1:]
    below = np.searchsorted(edges, low - _REACH * size)
    above = np.searchsorted(edges, high + _REACH * size)
    rows = np.repeat(np.arange(len(low)), above - below)
    columns = np.concatenate([np.arange(a, b) for a, b in zip(below, above, strict=True)])
    shape = (len(low), len(edges))
    at_low, at_high = (
        csr_matrix((ndtr((ends[rows] - edges[columns]) / size), (rows, columns)), shape)
        for ends in (low, high)
    )
    return _Blur(i, at_low, at_high, below)


def _unrolled(axis: Axis, size: float) -> np.ndarray:
    """Return the edges of an axis, and of copies of a periodic one as far as noise reaches."""
    if not axis.period:
        return axis.edges
    copies = int(np.ceil(_REACH * size / axis.period))
    turns = axis.period * np.arange(-copies, copies + 1)
    return np.append((axis.edges[:-1] + turns[:, None]).ravel(), axis.edges[-1] + turns[-1])


def _steps(values: np.ndarray, outside: float, edges: int) -> np.ndarray:
    """Return how values rise at each edge, with copies of them for more edges than cells."""
    copies = (edges - 1) // len(values)
    if copies > 1:
        values = np.tile(values, (copies, 1))
    ends = np.full((1, values.shape[1]), outside)
    return np.diff(values, axis=0, prepend=ends, append=ends)
