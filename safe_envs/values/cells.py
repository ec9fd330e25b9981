"""Which cells of a grid lie in the safe set, the workspace and the goal."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.enclosures.intervals import Interval, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.regions import GOAL, SAFE
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.images import Step
from safe_envs.values.product_states import Reading
from safe_envs.values.reduction import Coordinate, ReducedProblem
from safe_envs.values.smoothing import REACH

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


_NONE, _SOME, _ALL = 0, 1, 2
_OUTSIDE = "outside"


class LabelSets:
    """The sets of a reduced problem's specification as functions of boxes of its coordinates.

    The code of a cell says of each set whether its states are in it: all, some or none, as digits
    to the base of 3. The sets are those of the specification, the goal, and what lies outside of
    the workspace.

    Args:
        reduced: the problem.
        atoms: names of the sets of its specification.
        leaving: see `ValueSettings`.

    Attributes:
        depend_on_time: whether the sets do.
    """

    def __init__(self, reduced: ReducedProblem, atoms: tuple[str, ...], leaving: str) -> None:
        self._atoms = atoms
        goal = () if reduced.goal is None or GOAL in self._atoms else (GOAL,)
        self._names = (*self._atoms, *goal, _OUTSIDE)
        self._stays = leaving == "violation"
        self._known = tuple(reduced.known.values())
        self._substeps = reduced.substeps
        given = {**reduced.regions, GOAL: reduced.goal, _OUTSIDE: reduced.outside}
        parts = [reduced.barriers if name == SAFE else (given[name],) for name in self._names]
        self._counts = [len(part) for part in parts]
        expressions = [e for part in parts for e in part]
        symbols = (*reduced.symbols, *reduced.known)
        self._function = interval_function(symbols, expressions)
        used = set().union(*(e.free_symbols for e in expressions[:-1]))
        self.depend_on_time = bool(used & set(reduced.known))

    def of_cells(self, grid: Grid, k: int) -> np.ndarray:
        """Return the code of each cell of a grid, shape (cells,).

        Args:
            grid: of the coordinates.
            k: control instant.
        """
        codes = np.empty(grid.cells, dtype=np.int64)
        powers = 3 ** np.arange(len(self._names))
        for first in range(0, grid.cells, _AT_ONCE):
            cells = np.arange(first, min(first + _AT_ONCE, grid.cells))
            codes[cells] = powers @ self._classified(*grid.corners(cells), k, _HALVINGS)
        return codes

    def of_states(
        self, k: np.ndarray, q: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the readings of states as arrays (B,): label, whether they end, whether lost.

        Args:
            k: control instants, int array (B,).
            q: their coordinates, arrays (B,).
        """
        known = [values[np.asarray(k) * self._substeps] for values in self._known]
        inside = self._digits([Interval(c, c) for c in q], known, len(q[0])) == _ALL
        label = (1 << np.arange(len(self._atoms))) @ inside[: len(self._atoms)]
        left = inside[-1]
        ends = left | inside[self._names.index(GOAL)] if GOAL in self._names else left
        return label.astype(np.int64), ends, left & self._stays

    @cache  # noqa: B019 - as many codes as there are, each short
    def readings(self, code: int) -> tuple[Reading, ...]:
        """Return the readings that states with a code may have."""
        digits = [code // 3**i % 3 for i in range(len(self._names))]
        choices = [(False, True) if d == _SOME else (d == _ALL,) for d in digits]
        found = {}
        for chosen in itertools.product(*choices):
            inside = dict(zip(self._names, chosen, strict=True))
            label = sum(inside[name] << i for i, name in enumerate(self._atoms))
            left = inside[_OUTSIDE]
            found[Reading(label, left or inside.get(GOAL, False), left and self._stays)] = None
        return tuple(found)

    def _classified(
        self, low: Sequence[np.ndarray], high: Sequence[np.ndarray], k: int, halvings: int
    ) -> np.ndarray:
        """Return digits of boxes, shape (sets, B)."""
        known = [float(values[k * self._substeps]) for values in self._known]
        boxes = [Interval(a, b) for a, b in zip(low, high, strict=True)]
        found = self._digits(boxes, known, len(low[0]))
        unclear = np.flatnonzero((found == _SOME).any(axis=0))
        if halvings and unclear.size:
            unclear_boxes = [a[unclear] for a in low], [b[unclear] for b in high]
            halves = [
                self._classified(*halved(*unclear_boxes, i), k, halvings - 1)
                for i in range(2 ** len(low))
            ]
            least, most = np.minimum.reduce(halves), np.maximum.reduce(halves)
            found[:, unclear] = np.where(least == most, least, _SOME)
        return found

    def _digits(
        self, boxes: Sequence[Interval], known: Sequence[float | np.ndarray], count: int
    ) -> np.ndarray:
        values = iter(self._function([*boxes, *known]))
        digits = np.empty((len(self._names), count), dtype=np.int8)
        for i, (name, parts) in enumerate(zip(self._names, self._counts, strict=True)):
            all_, some = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
            for _ in range(parts):
                value = next(values)
                if name in (SAFE, _OUTSIDE):
                    edge = 0.0 if name == SAFE else _ROUNDING
                    all_, some = all_ & (value.low > edge), some & (value.high > edge)
                else:
                    all_, some = all_ & (value.low >= 0.0), some & (value.high >= 0.0)
            digits[i] = np.where(all_, _ALL, np.where(some, _SOME, _NONE))
        return digits


class SeenSets:
    """Judges states as the env does; in exact arithmetic a sign might be another one.

    Args:
        problem: with the barriers.
        small: the problem in few coordinates.
        leaving: see `ValueSettings`.
    """

    def __init__(self, problem: SafetyProblem, small: ReducedProblem, leaving: str) -> None:
        self._reduced = small
        barriers = [problem.plant.numeric(each.expression) for each in problem.barriers]
        self._barriers: Any = compile_function(problem.plant.states, barriers, "arrays")
        self._leaves: Any = None
        if leaving == "violation" and small.outside.free_symbols:
            symbols = (*small.symbols, *small.known)
            self._leaves = compile_function(symbols, (small.outside,), "arrays")

    def are_safe(self, k: np.ndarray, x: Components, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return whether states are safe, in the workspace where leaving it is a violation.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
            q: their coordinates, arrays (B,).
        """
        found = np.ones(len(k), dtype=bool)
        with np.errstate(all="ignore"):
            for h in self._barriers(*x):
                found = found & (h > 0.0)
            if self._leaves is not None:
                known = [each[k * self._reduced.substeps] for each in self._reduced.known.values()]
                found = found & (self._leaves(*q, *known)[0] <= 0.0)
        return found


_ALONG_EACH = {1: 256, 2: 32, 3: 10, 4: 6}
"""Cells along each axis for which it is found where the step leads."""

_GROWTH = 1.5
_FARTHEST = 1e4
"""Extents of the workspace that a step may lead away at most."""


def with_margin(small: ReducedProblem, edges: Sequence[np.ndarray], step: Step) -> list[np.ndarray]:
    """Return edges of cells that reach as far as a step leads, and wider ones the farther they are.

    Args:
        small: the problem.
        edges: along each axis, of the states from which episodes go on.
        step: of the problem.

    Raises:
        ConfigurationError: A step may lead anywhere, for all that is known.
    """
    found = []
    low, high = _ends(small, edges, step)
    for i, (c, own) in enumerate(zip(small.coordinates, edges, strict=True)):
        extent = float(own[-1] - own[0])
        reach = REACH * step.blur[i]
        below, above = float(own[0] - low[i] + reach), float(high[i] + reach - own[-1])
        if c.period:
            found.append(own)
            continue
        if not max(below, above) < _FARTHEST * extent:
            raise ConfigurationError(
                f"a step of {small.problem.name} may lead {c.symbol} very far out of the workspace,"
                " so that no grid can cover it; take leaving = 'violation', or a shorter control"
                " period"
            )
        width = float(np.median(np.diff(own)))
        found.append(
            np.concatenate(
                [own[0] - _beyond(below, width)[::-1], own, own[-1] + _beyond(above, width)]
            )
        )
    return found


def _beyond(margin: float, width: float) -> np.ndarray:
    """Return distances up to a margin at least; each is larger than the one before by more."""
    found, distance = [], 0.0
    while distance < margin:
        distance += width
        width *= _GROWTH
        found.append(distance)
    return np.array(found)


def _ends(
    small: ReducedProblem, edges: Sequence[np.ndarray], step: Step
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinates to which a step leads, but for its blur."""
    count = _ALONG_EACH[len(edges)]
    grid = Grid(tuple(Axis(np.linspace(own[0], own[-1], count + 1)) for own in edges))
    corners = grid.corners(np.arange(grid.cells))
    inputs = np.array(small.box)[None, None]
    low, high = np.full(len(edges), np.inf), np.full(len(edges), -np.inf)
    for k in range(small.steps if step.depends_on_time else 1):
        images, effects = step.images(*corners, inputs, k * small.substeps)
        products = effects[..., :, None] * inputs[:, :, None, :, None, :]
        below = products.min(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
        above = products.max(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
        low = np.minimum(low, (images[..., 0] + below).min(axis=(0, 1, 2, 3)))
        high = np.maximum(high, (images[..., 1] + above).max(axis=(0, 1, 2, 3)))
    return low, high
