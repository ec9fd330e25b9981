"""What a table allows at a state: values, and bounds of the expected next value under inputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.cell_sets import Sets
from safe_envs.wrappers.value.expected_bounds import ExpectedBounds
from safe_envs.wrappers.value.product_tables import ProductTables
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.scanned_inputs import scanned_inputs
from safe_envs.wrappers.value.seen_sets import SeenSets
from safe_envs.wrappers.value.smoothing import Smoothing
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_parts import TableParts


class LookAhead:
    """Reads a table at states of the plant, in batches.

    Where known states are not what the table assumes of them, as after another start, lower bounds
    are 0 and upper ones 1.

    Args:
        table: of the problem.
        problem: the problem.

    Attributes:
        steps: control periods of the table, K.
        inputs: that the table was computed with, in physical units, shape (U, m).
        box: (low, high) of each input.
        specification: of the table; "" for that of staying safe.
        automaton: of the specification; None for the values of staying safe.
        parts: what is read, for those who write it as code.
        noise_boxes: number of boxes into which the noise of a step is divided.

    Raises:
        ConfigurationError: The table is of another problem.
    """

    def __init__(self, table: ValueTable, problem: SafetyProblem) -> None:
        settings = table.settings
        small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
        if small.fingerprint != table.fingerprint:
            raise ConfigurationError(
                f"the table is of another problem ({table.problem}, or other parameters, bounds or"
                f" periods) than {problem.name}; compute one for this problem"
            )
        self._table, self._reduced = table, small
        step = Step(small)
        smoothing = Smoothing(table.grid, step.blur)
        self._sets = Sets(small, settings.leaving)
        self.specification = settings.specification
        self.automaton, self._product, self._most = small.automaton, None, 0.0
        if small.automaton is not None:
            self._product = ProductTables(small, settings.leaving, smoothing)
            self._most = self._product.most
        self._seen = SeenSets(problem, small, settings.leaving)
        self._tables = ExpectedBounds(table, step, smoothing, self._product or self._sets)
        self.noise_boxes = len(step.noise.weights)
        self.parts = TableParts(table, small, step, self._tables, settings.leaving)
        self._scanned = scanned_inputs(small.box, settings.inputs)
        if not np.array_equal(self._scanned.values, table.inputs):
            raise ConfigurationError(
                f"the table of {table.problem} is for other inputs; compute it"
            )
        self.steps, self.inputs, self.box = table.steps, self._scanned.values, small.box

    def values(self, k: np.ndarray, x: Components, a: np.ndarray | None = None) -> np.ndarray:
        """Return the lower envelope at states, 0 outside the safe set.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
            a: states of the automaton after reading x, int (B,); by default those of starts.
        """
        k, q = np.asarray(k), self._coordinates(x)
        if self._product is not None:
            return self._product.values(self._table, k, q, a)
        values = self._values_of_cells(k, q) * self._seen.are_safe(k, x, q)
        return self._where_assumed(k, x, values)

    def expected(
        self, k: np.ndarray, x: Components, u: np.ndarray, a: np.ndarray | None = None
    ) -> np.ndarray:
        """Return lower bounds of the expected next value of the lower envelope.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            u: inputs in physical units, shape (B, V, m).
            a: states of the automaton after reading x, int (B,); by default those of starts.

        Returns:
            Shape (B, V).
        """
        return self._where_assumed(k, x, self._bounds(k, x, np.stack([u, u], axis=-1), 1, a))

    def scanned(self, k: np.ndarray, x: Components, a: np.ndarray | None = None) -> np.ndarray:
        """Return `expected` for all scanned inputs.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            a: states of the automaton after reading x, int (B,); by default those of starts.

        Returns:
            Shape (B, U).
        """
        return self._where_assumed(k, x, self._bounds(k, x, self._scanned.ends, 1, a))

    def largest(self, k: np.ndarray, x: Components, a: np.ndarray | None = None) -> np.ndarray:
        """Return upper bounds of the expected next value under any input.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            a: states of the automaton after reading x, int (B,); by default those of starts.

        Returns:
            Shape (B,).
        """
        found = self._most - self._bounds(k, x, self._scanned.boxes, -1, a).min(axis=1)
        return self._where_assumed(k, x, found, 1.0)

    def best_input(
        self, k: np.ndarray, x: Components, a: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the scanned inputs of the largest bound, and these bounds.

        Where the table says nothing, the upper envelope decides.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            a: states of the automaton after reading x, int (B,); by default those of starts.

        Returns:
            Shapes (B, m) and (B,).
        """
        lower = self._bounds(k, x, self._scanned.ends, 1, a)
        chosen = lower.argmax(axis=1)
        best = np.take_along_axis(lower, chosen[:, None], axis=1)[:, 0]
        silent = np.flatnonzero(best <= 0.0)
        if silent.size:
            part = tuple(np.asarray(c)[silent] for c in x)
            own = None if a is None else np.asarray(a)[silent]
            upper = -self._bounds(np.asarray(k)[silent], part, self._scanned.ends, -1, own)
            chosen[silent] = upper.argmax(axis=1)
        return self.inputs[chosen], self._where_assumed(k, x, best)

    def sufficient(
        self,
        k: np.ndarray,
        x: Components,
        u: np.ndarray,
        levels: np.ndarray,
        a: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `expected` of an input for each state, and how little of the next values suffices.

        Args:
            k: control instants before K, int array (B,).
            x: n components of the states, (B,).
            u: inputs in physical units, shape (B, m).
            levels: that are wanted, shape (B,).
            a: states of the automaton after reading x, int (B,); by default those of starts.

        Returns:
            q_k(x, u), and the least caps c with lower bounds of E min(c, L_{k+1}(x')) that reach
            the levels, inf where none is known; shapes (B,).
        """
        if self._product is not None:
            expected = self.expected(k, x, u[:, None, :], a)[:, 0]
            return expected, np.full(len(expected), np.inf)
        k, q = np.asarray(k), self._coordinates(x)
        places = np.zeros(len(k), dtype=np.int64)
        expected, caps = self._tables.sufficient(k, q, u, levels, places)
        return self._where_assumed(k, x, expected), self._where_assumed(k, x, caps, np.inf)

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of the value at starts by a step of look-ahead; 0 outside the safe set.

        An episode does not end at its start: from a start in the goal it takes a step too.

        Args:
            x: n components of the states, (B,).

        Returns:
            Lower and upper bounds, shape (B,).
        """
        k = np.zeros(len(x[0]), dtype=np.int64)
        if self._product is not None:
            lower, upper = self.scanned(k, x).max(axis=1), self.largest(k, x)
            return lower.clip(0.0, 1.0), upper.clip(0.0, 1.0)
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

    def settled(self, k: np.ndarray, x: Components, a: np.ndarray) -> np.ndarray:
        """Return 1 or 0 where it is settled whether a specification is met, NaN elsewhere.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
            a: states of the automaton after reading x, int array (B,).
        """
        if self._product is None:
            return np.full(len(k), np.nan)
        return self._product.settled(np.asarray(k), self._coordinates(x), a)

    def first_states(self, x: Components) -> np.ndarray:
        """Return the states of the automaton at starts; zeros without a specification.

        Args:
            x: n components of the states, (B,).
        """
        if self._product is None:
            return np.zeros(len(x[0]), dtype=np.int64)
        return self._product.first_states(self._coordinates(x))

    def next_states(self, k: np.ndarray, x: Components, a: np.ndarray) -> np.ndarray:
        """Return the states of the automaton after one more reading; as they are without one.

        Args:
            k: control instants of the reading, int array (B,).
            x: n components of the states at these instants, (B,).
            a: states of the automaton before, int array (B,).
        """
        if self._product is None:
            return a
        return self._product.next_states(np.asarray(k), self._coordinates(x), a)

    def _values_of_cells(self, k: np.ndarray, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return the lower table at coordinates between the edges; 0 outside of the grid."""
        rows = np.maximum(k - self._table.first, 0)
        cells, beyond = 0, False
        for axis, values in zip(self._table.grid.axes, q, strict=True):
            places = axis.edges.searchsorted(values, side="right") - 1
            inner = np.minimum(np.maximum(places, 0), axis.count - 1)
            beyond = beyond | ((places != inner) & (values != axis.edges[-1]))
            cells = cells * axis.count + inner
        return self._table.lower[rows, cells] * ~beyond

    def _where_assumed(
        self, k: np.ndarray, x: Components, found: np.ndarray, otherwise: float = 0.0
    ) -> np.ndarray:
        """Return what was found where known states are as the table assumes."""
        if not self._reduced.assumed:
            return found
        assumed = self._reduced.is_assumed(np.asarray(k), x)
        return np.where(assumed.reshape(-1, *[1] * (found.ndim - 1)), found, otherwise)

    def _coordinates(self, x: Components) -> list[np.ndarray]:
        size = x[0].shape
        return [
            axis.wrapped(c if c.shape == size else np.broadcast_to(c, size))
            for axis, c in zip(self._table.grid.axes, self._reduced.of_states(x), strict=True)
        ]

    def _bounds(
        self,
        k: np.ndarray,
        x: Components,
        inputs: np.ndarray,
        sign: int,
        a: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return bounds under inputs (1 or B, V, m, 2).

        A positive sign is for the lower table, a negative one for that of the negative upper one.
        """
        k, q = np.asarray(k), self._coordinates(x)
        if self._product is None:
            return self._tables.bounds(k, q, inputs, sign, np.zeros(len(k), dtype=np.int64))
        a = self._product.first_states(q) if a is None else a
        known = self._product.settled(k, q, a)
        found = np.repeat((known if sign > 0 else self._most - known)[:, None], inputs.shape[1], 1)
        rows = np.flatnonzero(np.isnan(known))
        if rows.size:
            own = inputs[rows] if len(inputs) > 1 else inputs
            places = self._product.states.place[a[rows]]
            found[rows] = self._tables.bounds(k[rows], [c[rows] for c in q], own, sign, places)
        return found
