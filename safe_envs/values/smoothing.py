"""Expected values under noise of constant size along one coordinate, bounded from below.

For values that are constant on cells, the expected value at a mean m is
sum_e d_e Phi((m - e)/s), where d_e is the step of the values at the edge e and s the
standard deviation. Each term is monotone in m: over an interval of means a rising step counts from
its lower end, a falling one from its upper end, and the sum is a lower bound.

Phi is taken from its Taylor polynomial of degree 10 around the nearest multiple c of 1/8. The
coefficients Phi(c), (-1)^(n-1) He_(n-1)(c) phi(c)/n! come from interval arithmetic with 200 bits:
Phi(c) = 1/2 + phi(c) sum_n c^(2n+1)/(2n+1)!!, whose terms are positive, and fall by half at least
from 2n + 3 >= 2 c^2, so that what is left of them is at most twice the next one.

Error, for |z| <= 9 and t = z - c, |t| <= 1/16; t is exact by Sterbenz' lemma, or z for c = 0.
With |He_n(z)| exp(-z^2/4) <= 1.0865 sqrt(n!) (Cramer) what the polynomial leaves out is at most
.4335 sqrt(10!) t^11/11! < 2e-18. Of the sum over n >= 1, at most .03 in absolute terms, rounding
takes 22 units 2^-53 relative to it, and its coefficients are off by 2^-52: together < 8e-17. Phi(c)
and the last addition are off by 2^-53 < 1.2e-16 each. All is below 3.2e-16.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from safe_envs.values.grid import Axis, Grid

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
        return self.blurred(np.where(counts, self.on_parts(values), np.float32(0.0)))

    def on_parts(self, values: np.ndarray) -> np.ndarray:
        """Return values of the cells for each of their parts, shape (cells of `fine`,).

        Args:
            values: on the cells of the grid, shape (cells,).
        """
        found = values.reshape(self._shape)
        for i, cut in enumerate(self.parts):
            if cut > 1:
                found = np.repeat(found, cut, axis=i)
        return found.reshape(-1)

    def blurred(self, values: np.ndarray) -> np.ndarray:
        """Return lower bounds of the expected values on the grid of means, float32.

        Args:
            values: on the parts of the cells, shape (cells of `fine`,), float32; 0 is outside.
        """
        found = values.reshape(self.fine.shape)
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


_FURTHEST_BOX = 5.6
"""Largest absolute value of a normal in an interval; beyond it is .00000002."""

_EVEN = 0.55
"""How much of an interval's width does not grow with its distance from 0."""

_NEGLIGIBLE = 1e-10


class NoiseBoxes(NamedTuple):
    """Boxes of some standard normals.

    Attributes:
        low: least entries, shape (c, W).
        high: largest entries, shape (c, W).
        weights: probability of each box, shape (W,).
        rest: probability of the noise in none of them.
    """

    low: np.ndarray
    high: np.ndarray
    weights: np.ndarray
    rest: float


def noise_boxes(counts: Sequence[int]) -> NoiseBoxes:
    """Return boxes that hold nearly all values of some standard normals.

    Args:
        counts: number of intervals of each normal; without any there is one box of nothing.
    """
    from scipy.special import ndtr

    edges = [_edges(count) for count in counts]
    chances = [np.diff(ndtr(each)) for each in edges]
    low, high, weights = [], [], []
    for places in itertools.product(*map(range, counts)):
        weight = math.prod(float(each[i]) for each, i in zip(chances, places, strict=True))
        if weight > _NEGLIGIBLE:
            low.append([each[i] for each, i in zip(edges, places, strict=True)])
            high.append([each[i + 1] for each, i in zip(edges, places, strict=True)])
            weights.append(weight)
    shape = (len(weights), len(counts))
    # The weights of several boxes never exceed 1, whatever the rounding.
    total = np.array(weights) * (1.0 - 1e-15 if counts else 1.0)
    return NoiseBoxes(
        np.reshape(low, shape).T,
        np.reshape(high, shape).T,
        total,
        max(0.0, 1.0 - float(total.sum())),
    )


def _edges(count: int) -> np.ndarray:
    """Return the ends of intervals of a normal, which are wider where its density is low."""
    t = np.linspace(-1.0, 1.0, count + 1)
    return _FURTHEST_BOX * (_EVEN * t + (1.0 - _EVEN) * t**3)


ERROR = 4e-16
"""Of Phi as it is computed, at most."""

_FURTHEST = 9.0
"""Phi is below 1.2e-19 at the negative of it, and rises."""

_TAIL = 1.2e-19
_NODES, _DEGREE, _BITS = 8, 10, 200


def normal_below(z: Any) -> np.ndarray:
    """Return numbers that are at most Phi(z), in [0, 1].

    Args:
        z: any shape; infinite values are allowed.
    """
    z = np.asarray(z, dtype=np.float64)
    found = np.maximum(_polynomial(z) - ERROR, 0.0)
    return np.where(z > _FURTHEST, 1.0 - ERROR, np.where(z < -_FURTHEST, 0.0, found))


def normal_above(z: Any) -> np.ndarray:
    """Return numbers that are at least Phi(z), in [0, 1].

    Args:
        z: any shape; infinite values are allowed.
    """
    z = np.asarray(z, dtype=np.float64)
    found = np.minimum(_polynomial(z) + ERROR, 1.0)
    return np.where(z > _FURTHEST, 1.0, np.where(z < -_FURTHEST, _TAIL, found))


def _polynomial(z: np.ndarray) -> np.ndarray:
    z = np.clip(z, -_FURTHEST, _FURTHEST)
    place = np.rint(z * _NODES)
    t = z - place / _NODES
    rows = coefficients()[:, place.astype(np.int64) + int(_FURTHEST * _NODES)]
    found = rows[_DEGREE]
    for row in rows[_DEGREE - 1 :: -1]:
        found = found * t + row
    return found


@lru_cache(maxsize=1)
def coefficients() -> np.ndarray:
    """Return Taylor coefficients at the multiples of 1/8 in [-9, 9], shape (11, nodes).

    Raises:
        ArithmeticError: Interval arithmetic does not give them to a float's precision.
    """
    from mpmath.ctx_iv import MPIntervalContext

    iv: Any = MPIntervalContext()
    iv.prec = _BITS
    last = int(_FURTHEST * _NODES)
    found = np.empty((_DEGREE + 1, 2 * last + 1))
    for j in range(last + 1):
        c = iv.mpf(j) / _NODES
        density = iv.exp(-c * c / 2) / iv.sqrt(2 * iv.pi)
        value = iv.mpf(1) / 2 + density * _series(iv, c)
        hermite = [iv.mpf(1), c]
        while len(hermite) < _DEGREE:
            hermite.append(c * hermite[-1] - (len(hermite) - 1) * hermite[-2])
        for n in range(1, _DEGREE + 1):
            a = _rounded(hermite[n - 1] * density / math.factorial(n))
            # The derivative has the sign (-1)^(n-1), which He_(n-1) has at -c against c.
            found[n, last + j], found[n, last - j] = (-1) ** (n - 1) * a, a
        found[0, last + j], found[0, last - j] = _rounded(value), _rounded(1 - value)
    found.setflags(write=False)
    return found


def _series(iv: Any, c: Any) -> Any:
    """Return the sum over n of c^(2n+1)/(2n+1)!!."""
    total, term, n = iv.mpf(0), c, 0
    while True:
        total += term
        n += 1
        term = term * c * c / (2 * n + 1)
        if 2 * n + 3 >= 2 * float(c.b) ** 2 and float(term.b) < 2.0**-160:
            return total + iv.mpf([0, 1]) * 2 * term


def _rounded(number: Any) -> float:
    """Return the float next to a number that is enclosed in a narrow interval."""
    low, high = number.a, number.b
    if float(high - low) > 2.0**-120:
        raise ArithmeticError("an interval of 200 bits is too wide")
    return float(low)
