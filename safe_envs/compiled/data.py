"""The numbers of a compiled program, which are given to it at every call.

Problems that differ in their numbers alone share one compiled program.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


class Data:
    """Numbers that a program reads at fixed places of one array."""

    def __init__(self) -> None:
        self._values: list[float] = []

    def add(self, values: Iterable[float]) -> int:
        """Append numbers and return the place of the first one."""
        first = len(self._values)
        self._values.extend(float(value) for value in values)
        return first

    def array(self) -> np.ndarray:
        """Return all numbers, float64."""
        return np.array(self._values, dtype=np.float64)
