"""Sums that do not depend on the portions in which the values come."""

from __future__ import annotations

import numpy as np


class RunningSum:
    """Sum of values in the order given, the same to the last bit in any portions."""

    def __init__(self) -> None:
        self.total = 0.0

    @classmethod
    def of(cls, values: np.ndarray) -> float:
        """Return the sum of values, shape (B,), added one after the other."""
        found = cls()
        found.add(values)
        return found.total

    def add(self, values: np.ndarray) -> None:
        """Add values, shape (B,), one after the other."""
        # cumsum is sequential, where sum() would pair the values up by position.
        self.total = float(np.cumsum(np.concatenate(([self.total], values)))[-1])
