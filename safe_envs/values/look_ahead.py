"""What a table allows at a state: values, and bounds of the expected next value under inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.cells import CellSets, LabelSets, SeenSets, Sets
from safe_envs.values.expected_value_kernel import AXES
from safe_envs.values.grid import POINT_SLACK, ROUNDING, grid_arrays
from safe_envs.values.images import Step
from safe_envs.values.input_search import bellman_functions, in_parts, scanned_inputs, threads
from safe_envs.values.product_states import ProductStates
from safe_envs.values.reduction import ReducedProblem, reduced
from safe_envs.values.smoothing import Smoothing
from safe_envs.values.tables import ValueTable


class ProductTables:
    """What tables say ahead of a state of the automaton.

    Args:
        reduced: the problem, with a specification.
        leaving: see `ValueSettings`.
        smoothing: of the grid.

    Attributes:
        sets: of the specification.
        states: of the automaton.
        most: upper bound of the value outside the grid.

    Raises:
        ConfigurationError: The problem has no specification.
    """

    def __init__(self, reduced: ReducedProblem, leaving: str, smoothing: Smoothing) -> None:
        if reduced.automaton is None:
            raise ConfigurationError(f"{reduced.problem.name} has no specification; give one")
        self.sets = LabelSets(reduced, reduced.automaton.atoms, leaving)
        self.states = ProductStates(reduced.automaton)
        self.most = 0.0 if leaving == "violation" else 1.0
        self._smoothing = smoothing
        self._codes: tuple[int, np.ndarray] | None = None

    def ahead(self, k: int, state: int, values: np.ndarray, sign: int) -> np.ndarray:
        """Return bounds on the grid of means of what is read ahead of a state, float32.

        Args:
            k: control instant at which it is read.
            state: of the automaton before it.
            values: envelope at that instant, shape (L, cells).
            sign: 1 for a lower bound; -1 for one of `most` minus the value, of an upper envelope.
        """
        codes = self._codes_at(k)
        present = np.flatnonzero(np.bincount(codes))
        last = int(present[-1]) + 1
        known = np.full(last, np.inf, dtype=np.float32)
        reads = np.zeros((len(values), last), dtype=bool)
        for code in present.tolist():
            found = self.states.prospect(k, state, self.sets.readings(code))
            known[code] = min((sign * v for v in found.known), default=np.inf)
            reads[sorted(found.tables), code] = True
        least = known[codes]
        for place in np.flatnonzero(reads.any(axis=1)):
            own = self._smoothing.on_parts(np.float32(sign) * values[place])
            np.minimum(least, own, out=least, where=reads[place][codes])
        if sign < 0:
            least += np.float32(self.most)
        return self._smoothing.blurred(least)

    def _codes_at(self, k: int) -> np.ndarray:
        """Return the codes of the parts of the cells."""
        if self._codes is None or (self.sets.depend_on_time and self._codes[0] != k):
            self._codes = k, self.sets.of_cells(self._smoothing.fine, k)
        return self._codes[1]

    def first_states(self, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return the states of the automaton at starts, int array (B,).

        Args:
            q: coordinates of the starts, arrays (B,).
        """
        start = np.full(len(q[0]), self.states.automaton.initial)
        return self.next_states(np.zeros(len(q[0]), dtype=np.int64), q, start)

    def next_states(self, k: np.ndarray, q: Sequence[np.ndarray], a: np.ndarray) -> np.ndarray:
        """Return the states of the automaton after one more reading, int array (B,).

        Args:
            k: control instants of the reading, int array (B,).
            q: coordinates at these instants, arrays (B,).
            a: states of the automaton before, int array (B,).
        """
        return self.states.automaton.step(k, a, self.sets.of_states(k, q)[0])

    def settled(self, k: np.ndarray, q: Sequence[np.ndarray], a: np.ndarray) -> np.ndarray:
        """Return the values that are known without a table, NaN elsewhere; shape (B,).

        Args:
            k: control instants, int array (B,).
            q: coordinates, arrays (B,).
            a: states of the automaton after their reading, int array (B,).
        """
        automaton = self.states.automaton
        _, ends, lost = self.sets.of_states(k, q)
        verdict = automaton.verdict(k, a)
        found = np.where(verdict == 0, np.nan, (verdict + 1) / 2)
        return np.where(lost, 0.0, np.where(ends, automaton.accepting[a], found))

    def values(
        self, table: ValueTable, k: np.ndarray, q: Sequence[np.ndarray], a: np.ndarray | None
    ) -> np.ndarray:
        """Return the lower envelope, 0 outside the grid; shape (B,).

        Args:
            table: of the specification.
            k: control instants, int array (B,).
            q: coordinates, arrays (B,).
            a: states of the automaton after their reading, int array (B,); None for those of
                starts.
        """
        a = self.first_states(q) if a is None else np.asarray(a)
        found, cells = self.settled(k, q, a), table.grid.cell_of(q)
        open_ = np.isnan(found)
        rows = np.maximum(k - table.first, 0)
        places = self.states.place[a] * table.grid.cells + cells
        values = table.lower[rows, np.where(open_, places, 0)]
        return np.where(open_, np.where(cells >= 0, values, 0.0), found)


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


class TableParts(NamedTuple):
    """What a look-ahead reads, for those who write it as code.

    Attributes:
        table: the table.
        reduced: the problem in few coordinates.
        step: a step of it.
        bounds: of the expected next value.
        leaving: see `ValueSettings`.
    """

    table: ValueTable
    reduced: ReducedProblem
    step: Step
    bounds: ExpectedBounds
    leaving: str


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
        """Return bounds under inputs (1 or B, V, m, 2)."""
        # A positive sign is for the lower table, a negative one for that of the negative upper one.
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


_STARTS = {1: 600_000, 50: 50_000}
_FEWEST = 20_000
"""Starts by the number of boxes of noise up to which a look ahead is fast enough for so many."""

_DOUBT = 1e-4
"""Chance that the mean over all starts lies outside the interval of the drawn ones."""

_MOST_ROUNDS = 200


class BoundsStarts(Protocol):
    """What bounds the value at starts.

    Attributes:
        noise_boxes: number of boxes into which the noise of a step is divided.
    """

    noise_boxes: int

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of the value at states x, arrays of one shape."""
        ...


class StartValues(NamedTuple):
    """Largest probability to stay safe, as a mean over the starts of a problem.

    Attributes:
        lower: a lower bound of it.
        upper: an upper bound of it.
        starts: that were drawn; 1 where all episodes begin in one state.
        margin: by which both bounds are widened, since only some starts were drawn.
    """

    lower: float
    upper: float
    starts: int
    margin: tuple[float, float]


def start_values(
    look_ahead: BoundsStarts, problem: SafetyProblem, seed: int = 0, most: int | None = None
) -> StartValues:
    """Return bounds of the mean value over the starts, by a step of look-ahead from each.

    Where starts are random, the bounds hold with a confidence of 99.99 %, by an empirical Bernstein
    inequality.

    Args:
        look_ahead: of the problem's table.
        problem: the problem.
        seed: of the starts that are drawn.
        most: how many are drawn at most; None for as many as a look ahead is fast enough for.

    Source: A. Maurer, M. Pontil, Empirical Bernstein bounds and sample variance penalization, COLT
        2009, Theorem 4.
    """
    boxes = look_ahead.noise_boxes
    count = next((n for most, n in _STARTS.items() if boxes <= most), _FEWEST)
    x = draw_starts(problem, min(count, most or count), seed)
    lower, upper = look_ahead.start_bounds(x)
    below, above = sampling_margin(lower), sampling_margin(upper)
    return StartValues(
        max(0.0, float(lower.mean()) - below),
        min(1.0, float(upper.mean()) + above),
        len(lower),
        (below, above),
    )


def draw_starts(problem: SafetyProblem, count: int, seed: int) -> Components:
    """Draw start states of a problem.

    Args:
        problem: the problem.
        count: how many; one where all are the same.
        seed: of the draw.

    Returns:
        n components, arrays of one length.

    Raises:
        ConfigurationError: The condition of the starts is hardly ever met.
    """
    start = problem.starts[problem.start]
    count = count if start.uniforms else 1
    state = compile_function(start.uniforms, start.state, "arrays")
    accept = None
    if start.condition is not None:
        condition = (problem.model.numeric(start.condition),)
        accept = BarrierFunction(problem.model.states, condition, "arrays")
    rng, found, missing = np.random.default_rng(seed), [], count
    for _ in range(_MOST_ROUNDS):
        uniforms = rng.random((len(start.uniforms), count))
        x = np.stack([np.broadcast_to(c, count) for c in state(*uniforms)])
        if accept is not None:
            x = x[:, np.broadcast_to(accept(*x)[0] > 0.0, count)]
        found.append(x[:, :missing])
        missing -= found[-1].shape[1]
        if missing == 0:
            return tuple(np.concatenate(found, axis=1))
    raise ConfigurationError(
        f"the starts {problem.start!r} of {problem.name} hardly ever meet their condition"
    )


def sampling_margin(values: np.ndarray) -> float:
    """Return how far the mean of all values may be from that of a sample, at 99.99 % confidence.

    Args:
        values: of the sample, in [0, 1], shape (B,); one value is that of all starts.

    Source: see `start_values`.
    """
    n = len(values)
    if n == 1:
        return 0.0
    doubt = math.log(4.0 / _DOUBT)
    return math.sqrt(2.0 * float(values.var(ddof=1)) * doubt / n) + 7.0 * doubt / (3.0 * (n - 1))
