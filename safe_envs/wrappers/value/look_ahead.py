"""What a table allows at a state: values, and bounds of the expected next value under inputs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.cell_sets import CellSets, Sets
from safe_envs.wrappers.value.expected_value_kernel import AXES
from safe_envs.wrappers.value.grid_arrays import grid_arrays
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.scanned_inputs import scanned_inputs
from safe_envs.wrappers.value.smoothing import Smoothing
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.sweeps import bellman_functions, in_parts, threads
from safe_envs.wrappers.value.table import ValueTable


class LookAhead:
    """Reads a table at states of the plant, in batches.

    Where states that are known in advance are not what the table assumes of them, as after another
    start, lower bounds are 0 and upper ones 1.

    Args:
        table: of the problem.
        problem: the problem.

    Attributes:
        steps: control periods of the table, K.
        inputs: that the table was computed with, in physical units, shape (U, m).
        box: (low, high) of each input.

    Raises:
        ConfigurationError: The table is of another problem.
    """

    def __init__(self, table: ValueTable, problem: SafetyProblem) -> None:
        settings = table.settings
        small = reduced(problem, settings.knowledge, settings.intervals)
        if small.fingerprint != table.fingerprint:
            raise ConfigurationError(
                f"the table is of another problem ({table.problem}, or other parameters, bounds or"
                f" periods) than {problem.name}; compute one for this problem"
            )
        self._table, self._reduced = table, small
        self._step, self._sets = Step(small), Sets(small, settings.leaving)
        self._smoothing = Smoothing(table.grid, self._step.blur)
        self._means = grid_arrays(self._smoothing.means)
        self._parts: CellSets | None = None
        self._functions = bellman_functions()
        self._scanned = scanned_inputs(small.box, settings.inputs)
        if not np.array_equal(self._scanned.values, table.inputs):
            # Then the largest of the scanned bounds might be below the table.
            raise ConfigurationError(
                f"the table of {table.problem} was computed with other inputs than are scanned now;"
                " compute it again"
            )
        cells = self._smoothing.means.cells
        self._ahead = {
            sign: np.empty((len(table.lower), cells), dtype=np.float32) for sign in (1, -1)
        }
        self._filled = {sign: np.zeros(len(table.lower), dtype=bool) for sign in (1, -1)}
        self.steps, self.inputs, self.box = table.steps, self._scanned.values, small.box

    @property
    def noise_boxes(self) -> int:
        """Number of boxes into which the noise of a step is divided."""
        return len(self._step.noise.weights)

    def values(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return the lower envelope at states, 0 outside the safe set.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
        """
        q = self._coordinates(x)
        cells = self._table.grid.cell_of(q)
        rows = np.maximum(np.asarray(k) - self._table.first, 0)
        inside, _ = self._sets.of_states(k, q)
        found = np.where(inside & (cells >= 0), self._table.lower[rows, cells], 0.0)
        return self._where_assumed(k, x, found)

    def expected(self, k: np.ndarray, x: Components, u: np.ndarray) -> np.ndarray:
        """Return lower bounds of the expected next value of the lower envelope.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            u: inputs in physical units, shape (B, V, m).

        Returns:
            Shape (B, V).
        """
        return self._where_assumed(k, x, self._bounds(k, x, np.stack([u, u], axis=-1), 1))

    def scanned(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return `expected` for all scanned inputs.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).

        Returns:
            Shape (B, U).
        """
        return self._where_assumed(k, x, self._bounds(k, x, self._scanned.ends, 1))

    def largest(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return upper bounds of the expected next value under any input.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).

        Returns:
            Shape (B,).
        """
        found = -self._bounds(k, x, self._scanned.boxes, -1).min(axis=1)
        return self._where_assumed(k, x, found, 1.0)

    def best_input(self, k: np.ndarray, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return the scanned inputs of the largest bound, and these bounds.

        Where the table says nothing, the upper envelope decides.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).

        Returns:
            Shapes (B, m) and (B,).
        """
        lower = self._bounds(k, x, self._scanned.ends, 1)
        chosen = lower.argmax(axis=1)
        best = np.take_along_axis(lower, chosen[:, None], axis=1)[:, 0]
        silent = np.flatnonzero(best <= 0.0)
        if silent.size:
            part = tuple(np.asarray(c)[silent] for c in x)
            upper = -self._bounds(np.asarray(k)[silent], part, self._scanned.ends, -1)
            chosen[silent] = upper.argmax(axis=1)
        return self.inputs[chosen], self._where_assumed(k, x, best)

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of the value at starts by a step of look-ahead; 0 outside the safe set.

        An episode does not end at its start: from a start in the goal it takes a step too.

        Args:
            x: n components of the states, (B,).

        Returns:
            Lower and upper bounds, shape (B,).
        """
        k = np.zeros(len(x[0]), dtype=np.int64)
        inside, _ = self.sets_at(k, x)
        lower, upper = self.scanned(k, x).max(axis=1), self.largest(k, x)
        near = self._sets.may_hold(k, self._coordinates(x))
        return np.where(inside, lower, 0.0).clip(0.0, 1.0), np.where(near, upper, 0.0).clip(0, 1)

    def sets_at(self, k: np.ndarray, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return whether states are in the safe set, and whether the episode ends in them.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
        """
        return self._sets.of_states(k, self._coordinates(x))

    def _where_assumed(
        self, k: np.ndarray, x: Components, found: np.ndarray, otherwise: float = 0.0
    ) -> np.ndarray:
        """Return what was found where known states are as the table assumes."""
        if not self._reduced.assumed:
            return found
        assumed = self._reduced.is_assumed(np.asarray(k), x)
        return np.where(assumed.reshape(-1, *[1] * (found.ndim - 1)), found, otherwise)

    def _coordinates(self, x: Components) -> list[np.ndarray]:
        found = self._reduced.of_states(x)
        size = np.broadcast_shapes(*(np.shape(c) for c in x))
        return [
            axis.wrapped(np.broadcast_to(np.asarray(c, dtype=np.float64), size))
            for axis, c in zip(self._table.grid.axes, found, strict=True)
        ]

    def _bounds(self, k: np.ndarray, x: Components, inputs: np.ndarray, sign: int) -> np.ndarray:
        """Return bounds under inputs (1 or B, V, m, 2).

        A positive sign is for the lower table, a negative one for that of the negative upper one.
        """
        k, q = np.asarray(k), self._coordinates(x)
        found = np.empty((len(k), inputs.shape[1]))
        size = max(1, _AT_ONCE // len(self._step.noise.weights))
        if len(k) > size:
            for first in range(0, len(k), size):
                part = slice(first, first + size)
                own = inputs[part] if len(inputs) > 1 else inputs
                found[part] = self._bounds(
                    k[part], tuple(np.asarray(c)[part] for c in x), own, sign
                )
            return found
        if self._step.depends_on_time:
            for instant in np.unique(k):
                rows = np.flatnonzero(k == instant)
                own = inputs[rows] if len(inputs) > 1 else inputs
                part = np.empty((len(rows), inputs.shape[1]))
                self._fill(k[rows], [c[rows] for c in q], own, sign, int(instant), part)
                found[rows] = part
        elif len(k):
            self._fill(k, q, inputs, sign, 0, found)
        return found

    def _fill(
        self,
        k: np.ndarray,
        q: Sequence[np.ndarray],
        inputs: np.ndarray,
        sign: int,
        instant: int,
        found: np.ndarray,
    ) -> None:
        rows = np.maximum(k + 1 - self._table.first, 0)
        for row, instant_ahead in zip(*np.unique(rows, return_index=True), strict=True):
            self._fill_row(int(row), sign, int(k[instant_ahead]) + 1)
        images, effects = self._step.images(q, q, inputs, instant * self._reduced.substeps)
        rest = 0.0 if sign > 0 else -(self._step.noise.rest + self._smoothing.beyond)
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
            table = self._table.lower[row] if sign > 0 else -self._table.upper[row]
            parts = self._parts
            if parts is None:
                parts = self._sets.of_cells(self._smoothing.fine, k)
            if not self._sets.depend_on_time:
                self._parts = parts
            counts = parts.inside if sign > 0 else parts.touches
            self._ahead[sign][row] = self._smoothing.smoothed(table, counts)
            self._filled[sign][row] = True


_AT_ONCE = 2_000_000

_LONG = 100_000
"""Expected values of single boxes that take longer than to start threads."""
