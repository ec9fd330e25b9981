"""One step backwards in time over the states of a problem and those of an automaton.

With V_{k+1}(x, b) for the states b of the automaton, the value of (x, a) is the largest expected
value, over the inputs, of what is read ahead of a at the next state x',

    U_a(x') = V_{k+1}(x', delta_{k+1}(a, l(x'))),    or 1 or 0 where the episode ends or the verdict
                                                     is known.

On a cell whose label is not known the smallest (largest) of these values stands for U_a. The rows
of tables hold the values V of states of the automaton in which a trace may be at the cell, and
from which it goes on; where it ends in the whole of a cell, they hold whether it is accepted; all
others are 0, and are not read.

Where the workspace may be left unharmed, all that lies outside of the grid has an upper bound of 1:
then the upper values are swept as 1 - V, which is 0 there.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError, shown
from safe_envs.values.grid import CELL_SLACK, ROUNDING, Grid, grid_arrays
from safe_envs.values.images import Step, StepImages, StepValues
from safe_envs.values.input_search import InputSearch, ScannedInputs, cell_images
from safe_envs.values.look_ahead import LookAhead, ProductTables
from safe_envs.values.reduction import ReducedProblem
from safe_envs.values.smoothing import Smoothing, rounded_down

Rows = tuple[np.ndarray, np.ndarray]


class _Cells(NamedTuple):
    """Where traces may be; bool arrays (L, cells) of the states of the automaton with tables.

    Attributes:
        on: where they go on.
        over: where they can only end.
    """

    on: np.ndarray
    over: np.ndarray


class SpecificationOperator:
    """One step backwards in time, for both envelopes of a specification's value.

    Args:
        reduced: the problem, with a specification.
        leaving: see `ValueSettings`.
        grid: of the coordinates.
        step: of the problem.
        scanned: inputs that are tried.
        pool: of threads.
    """

    def __init__(
        self,
        reduced: ReducedProblem,
        leaving: str,
        grid: Grid,
        step: Step,
        scanned: ScannedInputs,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._reduced, self._grid, self._step, self._scanned = reduced, grid, step, scanned
        self._smoothing = smoothing = Smoothing(grid, step.blur)
        self._tables = ProductTables(reduced, leaving, smoothing)
        self._states, self._moves = self._tables.states, step.depends_on_time
        self.is_constant = not (self._moves or self._tables.sets.depend_on_time)
        self._cells = self._reached(reduced.steps)
        self._numbers = np.arange(grid.cells)
        if self.is_constant:
            phases = [0, *self._states.automaton.begins.tolist()]
            found = [self._reached(k).on.any(axis=0) for k in phases]
            self._numbers = np.flatnonzero(np.logical_or.reduce(found))
        slack = ROUNDING if reduced.noise else CELL_SLACK
        means = grid_arrays(smoothing.means, slack, smoothing.parts)
        # What is not remembered can be shared.
        searches = len(self._states.live) if self.is_constant else 1
        self._searches = [
            InputSearch(scanned, step.noise.weights, means, pool, len(self._numbers))
            for _ in range(searches)
        ]
        self._swept: list[np.ndarray | None] = [None] * searches
        self._images: tuple[StepImages, StepImages] | None = None
        self._turn = 0

    def last(self) -> Rows:
        """Return both envelopes at the instant K, shape (L cells,)."""
        accepted = self._states.automaton.accepting[self._states.live][:, None]
        found = (accepted & (self._cells.on | self._cells.over)).astype(np.float32).reshape(-1)
        return found, found

    def changes_before(self, k: int) -> bool:
        """Return whether steps to instants before k are others than that to k."""
        phase = self._states.automaton.phase
        return not self.is_constant or phase(k + 1) != phase(1)

    def applied(self, lower: np.ndarray, upper: np.ndarray, k: int) -> Rows:
        """Return both envelopes at the instant k, shape (L cells,).

        Args:
            lower: lower envelope at the next instant.
            upper: upper one.
            k: the instant.
        """
        shape = len(self._states.live), self._grid.cells
        ahead = lower.reshape(shape), upper.reshape(shape)
        if self._images is None or self._moves:
            instant = k * self._reduced.substeps
            self._images = cell_images(
                self._step, self._grid, self._numbers, self._scanned, instant
            )
        # What is read ahead comes first: it has the sets of the next instant.
        found = [self._read(k, place, *ahead) for place in range(shape[0])]
        if not self.is_constant or self._states.automaton.phase(k) != self._states.automaton.phase(
            k + 1
        ):
            self._cells = self._reached(k)
        rows = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
        for place, tables in enumerate(found):
            self._fill(k, place, tables, ahead, rows)
        self._turn += 1
        return rows[0].reshape(-1), rows[1].reshape(-1)

    def _read(self, k: int, place: int, lower: np.ndarray, upper: np.ndarray) -> Rows | None:
        """Return what is read ahead of a state, lower and negative upper; None if that is known."""
        state = int(self._states.live[place])
        if self._states.automaton.verdict(k, state):
            return None
        around = self._smoothing.least_around
        return (
            around(self._tables.ahead(k + 1, state, lower, 1)),
            around(self._tables.ahead(k + 1, state, upper, -1)),
        )

    def _fill(self, k: int, place: int, tables: Rows | None, ahead: Rows, rows: Rows) -> None:
        """Fill both envelopes of a state of the automaton."""
        automaton, numbers = self._states.automaton, self._numbers
        state = int(self._states.live[place])
        on = self._cells.on[place]
        for row in rows:
            row[place, self._cells.over[place]] = float(automaton.accepting[state])
            if tables is None:
                row[place, on] = float(automaton.verdict(k, state) > 0)
        wanted = on[numbers]
        if tables is None or not wanted.any():
            return
        assert self._images is not None
        search, most = self._search(place, tables[1]), self._tables.most
        rest = 0.0 if most else -(self._step.noise.rest + self._smoothing.beyond)
        bounds = search.upper(self._images[1], tables[1], rest, wanted) + most
        # A value is good enough that rises as the upper bound does; where sets move, none is.
        found = np.full(len(numbers), np.inf)
        if self.is_constant:
            rise = np.maximum(bounds - ahead[1][place, numbers], 0.0)
            found = ahead[0][place, numbers] + rise
        search.lower(self._turn, self._images[0], tables[0], wanted, found)
        chosen = numbers[wanted]
        rows[0][place, chosen] = rounded_down(np.clip(found[wanted], 0.0, 1.0))
        rows[1][place, chosen] = -rounded_down(-np.clip(bounds[wanted], 0.0, 1.0))

    def _search(self, place: int, table: np.ndarray) -> InputSearch:
        """Return the search of a state, whose upper bounds are bounds for a new table."""
        if not self.is_constant:
            self._searches[0].forget()
            return self._searches[0]
        search, before = self._searches[place], self._swept[place]
        if before is not None:
            search.lift(float((before - table).max()))
        self._swept[place] = table
        return search

    def _reached(self, k: int) -> _Cells:
        """Return where traces may be at a control instant."""
        codes = self._tables.sets.of_cells(self._grid, k)
        present = np.flatnonzero(np.bincount(codes))
        live = self._states.live
        on, over = (np.zeros((len(live), int(present[-1]) + 1), dtype=bool) for _ in range(2))
        for code in present.tolist():
            going, ended = self._states.reached(k, self._tables.sets.readings(code))
            on[:, code] = [a in going for a in live.tolist()]
            over[:, code] = [a in ended for a in live.tolist()]
        return _Cells(on[:, codes], (over & ~on)[:, codes])


class ProductLookAhead:
    """Reads a table of a specification at pairs, which have the form of states.

    A pair (x, a) is n + 1 components (B,): those of the state, and the state of the automaton after
    it was read, as integers. So all that follows a table from state to state follows it from pair
    to pair; see `StepValues` for the other methods.

    Args:
        look_ahead: of a table with a specification.

    Attributes:
        steps: K.
        inputs: that are scanned, shape (U, m).
    """

    def __init__(self, look_ahead: LookAhead) -> None:
        assert look_ahead.automaton is not None
        self._ahead, self._automaton = look_ahead, look_ahead.automaton
        self.steps, self.inputs = look_ahead.steps, look_ahead.inputs

    def values(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return L_k, shape (B,); see `StepValues`."""
        return self._ahead.values(k, x[:-1], x[-1])

    def expected(self, k: np.ndarray, x: Components, u: np.ndarray) -> np.ndarray:
        """Return q_k, shape (B, V); see `StepValues`."""
        return self._ahead.expected(k, x[:-1], u, x[-1])

    def scanned(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return q_k at all scanned inputs, shape (B, U); see `StepValues`."""
        return self._ahead.scanned(k, x[:-1], x[-1])

    def best_input(self, k: np.ndarray, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs of the largest q_k, and these q_k; see `StepValues`."""
        return self._ahead.best_input(k, x[:-1], x[-1])

    def sufficient(
        self, k: np.ndarray, x: Components, u: np.ndarray, levels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return q_k of an input for each pair, and the caps of next values; see `StepValues`."""
        return self._ahead.sufficient(k, x[:-1], u, levels, x[-1])

    def starts(self, x: Components) -> Components:
        """Return the pairs in which episodes begin.

        Args:
            x: n components of their states, arrays (B,).
        """
        return (*x, self._ahead.first_states(x))

    def following(self, k: np.ndarray, x: Components, a: np.ndarray) -> Components:
        """Return the pairs that episodes have reached.

        Args:
            k: control instants at which they are there, int (B,).
            x: n components of their states, arrays (B,).
            a: states of the automaton before, int (B,).
        """
        return (*x, self._ahead.next_states(k, x, a))

    def met(self, k: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return whether the specification is met whatever follows, bool (B,).

        Args:
            k: control instants, int (B,).
            a: states of the automaton after their reading, int (B,).
        """
        return self._automaton.verdict(k, a) > 0

    def settled(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return 1 or 0 where it is settled whether the specification is met, NaN elsewhere.

        Args:
            k: control instants, int (B,).
            x: pairs, n + 1 arrays (B,).
        """
        return self._ahead.settled(k, x[:-1], x[-1])


def read_for(look_ahead: Any, specification: str) -> StepValues:
    """Return how a table is read for what is to be met.

    Args:
        look_ahead: of the table.
        specification: that episodes are to meet; "" for that of staying safe.

    Raises:
        ConfigurationError: The table is of another specification.
    """
    given = look_ahead.specification if isinstance(look_ahead, LookAhead) else ""
    given = " ".join(given.split())
    if given != specification:
        raise ConfigurationError(
            f"the table is of {shown(given or 'always safe')}, and the promise filter is to keep"
            f" {shown(specification or 'always safe')}; compute a table of this specification"
        )
    return ProductLookAhead(look_ahead) if specification else look_ahead
