"""The safety rate over time, from counts of episodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.agents.evaluation.statistics import rate_band

_MOST_INTERVALS = 200


@dataclass(frozen=True)
class Curve:
    """A safety rate over time, with its pointwise interval.

    Attributes:
        time: instants in s, at most 201.
        safe: number of episodes without a violation up to each.
        rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
    """

    time: list[float]
    safe: list[int]
    rate: list[float]
    ci_low: list[float]
    ci_high: list[float]


class CurveCounts:
    """Counts episodes that are safe so far, at instants spread over the horizon.

    Args:
        steps: number of control periods of the horizon.
    """

    def __init__(self, steps: int) -> None:
        self._instants = curve_instants(steps)
        self._lost = np.zeros(len(self._instants), dtype=np.int64)
        self._episodes = 0

    def add(self, first_violation: np.ndarray) -> None:
        """Count episodes by the control instant of their first violation, shape (E,).

        It is -1 where there is none.
        """
        reached = np.searchsorted(self._instants, first_violation[first_violation >= 0])
        self._lost += np.bincount(reached, minlength=len(self._instants))
        self._episodes += len(first_violation)

    def curve(self, dt: float, confidence: float) -> Curve:
        """Return the rate of the episodes that are safe so far.

        Args:
            dt: control period in s.
            confidence: of the intervals.
        """
        safe = self._episodes - np.cumsum(self._lost)
        low, high = rate_band(safe, self._episodes, confidence)
        columns = (self._instants * dt, safe, safe / self._episodes, low, high)
        return Curve(*(values.tolist() for values in columns))


def curve_instants(steps: int) -> np.ndarray:
    """Return the control instants of a curve, evenly spaced with both ends: at most 201."""
    return np.append(np.arange(0, steps, -(-steps // _MOST_INTERVALS)), steps)
