"""By how much the inequalities of a table's envelopes fail, at most, at each control instant."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.value.proved_chain import ProvedChain
from safe_envs.wrappers.value.proved_steps import ProvedImages
from safe_envs.wrappers.value.scanned_inputs import ScannedInputs, scanned_inputs
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.windows import Bordered, Groups, Windows

Progress = Callable[[float], None]

_AT_ONCE = 4_000_000

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
    return max(1, _AT_ONCE // each)


def _parts(count: int, each: int) -> Iterator[tuple[int, int]]:
    size = _parts_size(each)
    for first in range(0, count, size):
        yield first, min(first + size, count)
