"""The range of a state to show first, where neither workspace nor sampling domain bounds it."""

from __future__ import annotations

import math

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Range, nice_step
from safe_envs.rendering.safe_set import Barriers

_DRAWN = 64
_HALF_POWERS = range(-16, 27)
"""Powers k of the reaches 2^(k/2), in the unit of the state, that are tried: .004 to 8192."""

_SPARE = 1.25


def first_range(problem: SafetyProblem, i: int) -> Range:
    """Return a range around the starts and the nearest edge of the safe set along a state.

    Args:
        problem: with starts and barriers.
        i: index of the state.

    Returns:
        A range with round ends.
    """
    starts = problem.starts[problem.start].proposals(_DRAWN)
    low, high, middle = float(starts[:, i].min()), float(starts[:, i].max()), starts.mean(axis=0)
    barriers = Barriers(problem)
    for power in _HALF_POWERS:
        reach = 2.0 ** (power / 2)
        ends = low - reach, high + reach
        if any(
            ends[0] < edge < ends[1]
            for safe in barriers.intervals(middle, i, *ends)
            for edge in safe
        ):
            return _rounded(low - _SPARE * reach, high + _SPARE * reach)
    return _rounded(low - 1.0, high + 1.0)


def _rounded(low: float, high: float) -> Range:
    step = nice_step(high - low, 5)
    return step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)
