"""The one place that decides which bounds the episodes contradict, or a table of the env.

A bound is withheld, and the reason said, where the episodes themselves show that it, or a number it
uses, is wrong: a start or a visited state has a b_j above the supremum c_j, the filter violated a
condition by more than the shortfall m, or the interval of the measured rate lies below the bound.
See `safe_envs.wrappers.verification.guarantee.ChainGuarantee.contradiction` for the first two.

The intervals are exact ones: see `safe_envs.agents.evaluation.statistics.exact_interval`. A bound
that is proved is withheld only where an interval of 99.9 % lies below it, which happens by chance
in at most .05 % of all cases.

A bound for the env's own steps and the rates stand in a chain: bound <= rate <= what any policy can
attain. Where the bound is above the last number, one of both is wrong; see `above_attainable`. A
bound for continuous control is of another process, which the episodes come near to where dt is
small: a rate below it contradicts that the two are near, or the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from safe_envs.agents.evaluation.rows import BoundSummary, EvaluationRow
from safe_envs.agents.evaluation.statistics import exact_interval
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.outward_text import percents_apart
from safe_envs.wrappers.verification.guarantee import Guarantee

SURE = 0.999
"""Confidence of the intervals that may contradict what is proved, or a table."""

Bounded = TypeVar("Bounded", bound=BoundSummary)

ADVICE = "bounds are of continuous time: try a smaller dt, or --refine"

_ADVICE_PROVED = "an interval misses the truth at times: try more episodes; else report an error"
_ADVICE_COMPUTED = "an interval misses the truth at times: try more episodes, or another table"
_DEVIATIONS = 3.0
_SURE_WORDS = ("proved", "certified")


def by_states(bound: Guarantee, visited: Sequence[VisitedStates]) -> str:
    """Return how the states of episodes contradict the numbers of a bound; "" if they do not.

    Args:
        bound: for continuous control.
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
    end, least = percents_apart(ci_high, bound)
    return f"the interval of the measured rate ends at {end} %, below {least} %; {advice}"


def upper_ends(safe: int, episodes: int, confidence: float) -> tuple[float, float]:
    """Return the upper ends of exact intervals of a rate, for `end_for`.

    Args:
        safe: number of safe episodes.
        episodes: number of all.
        confidence: of the first interval; that of the second is `SURE`.
    """
    high, sure_high = (exact_interval(safe, episodes, each)[1] for each in (confidence, SURE))
    return high, max(high, sure_high)


def upper_ends_of(row: EvaluationRow, confidence: float) -> tuple[float, float]:
    """Return the `upper_ends` of a row's rate.

    Args:
        row: of an evaluation; over several identifications its own interval is all there is.
        confidence: of the first interval.
    """
    if row.learning is not None and row.learning.repeats > 1:
        return row.ci_high, row.ci_high
    return upper_ends(row.safe, row.episodes, confidence)


def end_for(word: str, ci_high: float, sure_high: float) -> float:
    """Return the end of an interval that a bound may not be above.

    Args:
        word: what the bound is worth.
        ci_high: upper end of the interval of a rate.
        sure_high: that of a wider one, for what is proved.
    """
    return sure_high if word in _SURE_WORDS else ci_high


def judged(row: Bounded, ci_high: float, sure_high: float) -> Bounded:
    """Return a row without the bounds that a measured rate contradicts; `withheld` says why.

    Args:
        row: of an evaluation.
        ci_high: upper end of the interval of the rate.
        sure_high: upper end of a wider one, which a proved bound is held against.
    """
    advice = _ADVICE_COMPUTED if row.held_word == "computed" else _ADVICE_PROVED
    reason = by_rate(row.held_bound, end_for(row.held_word, ci_high, sure_high), advice)
    return continuous_judged(without_held(row, reason) if reason else row, ci_high, sure_high)


def continuous_judged(row: Bounded, ci_high: float, sure_high: float) -> Bounded:
    """Return a row without the bounds of continuous control that a rate contradicts.

    Args:
        row: of an evaluation.
        ci_high: upper end of the interval of a rate, maybe with a smaller control period.
        sure_high: upper end of a wider one, which a proved bound is held against.
    """
    posterior = row.posterior_bound
    end = end_for(row.continuous_word, ci_high, sure_high)
    reason = by_rate(row.continuous_bound, end) or by_rate(
        posterior and posterior.probability, ci_high
    )
    return without_continuous(row, reason) if reason else row


def above_attainable(row: BoundSummary, upper: float | None) -> str:
    """Return how the bound for the env's own steps contradicts what is attainable; "" if not.

    Args:
        row: with the bound, whose mean over some starts may be off by a few of its errors.
        upper: bound from above of what any policy attains, counted as the rates are; None for none.
    """
    if row.held_bound is None or upper is None:
        return ""
    if row.held_bound - _DEVIATIONS * row.held_error <= upper:
        return ""
    most, least = percents_apart(upper, row.held_bound)
    return f"the bound for held input, {least} %, is above what any policy can attain, {most} %"


def without_held(row: Bounded, reason: str) -> Bounded:
    """Return a row without its bound for the env's own steps, and with the reason.

    Args:
        row: with the bound.
        reason: how it is contradicted.
    """
    return replace(
        row,
        withheld=row.withheld or reason,
        held_bound=None,
        held_word="withheld",
        held_note=f"withheld: {reason}",
        held_error=0.0,
    )


def without_continuous(row: Bounded, reason: str) -> Bounded:
    """Return a row without its bounds for continuous control, and with the reason.

    Args:
        row: with bounds.
        reason: how they are contradicted.
    """
    note, posterior = f"withheld: {reason}", row.posterior_bound
    row = replace(row, withheld=row.withheld or reason, continuous_bound=None)
    if posterior is None:
        return replace(row, continuous_word="withheld", continuous_note=note, continuous_error=0.0)
    none = replace(posterior, probability=None, note=note, word="withheld")
    return replace(row, posterior_bound=none)
