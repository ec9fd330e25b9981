"""The one place that decides which estimated bounds the episodes contradict.

A bound is withheld, and the reason said, where the episodes themselves show that it, or a number it
uses, is wrong: a start or a visited state has a b_j above the supremum c_j that was found, the
filter violated a condition by more than the shortfall m that was found, or the interval of the
measured rate lies below the bound. See
`safe_envs.wrappers.verification.guarantee.ChainGuarantee.contradiction` for the first two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.wrappers.verification.guarantee import Guarantee

Bounded = TypeVar("Bounded", bound=BoundSummary)

ADVICE = "bounds are of continuous time: try a smaller dt, or --refine"

COMPUTED = "computed: the table is of floating-point numbers"
"""Note on the bound of a promise filter, which is of the env's own steps."""

_ADVICE_COMPUTED = "an interval misses the truth at times: try more episodes, or another table"


def by_states(bound: Guarantee, visited: Sequence[VisitedStates]) -> str:
    """Return how the states of episodes contradict the numbers of a bound; "" if they do not.

    Args:
        bound: that was estimated.
        visited: states of the episodes.
    """
    found = (
        bound.contradiction(each.deepest, each.violating, each.actions, each.slack)
        for each in visited
    )
    return next(filter(None, found), "")


def by_rate(bound: float | None, ci_high: float, advice: str = ADVICE) -> str:
    """Return how the interval of a measured rate contradicts a bound; "" if it does not.

    Args:
        bound: on the probability of being safe, None for none.
        ci_high: upper end of the interval.
        advice: what to do.
    """
    if bound is None or ci_high >= bound:
        return ""
    return (
        f"the interval of the measured rate ends at {100 * ci_high:.1f} %, below {100 * bound:.1f}"
        f" %; {advice}"
    )


def judged(row: Bounded, ci_high: float) -> Bounded:
    """Return a row without the bounds that a measured rate contradicts; `withheld` says why.

    Args:
        row: of an evaluation.
        ci_high: upper end of the interval of the rate.
    """
    posterior = row.posterior_bound
    advice = _ADVICE_COMPUTED if row.bound_note == COMPUTED else ADVICE
    reason = by_rate(row.estimated_bound, ci_high, advice) or by_rate(
        posterior and posterior.probability, ci_high
    )
    return withheld(row, reason) if reason else row


def withheld(row: Bounded, reason: str) -> Bounded:
    """Return a row without its bounds, and with the reason.

    Args:
        row: with bounds.
        reason: how they are contradicted.
    """
    note, posterior = f"withheld: {reason}", row.posterior_bound
    row = replace(row, withheld=reason, estimated_bound=None)
    if posterior is None:
        return replace(row, bound_note=note)
    return replace(row, posterior_bound=replace(posterior, probability=None, note=note))
