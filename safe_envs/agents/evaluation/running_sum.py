"""Sums that do not depend on the portions in which the values come."""

from __future__ import annotations

import math

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


class RunningMean:
    """Mean of values and its standard error, the same to the last bit in any portions.

    Attributes:
        count: number of values.
    """

    def __init__(self) -> None:
        self.count = 0
        self._sum, self._squares = RunningSum(), RunningSum()

    def add(self, values: np.ndarray) -> None:
        """Add values, shape (B,), one after the other."""
        self._sum.add(values)
        self._squares.add(values**2)
        self.count += len(values)

    @property
    def mean(self) -> float | None:
        """The mean; None without values."""
        return self._sum.total / self.count if self.count else None

    @property
    def error(self) -> float:
        """The standard error of the mean as that over all values there might be; 0 of one value."""
        if self.count < 2 or not self._sum.total:
            return 0.0
        mean = self._sum.total / self.count
        variance = (self._squares.total - self.count * mean**2) / (self.count - 1)
        # What rounding leaves of the variance of equal values is none.
        return math.sqrt(variance / self.count) if variance > 1e-12 * mean**2 else 0.0
