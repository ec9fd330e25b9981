"""What tables over the states of a problem and those of an automaton say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.value.label_sets import LabelSets
from safe_envs.wrappers.value.product_states import ProductStates
from safe_envs.wrappers.value.reduction import ReducedProblem
from safe_envs.wrappers.value.smoothing import Smoothing
from safe_envs.wrappers.value.table import ValueTable


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
