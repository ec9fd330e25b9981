"""Several identifications of one filter, as one row: intervals over identifications and over
episodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.rollout import Row
from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval

_MEANS = (
    "min_h_median",
    "min_h_p05",
    "intervention_rate",
    "infeasible_rate",
    "effort_mean",
    "return_mean",
)
_SUMS = ("episodes", "safe", "violations", "touching")


def pooled(rows: Sequence[Row], confidence: float) -> Row:
    """The rows of several identifications on the same episodes as one: sums, means, and intervals
    over both.
    """
    if len(rows) == 1:
        return dict(rows[0])
    episodes = rows[0]["episodes"]
    rates = [row["safety_rate"] for row in rows]
    low, high = interval_over(rates, episodes, confidence)
    return {
        **{key: sum(row[key] for row in rows) for key in _SUMS},
        **{key: _mean([row[key] for row in rows]) for key in _MEANS},
        "safety_rate": math.fsum(rates) / len(rates),
        "ci_low": low,
        "ci_high": high,
        "curve": _curve([row["curve"] for row in rows], episodes, confidence),
    }


def interval_over(rates: Sequence[float], episodes: int, confidence: float) -> tuple[float, float]:
    """Interval of the mean rate of identifications that were all evaluated on the same episodes."""
    mean = math.fsum(rates) / len(rates)
    safe = round(mean * episodes)
    return repeated_interval(
        rates, rate_interval(safe, episodes, confidence), confidence, (0.0, 1.0)
    )


def _curve(
    curves: Sequence[dict[str, list[Any]]], episodes: int, confidence: float
) -> dict[str, list[Any]]:
    rates = np.array([curve["rate"] for curve in curves])
    intervals = [interval_over(column.tolist(), episodes, confidence) for column in rates.T]
    return {
        "time": curves[0]["time"],
        "safe": np.sum([curve["safe"] for curve in curves], axis=0).tolist(),
        "rate": rates.mean(axis=0).tolist(),
        "ci_low": [low for low, _ in intervals],
        "ci_high": [high for _, high in intervals],
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None
