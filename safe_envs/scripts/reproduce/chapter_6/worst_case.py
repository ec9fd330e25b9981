"""The measured rates of Table 6.2 against the worst case h/c, and at one horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from safe_envs.scripts.reproduce.chapter_6.identifications import CHAPTER
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter
from safe_envs.scripts.reproduce.framework.verdict import disagreement


def above_worst(horizon: float, each: Mapping[str, tuple[Sequence[Number], float]]) -> Claim:
    """Return the claim that measured rates are above the worst case, by their lower ends.

    Args:
        horizon: up to which they were measured, in s.
        each: the rates and h/c, in per cent, by the start.
    """
    lowest = {
        place: (min(number.low or 0.0 for number in rates), bound)
        for place, (rates, bound) in each.items()
    }
    holds = all(low > bound for low, bound in lowest.values())
    evidence = "; ".join(
        f"{place}: lower ends from {low:.1f} %, h/c {bound:.0f} %"
        for place, (low, bound) in lowest.items()
    )
    return CHAPTER.claim("table-6.2", "above_worst", holds, seconds=horizon, each=evidence)


def worst_for_ever(seconds: float, each: Mapping[str, tuple[Number, float]]) -> Claim:
    """Return the claim that no rate falls below the worst case in a long time.

    Args:
        seconds: how long.
        each: the rate after that and h/c, in per cent, by the start.
    """
    holds = all(rate.high is not None and rate.high >= bound for rate, bound in each.values())
    evidence = "; ".join(
        f"{place}: SCBF {rate.ours:.1f} % [{rate.low:.1f}, {rate.high:.1f}], h/c {bound:.0f} %"
        for place, (rate, bound) in each.items()
    )
    return CHAPTER.claim("table-6.2", "for_ever", holds, seconds=seconds, each=evidence)


def at_one_horizon(first: MeasuredFilter, second: MeasuredFilter, printed: Sequence[float]) -> str:
    """Return whether the rates from two starts are the printed ones at one horizon, in words.

    Args:
        first: what was measured from the first start, with its curve of rates over the horizon.
        second: the same from the second one.
        printed: of both, in per cent.
    """
    times = first.row.curve.time
    curves = [each.at_each_horizon(p) for each, p in zip((first, second), printed, strict=True)]
    both = [
        time for time, *pair in zip(times, *curves, strict=True) if not any(map(disagreement, pair))
    ]
    note = partial(CHAPTER.note, "table-6.2", count=len(times), printed=printed)
    if both:
        return note("both", both=len(both), first=both[0])
    k = min(range(len(times)), key=lambda k: abs(curves[0][k].ours - printed[0]))
    rates = {"first": curves[0][k].ours, "second": curves[1][k].ours, "end": curves[0][-1].ours}
    return note("none", time=times[k], last=times[-1], **rates)
