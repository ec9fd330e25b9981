"""Statistics of episodes, in memory that does not grow with their number."""

from __future__ import annotations

import numpy as np

_KEPT = 65_536


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for the probability of success of independent trials.

    Args:
        successes: how many of the trials succeeded.
        trials: at least 1.
        confidence: of the two-sided interval.
    """
    from scipy.stats import binomtest

    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


class RunningSum:
    """Sum of values in the order given: the same to the last bit, in whatever portions they come."""

    def __init__(self) -> None:
        self.total = 0.0

    def add(self, values: np.ndarray) -> None:
        """Add values, shape (B,), one after the other."""
        # cumsum is sequential, where sum() would pair the values up by position.
        self.total = float(np.cumsum(np.concatenate(([self.total], values)))[-1])


class FirstValues:
    """The first 65536 values: of independent ones they give the quantiles well enough."""

    def __init__(self) -> None:
        self._parts: list[np.ndarray] = []
        self._count = 0

    def add(self, values: np.ndarray) -> None:
        """Keep the values, shape (B,), as far as there is room."""
        kept = values[: _KEPT - self._count]
        if kept.size:
            self._parts.append(kept.copy())
            self._count += kept.size

    def quantiles(self, levels: tuple[float, ...]) -> list[float]:
        """Quantiles at the levels in [0, 1]."""
        return np.quantile(np.concatenate(self._parts), levels).tolist()


def share(part: float, whole: float) -> float | None:
    """Return part / whole, or None where there is nothing to share."""
    return part / whole if whole else None
