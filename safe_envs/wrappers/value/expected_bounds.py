"""Bounds of the expected next value at states, from tables smoothed where they are read."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from safe_envs.wrappers.value.cell_sets import CellSets, Sets
from safe_envs.wrappers.value.expected_value_kernel import AXES
from safe_envs.wrappers.value.grid_arrays import grid_arrays
from safe_envs.wrappers.value.product_tables import ProductTables
from safe_envs.wrappers.value.smoothing import Smoothing
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.sweeps import bellman_functions, in_parts, threads
from safe_envs.wrappers.value.table import ValueTable

_AT_ONCE = 2_000_000

_LONG = 100_000
"""Expected values of single boxes that take longer than to start threads."""


class ExpectedBounds:
    """Bounds of the expected next value under inputs.

    Args:
        table: of the problem.
        step: of the problem.
        smoothing: of the table's grid.
        sets: of the problem; or of its specification, with the states of the automaton.
    """

    def __init__(
        self, table: ValueTable, step: Step, smoothing: Smoothing, sets: Sets | ProductTables
    ) -> None:
        self._table, self._step, self._smoothing, self._sets = table, step, smoothing, sets
        self._substeps = step.substeps
        self._rest = -(step.noise.rest + smoothing.beyond)
        if isinstance(sets, ProductTables) and sets.most:
            self._rest = 0.0
        self._means = grid_arrays(smoothing.means)
        self._parts: CellSets | None = None
        self._functions = bellman_functions()
        shape = len(table.lower) * table.states, smoothing.means.cells
        self._ahead = {sign: np.empty(shape, dtype=np.float32) for sign in (1, -1)}
        self._filled = {sign: np.zeros(shape[0], dtype=bool) for sign in (1, -1)}

    def bounds(
        self,
        k: np.ndarray,
        q: Sequence[np.ndarray],
        inputs: np.ndarray,
        sign: int,
        places: np.ndarray,
    ) -> np.ndarray:
        """Return bounds under inputs, shape (B, V).

        Args:
            k: control instants before K, int array (B,).
            q: coordinates, arrays (B,).
            inputs: boxes of inputs, shape (1 or B, V, m, 2).
            sign: 1 for lower bounds, of the lower envelope; -1 for those of the negative upper one,
                or of 1 minus the upper one where the workspace may be left with a specification.
            places: of the states of the automaton among those with tables, int array (B,).
        """
        found = np.empty((len(k), inputs.shape[1]))
        size = max(1, _AT_ONCE // len(self._step.noise.weights))
        if len(k) > size:
            for first in range(0, len(k), size):
                part = slice(first, first + size)
                own = inputs[part] if len(inputs) > 1 else inputs
                found[part] = self.bounds(k[part], [c[part] for c in q], own, sign, places[part])
            return found
        if self._step.depends_on_time:
            for instant in np.unique(k):
                rows = np.flatnonzero(k == instant)
                own = inputs[rows] if len(inputs) > 1 else inputs
                part = np.empty((len(rows), inputs.shape[1]))
                self._fill(
                    (k[rows], places[rows]), [c[rows] for c in q], own, sign, int(instant), part
                )
                found[rows] = part
        elif len(k):
            self._fill((k, places), q, inputs, sign, 0, found)
        return found

    @property
    def sees_values(self) -> bool:
        """Whether boxes of noise show what values the next states have, and not only their mean."""
        return not any(self._step.blur)

    def caps(
        self,
        k: np.ndarray,
        q: Sequence[np.ndarray],
        inputs: np.ndarray,
        levels: np.ndarray,
        places: np.ndarray,
    ) -> np.ndarray:
        """Return the least caps c with lower bounds of E min(c, L) that reach levels, shape (B,).

        inf where none is known.

        Args:
            k: control instants before K, int array (B,).
            q: coordinates, arrays (B,).
            inputs: one for each state, shape (B, m).
            levels: that are wanted, shape (B,).
            places: of the states of the automaton among those with tables, int array (B,).
        """
        found = np.full(len(k), np.inf)
        if not self.sees_values:
            return found
        size = max(1, _AT_ONCE // len(self._step.noise.weights))
        instants = np.unique(k) if self._step.depends_on_time else [None]
        for instant in instants:
            rows = np.arange(len(k)) if instant is None else np.flatnonzero(k == instant)
            for first in range(0, len(rows), size):
                part = rows[first : first + size]
                own = np.empty(len(part))
                ends = np.repeat(inputs[part, None, :, None], 2, axis=3)
                layers = self._layers(k[part], places[part], 1)
                images, effects = self._step.of_points(
                    [c[part] for c in q], ends, (instant or 0) * self._substeps
                )
                self._functions["least_caps"](
                    0, len(part), images, effects, ends, self._step.noise.weights, layers,
                    self._ahead[1], *self._means, np.zeros(2 * AXES),
                    np.empty(len(self._step.noise.weights)), levels[part], own,
                )  # fmt: skip
                found[part] = own
        return found

    def _layers(self, k: np.ndarray, places: np.ndarray, sign: int) -> np.ndarray:
        """Return the rows of the smoothed tables of the next instants, after filling them."""
        rows = np.maximum(k + 1 - self._table.first, 0) * self._table.states + places
        if not self._filled[sign][rows].all():
            for row, at in zip(*np.unique(rows, return_index=True), strict=True):
                self._fill_row(int(row), sign, int(k[at]) + 1)
        return rows

    def _fill(
        self,
        at: tuple[np.ndarray, np.ndarray],
        q: Sequence[np.ndarray],
        inputs: np.ndarray,
        sign: int,
        instant: int,
        found: np.ndarray,
    ) -> None:
        k, places = at
        rows = self._layers(k, places, sign)
        images, effects = self._step.of_points(q, inputs, instant * self._substeps)
        rest = 0.0 if sign > 0 else self._rest
        expected = self._functions["expected_values"]

        def sweep(first: int, last: int, shifts: np.ndarray) -> None:
            expected(
                first,
                last,
                images,
                effects,
                inputs,
                self._step.noise.weights,
                rows,
                self._ahead[sign],
                rest,
                *self._means,
                shifts,
                found,
            )

        if found.size * len(self._step.noise.weights) < _LONG:
            sweep(0, len(k), np.zeros(2 * AXES))
        else:
            with ThreadPoolExecutor(threads()) as pool:
                in_parts(pool, len(k), sweep)

    def _fill_row(self, row: int, sign: int, k: int) -> None:
        if not self._filled[sign][row]:
            instant, place = divmod(row, self._table.states)
            table = (self._table.lower if sign > 0 else self._table.upper)[instant]
            if isinstance(self._sets, ProductTables):
                state = int(self._sets.states.live[place])
                values = table.reshape(self._table.states, -1)
                found = self._sets.ahead(k, state, values, sign)
            else:
                if self._parts is None or self._sets.depend_on_time:
                    self._parts = self._sets.of_cells(self._smoothing.fine, k)
                counts = self._parts.inside if sign > 0 else self._parts.touches
                found = self._smoothing.smoothed(table if sign > 0 else -table, counts)
            self._ahead[sign][row] = found
            self._filled[sign][row] = True
