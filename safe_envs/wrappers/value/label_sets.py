"""Which labels of a specification the cells of a grid may have, and where episodes end in them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np

from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.problem.regions import GOAL, SAFE
from safe_envs.wrappers.value.cell_sets import halved
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.product_states import Reading
from safe_envs.wrappers.value.reduction import ReducedProblem

_HALVINGS = 2
_AT_ONCE = 1_000_000
_ROUNDING = 1e-12
"""Of the distance to the edge of the workspace, on which edges of cells lie."""

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
