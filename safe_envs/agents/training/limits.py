"""Whether a constrained agent keeps its limit, judged by episodes of its training and after it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.training.constraint import EpisodeConstraint

COST, VIOLATION = "cost_limit", "violation_limit"
"""Names of the limits: of the expected number of unsafe steps of an episode, and of the probability
of any."""

DEFAULT_VIOLATION_LIMIT = 0.01
"""What a constrained training gets that is given no limit."""

UNITS = {COST: 1.0, VIOLATION: 0.1}
"""Units of the excess that a multiplier sees, if the limit is smaller; see `EpisodeConstraint`."""

_DEVIATIONS = 1.96
"""Standard deviations on each side of a mean in a 95 % interval."""


def judged(
    constraint: EpisodeConstraint, kind: str, evaluation: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what is known about a limit, JSON-able.

    The constraint is on the policy as it explores, so that its last episodes in training are
    judged; those of the evaluation, without exploration, too where the limit is on violations.

    Args:
        constraint: of the algorithm.
        kind: `COST` or `VIOLATION`.
        evaluation: row of the evaluation of the policy.

    Returns:
        `kind`, `limit`, the `multiplier` and whether it is `saturated`; number of `episodes` in
        training, their `mean` cost, and its 95 % interval from `low` to `high`, all None before
        every env ended an episode; `met`: False if this interval, or that of the evaluation, lies
        above the limit, otherwise True, or None as long as nothing was measured.
    """
    found = {
        "kind": kind,
        "limit": constraint.limit,
        "multiplier": constraint.value,
        "saturated": constraint.multiplier.saturated,
    }
    if not constraint.recent:
        unknown = dict.fromkeys(("mean", "low", "high", "met"))
        return found | {"episodes": 0, **unknown}
    episodes, cost, squares, violated = (
        sum(numbers) for numbers in zip(*constraint.recent, strict=True)
    )
    mean = cost / episodes
    if kind == VIOLATION:
        low, high = rate_interval(int(violated), int(episodes))
        exceeded = max(low, 1.0 - evaluation["ci_high"]) > constraint.limit
    else:
        error = math.sqrt(max(squares / episodes - mean**2, 0.0) / max(episodes - 1.0, 1.0))
        low, high = max(mean - _DEVIATIONS * error, 0.0), mean + _DEVIATIONS * error
        exceeded = low > constraint.limit
    return found | {
        "episodes": int(episodes),
        "mean": mean,
        "low": low,
        "high": high,
        "met": not exceeded,
    }


def rank(evaluation: Mapping[str, Any]) -> tuple[bool, float]:
    """Return what the best policy has most of: first that it keeps its limit, then return.

    Args:
        evaluation: row with `return_mean`, and with what is `judged` about a limit, if there is
            one.
    """
    judgement = evaluation.get("constraint") or {}
    return judgement.get("met") is not False, evaluation["return_mean"]
