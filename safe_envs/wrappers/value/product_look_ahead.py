"""What a table of a specification allows at pairs of a state and a state of its automaton."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError, shown
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.step_values import StepValues


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
