"""Several identifications of one filter as one, with intervals over these and over episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.safety_curve import Curve
from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval

_MEANS = (
    "min_h_median",
    "min_h_p05",
    "intervention_rate",
    "infeasible_rate",
    "effort_mean",
    "return_mean",
)
_SUMS = ("episodes", "safe", "violations", "touching", "below_rounding")


def pooled(summaries: Sequence[EpisodeSummary], confidence: float) -> EpisodeSummary:
    """Return several identifications on the same episodes as one: sums, means, and intervals.

    Args:
        summaries: one for each identification.
        confidence: of the intervals, which are over identifications and episodes.
    """
    first = summaries[0]
    if len(summaries) == 1:
        return first
    rates = [each.safety_rate for each in summaries]
    low, high = interval_over(rates, first.episodes, confidence)
    sums: dict[str, Any] = {key: sum(getattr(s, key) for s in summaries) for key in _SUMS}
    means: dict[str, Any] = {key: _mean([getattr(s, key) for s in summaries]) for key in _MEANS}
    return EpisodeSummary(
        **sums,
        **means,
        worst_below_rounding=max(each.worst_below_rounding for each in summaries),
        safety_rate=math.fsum(rates) / len(rates),
        ci_low=low,
        ci_high=high,
        curve=_curve([each.curve for each in summaries], first.episodes, confidence),
    )


def interval_over(rates: Sequence[float], episodes: int, confidence: float) -> tuple[float, float]:
    """Return the interval of the mean rate of identifications evaluated on the same episodes.

    Args:
        rates: one for each identification.
        episodes: number of the episodes.
        confidence: of the interval.
    """
    mean = math.fsum(rates) / len(rates)
    safe = round(mean * episodes)
    return repeated_interval(
        rates, rate_interval(safe, episodes, confidence), confidence, (0.0, 1.0)
    )


def _curve(curves: Sequence[Curve], episodes: int, confidence: float) -> Curve:
    rates = np.array([curve.rate for curve in curves])
    intervals = [interval_over(column.tolist(), episodes, confidence) for column in rates.T]
    return Curve(
        curves[0].time,
        np.sum([curve.safe for curve in curves], axis=0).tolist(),
        rates.mean(axis=0).tolist(),
        [low for low, _ in intervals],
        [high for _, high in intervals],
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None
