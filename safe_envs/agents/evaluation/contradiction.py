"""What the episodes of a command say against a bound that it estimates: the one place that decides
what is withheld.

A bound is withheld, and the reason said, where the episodes themselves show that it, or a number it
rests on, is wrong: a start or a visited state has a b_j above the supremum c_j that was found, the
filter missed a condition by more than the shortfall m that was found, or the interval of the
measured rate lies below the bound. See
`safe_envs.wrappers.verification.chain_guarantee.ChainGuarantee.contradiction` for the first two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safe_envs.agents.evaluation.visited_states import Seen
from safe_envs.wrappers.verification.guarantee import Guarantee

ADVICE = "bounds are of continuous time: try a smaller dt, or --refine"


def by_states(bound: Guarantee, seen: Sequence[Seen]) -> str:
    """What the states of episodes say against the numbers that a bound rests on; "" if nothing.

    Args:
        bound: that was estimated.
        seen: in the episodes.
    """
    found = (
        bound.contradiction(each.deepest, each.missed, each.actions, each.slack) for each in seen
    )
    return next(filter(None, found), "")


def by_rate(bound: float | None, ci_high: float) -> str:
    """What the interval of a measured rate says against a bound: that it ends below it; "" if it
    does not.

    Args:
        bound: on the probability of being safe, None for none.
        ci_high: upper end of the interval.
    """
    if bound is None or ci_high >= bound:
        return ""
    return (
        f"the interval of the measured rate ends at {100 * ci_high:.1f} %, below {100 * bound:.1f}"
        f" %; {ADVICE}"
    )


def judged(row: dict[str, Any], ci_high: float) -> dict[str, Any]:
    """A row of an evaluation without the bounds that a rate contradicts; the reason is in
    `withheld`.

    Args:
        row: with `estimated_bound`, `posterior_bound` and `withheld`, as
            `safe_envs.agents.evaluation.guarantees.GuaranteeAverager.row` makes it.
        ci_high: upper end of the interval of the rate.
    """
    posterior = row["posterior_bound"]
    reason = by_rate(row["estimated_bound"], ci_high) or by_rate(
        posterior and posterior["probability"], ci_high
    )
    return withheld(row, reason) if reason else row


def withheld(row: dict[str, Any], reason: str) -> dict[str, Any]:
    """A row without its bounds, and why."""
    changed = {
        **row,
        "withheld": reason,
        "estimated_bound": None,
        "bound_note": f"withheld: {reason}",
    }
    if row["posterior_bound"] is not None:
        changed |= {
            "posterior_bound": {
                **row["posterior_bound"],
                "probability": None,
                "note": f"withheld: {reason}",
            }
        }
        changed["bound_note"] = row["bound_note"]
    return changed
