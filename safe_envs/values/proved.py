"""A reduced problem on a grid, with all that proofs about it need.

A cell counts that lies wholly in C. Where an edge of C runs along the edge of a cell, rounding
hides it; such a cell counts if it does so without a strip of `SKIN` of its width there. That is
made good:

- Along an axis with noise of standard deviation s, the next state is in one of N strips of width d
  with probability N d/(s sqrt(2 pi)) at most, N d (1/(s sqrt(2 pi)) + 1/P) with a period P, which
  is taken off.
- Along another axis strips are allowed only next to a slab of the grid in which no cell counts, or
  to its outer end. Images are widened by the strip, so that one that reaches it counts as 0.

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

The images of boxes come from interval arithmetic that is rounded outwards. Of each the least value
of the cells that it touches counts, with proved lower bounds of the noise's probabilities for
values in [0, 1], and upper ones for values in [-1, 0].

By propositions 2 and 3 the look-ahead takes the place of the envelope at the first instant, so that
only the deficits of the later ones count.

By proposition 2 of the page on values, a table L_k <= 1_C with L_k <= Q^u L_(k+1) + e_k, for an
input u of each cell, bounds the largest probability of a safe episode from below by L_0 - sum e_k;
by proposition 3, one with H_k >= Q^u H_(k+1) - e_k for all inputs from above by H_0 + sum e_k. Both
inequalities are checked here on every cell, whoever has computed the table: the sets, the images of
the cells, the probabilities of the noise and all sums are bounds, to the last place.

What is proved is proved of the reduced chain: of the step that was derived from the problem, with
its numbers in double precision, and in the frame that the problem declares, if it does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.enclosures.intervals import Interval, IntervalArithmetic, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.cells import halved
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.images import Step, StepImages
from safe_envs.values.input_search import ScannedInputs, scanned_inputs
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.reduction import ReducedProblem, reduced
from safe_envs.values.smoothing import ERROR, NoiseBoxes, Smoothing, normal_above, normal_below
from safe_envs.values.tables import ValueTable, load_table
from safe_envs.values.windows import Bordered, Groups, Windows, windows_of

SKIN = 1e-9
_HALVINGS = 2
_CELLS_AT_ONCE = 500_000
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
            self.read(
                [c[a : a + _CELLS_AT_ONCE] for c in low], [c[a : a + _CELLS_AT_ONCE] for c in high]
            )
            for a in range(0, grid.cells, _CELLS_AT_ONCE)
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


REACH = 8.5
"""Standard deviations beyond which steps are taken as passed, or not."""

SIZE_ERROR = 1e-14
_UNIT = 2.0**-52
_ROWS_AT_ONCE = 96


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
    for first in range(0, means.count, _ROWS_AT_ONCE):
        part = slice(first, min(first + _ROWS_AT_ONCE, means.count))
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
    """Return edges, also of the copies of a periodic axis, their numbers, and their errors."""
    # The number of an edge is that of the step at it: from the cell before to that cell.
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


_LARGEST = 1e199
"""Effects of inputs are cut beyond it."""


class ProvedWeights:
    """Probabilities of boxes of noise.

    Args:
        noise: the boxes.

    Attributes:
        below: at most the probability of each, shape (W,).
        above: at least that.
        rest: at least the probability of the noise in none of them.
    """

    def __init__(self, noise: NoiseBoxes) -> None:
        self.below = np.ones(noise.low.shape[1])
        self.above = np.ones(noise.low.shape[1])
        for low, high in zip(noise.low, noise.high, strict=True):
            down, up = 1.0 - 2.0 * _UNIT, 1.0 + 2.0 * _UNIT
            least = np.maximum(normal_below(high) - normal_above(low), 0.0) * down
            most = (normal_above(high) - normal_below(low)) * up
            self.below, self.above = self.below * least * down, self.above * most * up
        self.rest = 0.0
        if len(noise.low):
            total = float(self.below.sum()) * (1.0 - (len(self.below) + 4) * _UNIT)
            self.rest = max(0.0, 1.0 - total) + ERROR

    def expected(self, values: np.ndarray) -> np.ndarray:
        """Return lower bounds of the mean of values, all in [0, 1], or all in [-1, 0].

        Args:
            values: shape (B, R, W).

        Returns:
            The least over R, shape (B,).
        """
        if not len(values):
            return np.zeros(0)
        if values.shape[2] == 1 and self.below[0] == self.above[0] == 1.0:
            return values[:, :, 0].min(axis=1)
        slack = (values.shape[2] + 4) * _UNIT
        up = np.maximum(values, 0.0) @ self.below * (1.0 - slack)
        down = np.minimum(values, 0.0) @ self.above * (1.0 + slack)
        missed = self.rest if values.min() < 0.0 else 0.0
        found = up + down - missed
        return (found - np.abs(found) * _UNIT - 1e-300).min(axis=1)


class ProvedImages:
    """The cells of the means that the next states of boxes touch.

    Args:
        step: of the problem.
        means: grid of the means.
        low: least coordinates of the boxes, n arrays (B,).
        high: largest coordinates.
        inputs: boxes of inputs, shape (U, m, 2), or (B, U, m, 2) with others for each box, from
            which they are taken by number.
        widening: of images along each axis.
    """

    def __init__(
        self,
        step: Step,
        means: Grid,
        ends: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
        inputs: np.ndarray,
        widening: Sequence[float],
    ) -> None:
        self._means, self._inputs, self._widening = means, inputs, widening
        self._affine = step.is_affine
        given = inputs if inputs.ndim == 4 else inputs[None]
        self._images: StepImages = step.images(*ends, given)
        self.shape = (self._images.images.shape[2], self._images.images.shape[3])

    def windows(self, numbers: np.ndarray, chosen: np.ndarray) -> Windows:
        """Return the windows of boxes under inputs, of B R W images.

        Args:
            numbers: numbers of the boxes, shape (B,).
            chosen: number of the input of each, shape (B,).
        """
        images, effects = self._images
        n = images.shape[4]
        own = images[numbers, 0] if self._affine else images[numbers, chosen]
        low, high = own[..., 0], own[..., 1]
        if self._affine:
            low, high = self._moved(low, high, effects[numbers], self._inputs_of(numbers, chosen))
        if any(self._widening):
            strip = np.asarray(self._widening)
            low = low - (strip + 2.0 * _UNIT * np.abs(low))
            high = high + (strip + 2.0 * _UNIT * np.abs(high))
        return windows_of(self._means, low.reshape(-1, n), high.reshape(-1, n))

    def _inputs_of(self, numbers: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        own = self._inputs.ndim == 4
        return self._inputs[numbers, chosen] if own else self._inputs[chosen]

    @staticmethod
    def _moved(
        low: np.ndarray, high: np.ndarray, effects: np.ndarray, inputs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of images (B, R, W, n) with what inputs (B, m, 2) add."""
        ops = IntervalArithmetic()
        found = Interval(low, high)
        for j in range(inputs.shape[1]):
            effect = Interval(effects[:, :, None, :, j, 0], effects[:, :, None, :, j, 1])
            given = Interval(*np.moveaxis(inputs[:, None, None, None, j], -1, 0))
            found = ops.add(found, ops.multiply(effect, given))
        cut: Any = (np.abs(effects) >= _LARGEST).any(axis=(3, 4))
        cut = cut[:, :, None, :]
        return np.where(cut, -np.inf, found.low), np.where(cut, np.inf, found.high)


_WIDEST = 2.0
"""Standard deviation in periods beyond which noise on a periodic axis is not bounded here."""

_STATES_AT_ONCE = 2_000_000


class ProvedChain:
    """Lower bounds of expected values on the cells of a grid, for certain.

    Args:
        small: the problem.
        leaving: see `ValueSettings`.
        grid: of its coordinates.
        refined: see `ProvedSmoothing`.

    Attributes:
        grid: the grid.
        step: of the problem.
        steps: control periods of an episode.
        box: (low, high) of each input.
        sets: what the cells lie in.

    Raises:
        ConfigurationError: Nothing can be proved of such a problem.
    """

    def __init__(self, small: ReducedProblem, leaving: str, grid: Grid, refined: int = 1) -> None:
        _require_provable(small, grid)
        self.grid, self.step, self.box = grid, Step(small), small.box
        self.steps = small.steps
        for axis, blur in zip(grid.axes, self.step.blur, strict=True):
            if axis.period and blur > _WIDEST * axis.period:
                raise ConfigurationError(
                    f"{small.problem.name} has noise of {blur:g} along a coordinate of period"
                    f" {axis.period:g}; tables are checked up to {_WIDEST:g} periods"
                )
        self.sets = ProvedSets(small, leaving, grid, self.step.blur)
        self._smoothing = ProvedSmoothing(grid, self.step.blur, refined)
        self._weights = ProvedWeights(self.step.noise)

    def ahead(self, values: np.ndarray, counts: np.ndarray, sign: int) -> Bordered:
        """Return lower bounds of expected values at means, for `bounds`.

        Args:
            values: on the cells of the grid, in [0, 1].
            counts: which cells count, bool (cells,).
            sign: 1, or -1 for bounds of the negative values.
        """
        given = np.where(counts, sign * values.astype(np.float64), 0.0)
        outside = 0.0 if sign > 0 else -self._smoothing.beyond
        return Bordered(self._smoothing.means, self._smoothing.smoothed(given), outside)

    def images(
        self, ends: tuple[Sequence[np.ndarray], Sequence[np.ndarray]], inputs: np.ndarray
    ) -> ProvedImages:
        """Return where boxes of coordinates go.

        Args:
            ends: least and largest coordinates, n arrays (B,) each.
            inputs: boxes of inputs, shape (U, m, 2), or (B, U, m, 2) with others for each box.
        """
        return ProvedImages(self.step, self._smoothing.means, ends, inputs, self.sets.widening)

    def bounds(
        self, ahead: Bordered, images: ProvedImages, numbers: np.ndarray, chosen: np.ndarray
    ) -> np.ndarray:
        """Return lower bounds of expected values after a step, shape (B,).

        Args:
            ahead: see the method of this name.
            images: of boxes.
            numbers: numbers of the boxes, shape (B,).
            chosen: number of the input of each, shape (B,).
        """
        found = np.empty(len(numbers))
        size = max(1, _STATES_AT_ONCE // int(np.prod(images.shape)))
        for first in range(0, len(numbers), size):
            part = slice(first, first + size)
            windows = images.windows(numbers[part], chosen[part])
            found[part] = self.of_groups(ahead, self.groups(windows), images.shape)
        return found

    def groups(self, windows: Windows) -> Groups:
        """Return windows in groups, for `of_groups`."""
        return Groups(self._smoothing.means, windows)

    def of_groups(self, ahead: Bordered, groups: Groups, shape: tuple[int, int]) -> np.ndarray:
        """Return lower bounds of expected values for the windows of boxes; see `bounds`."""
        values = groups.least(ahead).reshape(-1, *shape)
        return self._weights.expected(values) - self.sets.lost


def _require_provable(small: ReducedProblem, grid: Grid) -> None:
    name = small.problem.name
    if small.automaton is not None:
        raise ConfigurationError(
            f"the table is of the specification {small.specification!r}; only tables of staying"
            " safe are checked"
        )
    if small.known:
        symbols = ", ".join(map(str, small.known))
        raise ConfigurationError(
            f"{name} has states that are known in advance ({symbols}); they are computed in"
            " floating point, and tables over them are not checked"
        )
    if len(grid.axes) != len(small.coordinates):
        raise ConfigurationError(f"the grid has other coordinates than {name}")
    for axis, c in zip(grid.axes, small.coordinates, strict=True):
        off = abs(axis.edges[0] + 0.5 * c.period) + abs(axis.edges[-1] - 0.5 * c.period)
        if axis.period != c.period or (c.period and off > 4.0 * np.spacing(c.period)):
            raise ConfigurationError(f"the grid has another period of {c.symbol} than {name}")


Progress = Callable[[float], None]

_BOXES_AT_ONCE = 4_000_000

_SMALL = 1e-12
"""Deficits for which it does not pay to look for a better bound: they are taken off."""


class Deficit(NamedTuple):
    """The largest deficit at a control instant.

    Attributes:
        amount: by which the inequality fails at most, e_k; 0 where it holds.
        k: the instant.
        cell: number of the cell.
    """

    amount: float
    k: int
    cell: int


class ProvedSweeps:
    """The inequalities of both envelopes, instant by instant.

    Args:
        table: to be checked.
        chain: its problem on its grid.
    """

    def __init__(self, table: ValueTable, chain: ProvedChain) -> None:
        self._table, self._chain, self._sets = table, chain, chain.sets
        self._scanned = scanned_inputs(chain.box, table.settings.inputs)

    def lower(self, progress: Progress | None) -> list[Deficit]:
        """Return the largest deficits of the lower envelope at the instants 0, ..., K - 1."""
        sets, values = self._sets, self._table.lower
        rows = np.flatnonzero(sets.touches & ~sets.ends)
        witness = _Witness(self._chain, rows, self._scanned)

        def deficits(row: int, after: int) -> np.ndarray:
            wanted = values[row, rows].astype(np.float64)
            return witness.deficits(self._chain.ahead(values[after], sets.inside, 1), wanted)

        return self._swept(values, rows, deficits, progress)

    def obstacle(self) -> str:
        """Return why the upper envelope cannot be checked; "" if it can."""
        if self._table.settings.leaving != "violation":
            return "leaving the workspace counts as safe"
        if not self._sets.covered():
            return "there may be safe states outside of the grid"
        return ""

    def upper(self, progress: Progress | None) -> list[Deficit]:
        """Return the largest deficits of the upper envelope at the instants 0, ..., K - 1."""
        sets, values = self._sets, self._table.upper
        rows = np.flatnonzero(sets.touches)
        ending, last = sets.may_end[rows], len(values) - 1
        low, high = sets.corners(rows)
        images = self._chain.images((low, high), self._scanned.boxes[0])
        # No expected value is above 1, nor has one to be looked at where the envelope is 1.
        known = np.full((len(rows), len(self._scanned.values)), 1.0)

        def deficits(row: int, after: int) -> np.ndarray:
            wanted = values[row, rows].astype(np.float64)
            # Bounds of later instants hold as long as the values that they are of do not rise.
            if after < last and not (values[after] <= values[after + 1]).all():
                known[:] = 1.0
            ahead = self._chain.ahead(values[after], sets.touches, -1)
            for first, end in _parts(len(rows), known.shape[1]):
                part = slice(first, end)
                open_ = (known[part] > wanted[part, None] + _SMALL) & ~ending[part, None]
                own, chosen = np.nonzero(open_)
                own += first
                found = -self._chain.bounds(ahead, images, own, chosen)
                known[own, chosen] = np.minimum(known[own, chosen], found)
            found = known.max(axis=1) - wanted
            return np.maximum(found, 1.0 - values[last, rows]) if after == last else found

        return self._swept(values, rows, deficits, progress)

    def _swept(
        self,
        values: np.ndarray,
        rows: np.ndarray,
        deficits: Callable[[int, int], np.ndarray],
        progress: Progress | None,
    ) -> list[Deficit]:
        found: list[Deficit] = []
        first, steps = self._table.first, self._table.steps
        for k in range(steps - 1, -1, -1):
            row, after = max(k - first, 0), max(k + 1 - first, 0)
            if row == after and found and k < first - 1:
                found.append(found[-1]._replace(k=k))
                continue
            if len(rows):
                each = deficits(row, after)
                worst = int(each.argmax())
                amount = float(each[worst])
                # A difference of floats is off by half of its last place.
                amount = amount * (1.0 + 2.0**-52) if amount > 0.0 else 0.0
                found.append(Deficit(amount, k, int(rows[worst])))
            else:
                found.append(Deficit(0.0, k, -1))
            if progress:
                progress((steps - k) / steps)
        return found[::-1]


class _Witness:
    """An input for each cell that keeps its value, found by trying.

    Args:
        chain: of the problem.
        cells: their numbers.
        scanned: inputs.
    """

    def __init__(self, chain: ProvedChain, cells: np.ndarray, scanned: ScannedInputs) -> None:
        self._chain, self._count, self._scanned = chain, len(cells), scanned
        self._images: ProvedImages = chain.images(chain.sets.corners(cells), scanned.ends[0])
        self._chosen = np.zeros(len(cells), dtype=np.int64)
        self._boxes = int(np.prod(self._images.shape))
        found = [
            self._images.windows(np.arange(a, b), self._chosen[a:b])
            for a, b in _parts(len(cells), self._boxes)
        ]
        self._windows = Windows(
            *(np.concatenate(each, axis=1) for each in zip(*found, strict=True))
        )
        self._groups: list[Groups | None] = [None] * len(found)

    def deficits(self, ahead: Bordered, wanted: np.ndarray) -> np.ndarray:
        """Return how much the bounds of the expected values fall short of those that are wanted.

        Args:
            ahead: values of the next instant.
            wanted: values of the cells, shape (B,).
        """
        found = np.empty(self._count)
        for i, (first, end) in enumerate(_parts(self._count, self._boxes)):
            part = slice(first * self._boxes, end * self._boxes)
            groups = self._groups[i]
            if groups is None:
                own = Windows(self._windows.first[:, part], self._windows.last[:, part])
                groups = self._groups[i] = self._chain.groups(own)
            bound = self._chain.of_groups(ahead, groups, self._images.shape)
            found[first:end] = wanted[first:end] - bound
            found[first:end][wanted[first:end] <= 0.0] = 0.0
            failing = first + np.flatnonzero(found[first:end] > _SMALL)
            if failing.size:
                self._search(ahead, wanted, failing, found)
        return found

    def _search(
        self, ahead: Bordered, wanted: np.ndarray, failing: np.ndarray, found: np.ndarray
    ) -> None:
        """Try other inputs for cells that fall short: those next to the last one, then all."""
        near, tried = self._scanned.neighbours, len(self._scanned.values)
        for i in range(near.shape[1] + tried):
            if not failing.size:
                break
            if i < near.shape[1]:
                chosen = near[self._chosen[failing], i]
            else:
                chosen = np.full(len(failing), i - near.shape[1])
            cells, chosen = failing[chosen >= 0], chosen[chosen >= 0]
            bound = self._chain.bounds(ahead, self._images, cells, chosen)
            short = wanted[cells] - bound
            better = short < found[cells]
            if better.any():
                self._choose(cells[better], chosen[better])
                found[cells[better]] = short[better]
            failing = failing[found[failing] > _SMALL]

    def _choose(self, cells: np.ndarray, chosen: np.ndarray) -> None:
        self._chosen[cells] = chosen
        windows = self._images.windows(cells, chosen)
        places = (cells[:, None] * self._boxes + np.arange(self._boxes)).ravel()
        for kept, given in zip(self._windows, windows, strict=True):
            kept[:, places] = given
        size = _parts_size(self._boxes)
        for i in np.unique(cells // size):
            self._groups[i] = None


def _parts_size(each: int) -> int:
    return max(1, _BOXES_AT_ONCE // each)


def _parts(count: int, each: int) -> Iterator[tuple[int, int]]:
    size = _parts_size(each)
    for first in range(0, count, size):
        yield first, min(first + size, count)


TOLERANCE = 1e-6
"""Largest e_k of a table that is not refused."""


class TableRefusedError(ConfigurationError):
    """A table is no envelope: an inequality fails on a cell."""


@dataclass(frozen=True)
class TableCheck:
    """What was proved of a table.

    Attributes:
        lower: the sum of all e_k of the lower envelope: what is to be taken off it.
        upper: the same for the upper envelope, to be added to it; None where it was not checked.
        later: the sum without e_0, which is to be taken off a look-ahead at the first instant.
        unchecked: why the upper envelope was not checked; "" where it was.
        assumed: what is taken for granted besides the derivation of the chain; "" for nothing.
        seconds: that the check took.
    """

    lower: float
    upper: float | None
    later: tuple[float, float | None]
    unchecked: str
    assumed: str
    seconds: float


def check_table(
    table: ValueTable, problem: SafetyProblem, upper: bool = True, progress: Progress | None = None
) -> TableCheck:
    """Prove the envelopes of a table.

    Args:
        table: of the problem.
        problem: the problem.
        upper: whether the upper envelope is checked as well, which takes longer.
        progress: called with the part of the work that is done.

    Returns:
        What is to be taken off the lower envelope, and added to the upper one.

    Raises:
        TableRefusedError: An inequality fails on a cell by more than `TOLERANCE`.
        ConfigurationError: The table is of another problem, or of one that is not supported.
    """
    begun = time.perf_counter()
    settings = table.settings
    small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
    if small.fingerprint != table.fingerprint:
        raise ConfigurationError(
            f"the table is of another problem ({table.problem}, or other parameters, bounds or"
            f" periods) than {problem.name}; compute one for this problem"
        )
    if table.steps != small.steps:
        raise ConfigurationError(
            f"the table has {table.steps} steps, and {problem.name} has {small.steps}"
        )
    for values in (table.lower, table.upper):
        # NaN is not <= 1.
        if values.shape[1] != table.grid.cells or not (values.min() >= 0.0 and values.max() <= 1.0):
            raise TableRefusedError(
                f"the table of {table.problem} is refused: its values are not in [0, 1], one for"
                " each cell; compute it again"
            )
    sweeps = ProvedSweeps(table, ProvedChain(small, settings.leaving, table.grid))
    share = 0.5 if upper else 1.0
    losses = _required("lower", sweeps.lower(_scaled(progress, 0.0, share)), table)
    gains, unchecked = None, "it was not asked for"
    if upper:
        unchecked = sweeps.obstacle()
    if not unchecked:
        gains = _required("upper", sweeps.upper(_scaled(progress, share, 1.0 - share)), table)
    return TableCheck(
        lower=_total(losses),
        upper=None if gains is None else _total(gains),
        later=(_total(losses[1:]), None if gains is None else _total(gains[1:])),
        unchecked=unchecked,
        assumed="" if problem.frame is None or small.note else "the frame that is declared",
        seconds=time.perf_counter() - begun,
    )


def check_table_file(
    path: Path | str,
    problem: SafetyProblem,
    upper: bool = True,
    progress: Progress | None = None,
) -> TableCheck:
    """Prove the envelopes of a table in a file; see `check_table`.

    Args:
        path: of the file.
        problem: whose values it holds.
        upper: whether the upper envelope is checked as well.
        progress: called with the part of the work that is done.

    Returns:
        What is to be taken off the lower envelope, and added to the upper one.

    Raises:
        ValueFileError: The file is damaged, or holds no table of the problem.
        TableRefusedError: An inequality fails on a cell by more than `TOLERANCE`.
        ConfigurationError: Such tables are not checked.
    """
    return check_table(load_table(path, problem), problem, upper, progress)


def _required(envelope: str, found: list[Deficit], table: ValueTable) -> list[float]:
    """Return e_k of an envelope; raise `TableRefusedError` if one of them is too large."""
    worst = max(found, key=lambda each: each.amount)
    if not worst.amount <= TOLERANCE:
        low, high = table.grid.corners(np.array([worst.cell]))
        place = " x ".join(f"[{a[0]:.6g}, {b[0]:.6g}]" for a, b in zip(low, high, strict=True))
        raise TableRefusedError(
            f"the table of {table.problem} is refused: at k = {worst.k} on cell {worst.cell},"
            f" {place}, the {envelope} envelope is off by {worst.amount:.3g}; compute it again"
        )
    return [each.amount for each in found]


def _total(deficits: list[float]) -> float:
    return math.nextafter(math.fsum(deficits), math.inf) if any(deficits) else 0.0


def _scaled(progress: Progress | None, begin: float, share: float) -> Progress | None:
    return progress and (lambda done: progress(begin + share * done))


_LITTLE_WORK = 20_000_000
"""Images of starts under boxes of inputs that take some seconds."""


class ProvedStarts:
    """Bounds the value at starts, for certain.

    Args:
        table: of the problem.
        problem: the problem.
        check: of the table.
        look_ahead: of the table, which proposes inputs.

    Attributes:
        most_starts: for which bounds take some seconds.
        noise_boxes: number of boxes into which the noise of a step is divided.
    """

    def __init__(
        self, table: ValueTable, problem: SafetyProblem, check: TableCheck, look_ahead: LookAhead
    ) -> None:
        settings = table.settings
        small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
        self._chain = ProvedChain(small, settings.leaving, table.grid)
        self._scanned = scanned_inputs(small.box, settings.inputs)
        expressions = [c.expression for c in small.coordinates]
        self._coordinates = interval_function(problem.plant.states, expressions)
        self._check, self._look_ahead = check, look_ahead
        after, sets = table.lower[max(1 - table.first, 0)], self._chain.sets
        self._below = self._chain.ahead(after, sets.inside, 1)
        self._above = None
        if check.upper is not None:
            after = table.upper[max(1 - table.first, 0)]
            self._above = self._chain.ahead(after, sets.touches, -1)
        self.noise_boxes = look_ahead.noise_boxes
        work = len(self._scanned.values) * self.noise_boxes * self._chain.step.scenarios
        self.most_starts = max(1000, _LITTLE_WORK // work)

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return certified bounds of the value at starts; the upper one is 1 where unchecked.

        Args:
            x: n components of the states, (B,).

        Returns:
            Lower and upper bounds, shape (B,).
        """
        count = len(x[0])
        found = self._coordinates(x)
        low = [np.broadcast_to(q.low, count) for q in found]
        high = [np.broadcast_to(q.high, count) for q in found]
        inside, touches, _, _ = self._chain.sets.read(low, high)
        proposed = self._look_ahead.scanned(np.zeros(count, dtype=np.int64), x).argmax(axis=1)
        images = self._chain.images((low, high), self._scanned.ends[0])
        lower = self._chain.bounds(self._below, images, np.arange(count), proposed)
        lower = np.where(inside, _less(lower, self._check.later[0]), 0.0)
        upper = np.ones(count)
        taken = self._check.later[1]
        if self._above is not None and taken is not None:
            images = self._chain.images((low, high), self._scanned.boxes[0])
            largest = np.zeros(count)
            for u in range(len(self._scanned.values)):
                chosen = np.full(count, u)
                bound = -self._chain.bounds(self._above, images, np.arange(count), chosen)
                np.maximum(largest, bound, out=largest)
            upper = np.where(touches, -_less(-largest, taken), 0.0)
        return lower.clip(0.0, 1.0), upper.clip(0.0, 1.0)


def _less(bounds: np.ndarray, taken: float) -> np.ndarray:
    found = bounds - taken
    return found - np.abs(found) * _UNIT
