"""The best attainable safety in the tables of other commands."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.yardstick import TimesUnavoidable, times_unavoidable
from safe_envs.outward_text import percents_between, rounded

COMPUTED = (
    "computed in floating point by dynamic programming of the env's own step, with the error of the"
    " grid in both ends"
)
"""What the ends of the best attainable safety are."""


def best_text(best: AttainableSafety | None) -> str:
    """Return the ends of the best attainable safety, in per cent; "-" where there are none."""
    return "-" if best is None else ends_text(best.lower, best.upper)


def ends_text(lower: float | None, upper: float | None) -> str:
    """Return two ends in per cent; "-" where there are none.

    Args:
        lower: the lower one.
        upper: the upper one.
    """
    if lower is None or upper is None:
        return "-"
    low, high = percents_between(lower, upper)
    return f"{low} %" if low == high else f"{low}..{high} %"


def times_text(times: TimesUnavoidable | None) -> str:
    """Return how many times the unavoidable violations, rounded outwards."""
    if times is None:
        return "-"
    low = _rounded(times.low, up=False)
    if times.high is None:
        return f">= {low}"
    high = _rounded(times.high, up=True)
    return low if low == high else f"{low}..{high}"


def times_column(best: AttainableSafety | None, rows: Sequence[EvaluationRow]) -> list[str]:
    """Return the cells of a column with `times_text`; none at all where nothing is known.

    Args:
        best: attainable safety, if it is known.
        rows: of an evaluation.
    """
    if best is None or best.lower is None:
        return []
    return [times_text(times_unavoidable(best, row.ci_low, row.ci_high)) for row in rows]


def best_line(best: AttainableSafety | None) -> str:
    """Return a line with the best attainable safety and how leaving counts; "" without it."""
    if best is None:
        return ""
    if best.lower is None:
        return "best attainable safety: withheld"
    return f"best attainable safety: {best_text(best)}"


def attainable_text(best: AttainableSafety | None) -> list[str]:
    """Return the upper end of the attainable safety, rounded up; none where it is not known.

    Args:
        best: attainable safety, if it is known; only a certified end stands after a sign.
    """
    if best is None or best.lower is None or best.upper is None:
        return []
    return [f"{'<= ' * is_certified(best)}{percents_between(best.lower, best.upper)[1]} %"]


def is_certified(best: AttainableSafety) -> bool:
    """Return whether the upper end of the attainable safety is of a table that was checked."""
    return best.check is not None and best.check.upper is not None


def best_notes(best: AttainableSafety | None) -> list[str]:
    """Return what has to be known to read the best attainable safety and the times."""
    if best is None:
        return []
    if best.contradiction:
        return [f"the best attainable safety is withheld: {best.contradiction}"]
    counted = (
        "It counts leaving the workspace as the rates do, as the end of a safe episode, which may"
        " be all that it takes; `safe-envs best` counts that as a violation."
        if best.leaving == "safe"
        else "Nothing outside the workspace is safe, so that leaving it counts as a violation."
    )
    return [
        "no policy is safer than the upper end of the best attainable safety, and some policy is as"
        f" safe as its lower end: {COMPUTED}, but not proved. {counted}",
        "times unavoidable: violations of a filter for each one that no policy can avoid, from (1 -"
        " upper end of the rate)/(1 - lower end of the best), at least 1, to (1 - lower end of the"
        " rate)/(1 - upper end of the best); only >= where none is shown to be unavoidable.",
    ]


def _rounded(value: float, *, up: bool) -> str:
    """Return a number from 1 on as text: below 10 with a digit after the point, else without."""
    return f"{float(rounded(value, 1 if value < 10.0 else 0, up=up)):.10g}"
