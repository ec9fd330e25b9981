"""The search for the best inputs of some cells, which goes on from sweep to sweep."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from safe_envs.wrappers.value.grid_arrays import GridArrays
from safe_envs.wrappers.value.scanned_inputs import ScannedInputs
from safe_envs.wrappers.value.step_images import StepImages
from safe_envs.wrappers.value.sweeps import bellman_functions, in_parts

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
