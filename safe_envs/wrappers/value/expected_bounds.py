"""Bounds of the expected next value at states, from tables smoothed where they are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np

from safe_envs.wrappers.value.cell_sets import CellSets, Sets
from safe_envs.wrappers.value.expected_value_kernel import AXES
from safe_envs.wrappers.value.grid_arrays import POINT_SLACK, ROUNDING, grid_arrays
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

    Attributes:
        rest: what noise beyond all boxes adds to bounds of the negative upper envelope.
        slack: see `grid_arrays`.
        grid: of the smoothed tables.
    """

    def __init__(
        self, table: ValueTable, step: Step, smoothing: Smoothing, sets: Sets | ProductTables
    ) -> None:
        self._table, self._step, self._smoothing, self._sets = table, step, smoothing, sets
        self._substeps, self.grid = step.substeps, smoothing.means
        self.rest = -(step.noise.rest + smoothing.beyond)
        if isinstance(sets, ProductTables) and sets.most:
            self.rest = 0.0
        self.slack = ROUNDING if step.is_noisy else POINT_SLACK
        self._means = grid_arrays(smoothing.means, self.slack)
        self._parts: CellSets | None = None
        self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what a copy prepares itself: functions and smoothed tables."""
        prepared = ("_functions", "_ahead", "_filled")
        return {key: value for key, value in vars(self).items() if key not in prepared}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._prepare()

    def _prepare(self) -> None:
        """Take the compiled functions, and make room for smoothed tables."""
        self._functions = bellman_functions()
        shape = len(self._table.lower) * self._table.states, self._smoothing.means.cells
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

    def smoothed(self, sign: int) -> np.ndarray:
        """Return the smoothed tables of all instants, shape (T, cells of the grid), float32.

        Args:
            sign: see `bounds`.
        """
        found, first = np.zeros_like(self._ahead[sign]), max(1 - self._table.first, 0)
        for row in range(first, len(self._table.lower)):
            self._fill_row(row, sign, row + self._table.first)
        # No step leads to the instant 0, whose table is not smoothed.
        found[first:] = self._ahead[sign][first:]
        return found

    @cached_property
    def sees_values(self) -> bool:
        """Whether boxes of noise show what values the next states have, and not only their mean."""
        return not any(self._step.blur)

    def sufficient(
        self,
        k: np.ndarray,
        q: Sequence[np.ndarray],
        inputs: np.ndarray,
        levels: np.ndarray,
        places: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return lower bounds under inputs, and how little of the next values suffices.

        Args:
            k: control instants before K, int array (B,).
            q: coordinates, arrays (B,).
            inputs: one for each state, shape (B, m).
            levels: that are wanted, shape (B,).
            places: of the states of the automaton among those with tables, int array (B,).

        Returns:
            The bounds, and the least caps c with lower bounds of E min(c, L) that reach the levels,
            inf where none is known; shapes (B,).
        """
        ends = np.empty((len(k), 1, inputs.shape[1], 2))
        ends[:, 0, :, 0] = ends[:, 0, :, 1] = inputs
        weights = self._step.noise.weights
        count = len(k)
        if not self.sees_values or count * len(weights) > _AT_ONCE:
            return self.bounds(k, q, ends, 1, places)[:, 0], np.full(count, np.inf)
        expected, caps = np.empty(count), np.empty(count)
        instants = np.unique(k) if self._step.depends_on_time else (0,)
        for instant in instants:
            rows = np.flatnonzero(k == instant) if len(instants) > 1 else slice(None)
            own, time = ends[rows], int(instant) * self._substeps
            images, effects = self._step.of_points([c[rows] for c in q], own, time)
            found = np.empty((2, len(own)))
            layers, wanted = self._layers(k[rows], places[rows], 1), levels[rows]

            def sweep(first: int, last: int, shifts: np.ndarray) -> None:
                self._functions["kept_values"](
                    first,
                    last,
                    images,  # noqa: B023
                    effects,  # noqa: B023
                    own,  # noqa: B023
                    weights,
                    layers,  # noqa: B023
                    self._ahead[1],
                    *self._means,
                    shifts,
                    np.empty(len(weights)),
                    wanted,  # noqa: B023
                    *found,  # noqa: B023
                )

            self._spread(sweep, len(own), len(own) * len(weights))
            expected[rows], caps[rows] = found
        return expected, caps

    def _spread(self, sweep: Callable[[int, int, np.ndarray], None], count: int, work: int) -> None:
        """Call a sweep, in threads where that takes longer than to start them."""
        if work < _LONG:
            sweep(0, count, np.zeros(2 * AXES))
        else:
            with ThreadPoolExecutor(threads()) as pool:
                in_parts(pool, count, sweep)

    def _layers(self, k: np.ndarray, places: np.ndarray, sign: int) -> np.ndarray:
        """Return the places of the smoothed tables of the next instants, after filling them in."""
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
        rest = 0.0 if sign > 0 else self.rest
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

        self._spread(sweep, len(k), found.size * len(self._step.noise.weights))

    def _fill_row(self, row: int, sign: int, k: int) -> None:
        if not self._filled[sign][row]:
            instant, place = divmod(row, self._table.states)
            table = (self._table.lower if sign > 0 else self._table.upper)[instant]
            if isinstance(self._sets, ProductTables):
                state = int(self._sets.states.live[place])
                values = table.reshape(self._table.states, -1)
                found = self._sets.ahead(k, state, values, sign)
            else:
                # Threads may fill several instants at once.
                parts = self._parts or self._sets.of_cells(self._smoothing.fine, k)
                if not self._sets.depend_on_time:
                    self._parts = parts
                counts = parts.inside if sign > 0 else parts.touches
                found = self._smoothing.smoothed(table if sign > 0 else -table, counts)
            self._ahead[sign][row] = found
            self._filled[sign][row] = True
