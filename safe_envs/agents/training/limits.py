"""Whether a constrained agent keeps its limit, judged by episodes of its training and after it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.training.constraint import EpisodeConstraint
from safe_envs.errors import shown

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
        above the limit, otherwise True, or None as long as nothing was measured in training; and
        `evaluation_met`: the same for the evaluation alone, None for a limit of the cost, which it
        does not measure.
    """
    found = {
        "kind": kind,
        "limit": constraint.limit,
        "multiplier": constraint.value,
        "saturated": constraint.multiplier.saturated,
    }
    if kind == VIOLATION:
        found["evaluation_met"] = 1.0 - evaluation["ci_high"] <= constraint.limit
    else:
        found["evaluation_met"] = None
    if not constraint.recent:
        unknown = dict.fromkeys(("mean", "low", "high"))
        met = False if found["evaluation_met"] is False else None
        return found | {"episodes": 0, "met": met, **unknown}
    episodes, cost, squares, violated = (
        sum(numbers) for numbers in zip(*constraint.recent, strict=True)
    )
    mean = cost / episodes
    if kind == VIOLATION:
        low, high = rate_interval(int(violated), int(episodes))
    else:
        error = math.sqrt(max(squares / episodes - mean**2, 0.0) / max(episodes - 1.0, 1.0))
        low, high = max(mean - _DEVIATIONS * error, 0.0), mean + _DEVIATIONS * error
    return found | {
        "episodes": int(episodes),
        "mean": mean,
        "low": low,
        "high": high,
        "met": low <= constraint.limit and found["evaluation_met"] is not False,
    }


def require_judgement(given: Any) -> None:
    """Raise ValueError unless it is what `judged` returns, as far as it is read again.

    Args:
        given: content of a file.
    """
    numbers = [given[name] for name in ("limit", "multiplier", "episodes")]
    numbers += [given[name] for name in ("mean", "low", "high") if given["episodes"]]
    kept = [given[name] for name in ("met", "evaluation_met")]
    if not (
        given["kind"] in UNITS
        and type(given["saturated"]) is bool
        and all(met is None or type(met) is bool for met in kept)
        and all(type(n) in (int, float) and math.isfinite(n) for n in numbers)
    ):
        raise ValueError(f"the limit is judged as {shown(given)}")


def rank(evaluation: Mapping[str, Any]) -> tuple[bool, float]:
    """Return what the best policy has most of: first that it keeps its limit, then return.

    The policies that are kept do not explore, so that their evaluation decides, if it can.

    Args:
        evaluation: row with `return_mean`, and with what is `judged` about a limit, if there is
            one.
    """
    judgement = evaluation.get("constraint") or {}
    met = judgement.get("evaluation_met")
    met = judgement.get("met") if met is None else met
    return met is not False, evaluation["return_mean"]
