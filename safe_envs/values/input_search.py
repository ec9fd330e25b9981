"""The search for the best inputs of some cells, which goes on from sweep to sweep."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Functions, Program, is_available
from safe_envs.errors import ConfigurationError, NotCompilableError
from safe_envs.values import bellman_arrays
from safe_envs.values.bellman_kernel import expected_values, sweep_lower, sweep_upper
from safe_envs.values.expected_value_kernel import AXES
from safe_envs.values.grid import Grid, GridArrays
from safe_envs.values.images import Step, StepImages
from safe_envs.values.promise_kernel import kept_values

_ALONG_EACH = {1: 41, 2: 13, 3: 7}
_FEW = 5
_MOST = 100_000


class ScannedInputs(NamedTuple):
    """Inputs, and boxes of inputs.

    Attributes:
        values: the inputs, shape (U, m), the ends of the bounds among them.
        ends: the same as boxes of one point, shape (1, U, m, 2).
        boxes: as many boxes that cover all inputs, shape (1, U, m, 2).
        neighbours: of each input, those next to it along one input, shape (U, 2 m), -1 for none.
    """

    values: np.ndarray
    ends: np.ndarray
    boxes: np.ndarray
    neighbours: np.ndarray


def scanned_inputs(box: Sequence[tuple[float, float]], number: int | None) -> ScannedInputs:
    """Return inputs on a grid within their bounds.

    Args:
        box: (low, high) of each input.
        number: of values along each input; None for one that suits.

    Raises:
        ConfigurationError: They are too many.
    """
    m = len(box)
    count = number or _ALONG_EACH.get(m, _FEW)
    if count**m > _MOST:
        raise ConfigurationError(
            f"inputs = {count}: so many values along each of the problem's inputs make {count**m};"
            f" at most {_MOST} are scanned"
        )
    values = _product([np.linspace(low, high, count) for low, high in box])
    cuts = [np.linspace(low, high, count + 1) for low, high in box]
    boxes = np.stack([_product([c[:-1] for c in cuts]), _product([c[1:] for c in cuts])], axis=-1)
    places = np.array(list(itertools.product(range(count), repeat=m)))
    neighbours = []
    for j, move in itertools.product(range(m), (-1, 1)):
        moved = places.copy()
        moved[:, j] += move
        inside = (moved[:, j] >= 0) & (moved[:, j] < count)
        flat = np.ravel_multi_index(tuple(np.clip(moved, 0, count - 1).T), (count,) * m)
        neighbours.append(np.where(inside, flat, -1))
    ends = np.stack([values, values], axis=-1)
    return ScannedInputs(values, ends[None], boxes[None], np.stack(neighbours, axis=1))


def _product(axes: Sequence[np.ndarray]) -> np.ndarray:
    return np.array(list(itertools.product(*axes)))


_PARTS = 8
"""Parts for each thread, so that all threads end at about the same time."""


def bellman_functions() -> Functions:
    """Return the entry points of `bellman_kernel`, compiled where Numba is installed."""
    entries = (expected_values, sweep_lower, sweep_upper, kept_values)
    if is_available():
        try:
            return Program("dynamic programs", entries, Source("")).compiled()
        except NotCompilableError:
            pass
    return {entry.__name__: getattr(bellman_arrays, entry.__name__) for entry in entries}


def threads() -> int:
    """Return the number of threads of a sweep."""
    return os.cpu_count() or 1


def in_parts(pool: ThreadPoolExecutor, count: int, sweep: Callable[[int, int, Any], None]) -> None:
    """Call a sweep for ranges that cover a number of cells, side by side.

    Args:
        pool: of threads.
        count: number of cells.
        sweep: takes the first cell, the one to end before, and a scratch array.
    """
    size = max(1, -(-count // (_PARTS * threads())))
    parts = [(first, min(first + size, count)) for first in range(0, count, size)]
    for done in [pool.submit(sweep, *part, np.zeros(2 * AXES)) for part in parts]:
        done.result()


def cell_images(
    step: Step, grid: Grid, numbers: np.ndarray, scanned: ScannedInputs, instant: int
) -> tuple[StepImages, StepImages]:
    """Return where cells go under single inputs, and under boxes of them.

    Args:
        step: of the problem.
        grid: of the coordinates.
        numbers: of the cells.
        scanned: inputs, and boxes of them.
        instant: at which the first sub-step begins.
    """
    low, high = grid.corners(numbers)
    single = step.images(low, high, scanned.ends, instant)
    return single, single if step.is_affine else step.images(low, high, scanned.boxes, instant)


_UNKNOWN = 2.0
"""An upper bound of all values."""


class InputSearch:
    """Bounds the largest expected values of some cells from both sides.

    Args:
        scanned: inputs that are tried.
        weights: of the boxes of noise.
        means: grid of the tables.
        pool: of threads.
        cells: number of cells.
    """

    def __init__(
        self,
        scanned: ScannedInputs,
        weights: np.ndarray,
        means: GridArrays,
        pool: ThreadPoolExecutor,
        cells: int,
    ) -> None:
        self._scanned, self._weights, self._means, self._pool = scanned, weights, means, pool
        self._functions = bellman_functions()
        self._cells = cells
        self._best = np.zeros(cells, dtype=np.int64)
        self._known = np.full((cells, len(scanned.values)), _UNKNOWN)
        self._leader = np.zeros(cells, dtype=np.int64)
        self._rival = np.full(cells, _UNKNOWN)
        self._wanted = np.ones(cells, dtype=bool)

    def forget(self) -> None:
        """Take no earlier upper bound for one."""
        self._known[:] = self._rival[:] = _UNKNOWN

    def lift(self, rise: float) -> None:
        """Keep upper bounds after the values that were swept have risen by so much at most."""
        if rise > 0.0:
            self._known += rise
            self._rival += rise

    def lower(
        self, turn: int, ahead: StepImages, table: np.ndarray, wanted: np.ndarray, found: np.ndarray
    ) -> None:
        """Find lower bounds of the largest expected values.

        Args:
            turn: number of the sweep; 0 to try all inputs.
            ahead: where single inputs lead.
            table: values on the grid of means.
            wanted: cells of which a bound is wanted, bool (cells,).
            found: holds values that are good enough, and receives the bounds, shape (cells,).
        """
        sweep, scanned = self._functions["sweep_lower"], self._scanned
        self._best = np.where(wanted, np.maximum(self._best, 0), -1)

        def swept(first: int, last: int, shifts: Any) -> None:
            sweep(
                first,
                last,
                turn,
                *ahead,
                scanned.ends,
                self._weights,
                table[None],
                0.0,
                scanned.neighbours,
                *self._means,
                shifts,
                self._best,
                found,
            )

        in_parts(self._pool, self._cells, swept)

    def upper(
        self, ahead: StepImages, table: np.ndarray, rest: float, wanted: np.ndarray
    ) -> np.ndarray:
        """Return upper bounds of the largest expected values, shape (cells,).

        Args:
            ahead: where boxes of inputs lead.
            table: negative values on the grid of means.
            rest: what the noise beyond all boxes adds to them.
            wanted: cells of which a bound is wanted, bool (cells,); of others -inf may be returned.
        """
        sweep, bounds = self._functions["sweep_upper"], np.zeros(self._cells)
        if (wanted & ~self._wanted).any():
            self.forget()
        self._wanted = wanted
        self._known[~wanted] = self._rival[~wanted] = -np.inf

        def swept(first: int, last: int, shifts: Any) -> None:
            sweep(
                first,
                last,
                *ahead,
                self._scanned.boxes,
                self._weights,
                table[None],
                rest,
                *self._means,
                shifts,
                self._known,
                self._leader,
                self._rival,
                bounds,
            )

        in_parts(self._pool, self._cells, swept)
        return bounds
