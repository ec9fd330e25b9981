"""Tables of the lower and upper envelope of a problem's value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.settings import ValueSettings


@dataclass(frozen=True, eq=False)
class ValueTable:
    """Envelopes of a problem's value on the cells of a grid.

    The tables are of the control instants `first` to K; before `first` nothing changes any more, so
    that the first one stands for all earlier instants.

    Attributes:
        problem: its name.
        fingerprint: of the problem and of what determines its values.
        settings: what was asked for.
        grid: of the coordinates.
        inputs: that were scanned, in physical units, shape (U, m).
        first: control instant of the first one.
        lower: lower envelope, shape (K + 1 - first, cells), float32 in [0, 1]; 0 outside the grid.
            With a specification shape (K + 1 - first, states cells): the cells of each of the
            states of the automaton that are not settled, one state after the other.
        upper: upper envelope, of the same shape.
        seconds: that the computation took.
    """

    problem: str
    fingerprint: str
    settings: ValueSettings
    grid: Grid
    inputs: np.ndarray
    first: int
    lower: np.ndarray
    upper: np.ndarray
    seconds: float

    @property
    def steps(self) -> int:
        """Control periods of an episode, K."""
        return self.first + len(self.lower) - 1

    @property
    def states(self) -> int:
        """States of the automaton that the tables hold values of; 1 without a specification."""
        return self.lower.shape[1] // self.grid.cells

    @property
    def memory(self) -> int:
        """Bytes of the tables."""
        return self.lower.nbytes + self.upper.nbytes
