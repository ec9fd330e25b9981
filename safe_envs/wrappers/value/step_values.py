"""What the promise filter asks of a table."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from safe_envs.dynamics.codegen import Components


class StepValues(Protocol):
    """What the filter asks of a table and its problem, for B states at control instants k (B,).

    Attributes:
        steps: K.
        inputs: those that are scanned, shape (U, m).
    """

    steps: int
    inputs: np.ndarray

    def values(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return L_k(x), shape (B,), 0 outside the safe set.

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def expected(self, k: np.ndarray, x: Components, u: np.ndarray) -> np.ndarray:
        """Return q_k(x, u), shape (B, V).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
            u: inputs in physical units, shape (B, V, m).
        """
        ...

    def scanned(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return q_k(x, u) at all scanned inputs, shape (B, U).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def best_input(self, k: np.ndarray, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs of the largest q_k, shape (B, m), and these q_k, shape (B,).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def sufficient(
        self, k: np.ndarray, x: Components, u: np.ndarray, levels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return q_k(x, u) and the caps c of next values, shapes (B,).

        A lower bound of E min(c, L_{k+1}(x')) is at least the level; c is inf where none is known.

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
            u: inputs in physical units, shape (B, m).
            levels: at most q_k(x, u), shape (B,).
        """
        ...
