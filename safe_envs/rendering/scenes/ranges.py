"""The part of a state's axis to look at first, where neither a workspace nor an exploration says
it."""

from __future__ import annotations

import math

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Range, nice_step
from safe_envs.rendering.safe_set import Barriers

_DRAWN = 64
_HALF_POWERS = range(-16, 27)
"""The reaches that are tried are 2^(k/2) in the unit of the state: from a few thousandths to some
thousands."""

_SPARE = 1.25


def first_range(problem: SafetyProblem, i: int) -> Range:
    """A range with round ends around the starts and the edge of the safe set that is nearest to
    them along a state.

    Args:
        problem: whose starts and barriers are looked at.
        i: index of the state.
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
