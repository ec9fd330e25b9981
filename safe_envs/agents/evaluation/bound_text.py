"""Bounds on the probability of being safe, as the cells of tables.

Only what is proved, or certified, stands after ">=". Bounds are rounded down.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.outward_text import percent_at_least

NO_BOUND = "-"

_FORMS: Mapping[str, str] = {
    "proved": ">= {} %",
    "certified": ">= {} %",
    "computed": "{} % comp.",
    "estimated": "{} % est.",
}


def bound_text(bound: float | None, word: str) -> str:
    """Return a bound as text: after ">=" only if its word allows it.

    Args:
        bound: in [0, 1]; None where there is none.
        word: what it is worth, a `HeldWord` or a `ContinuousWord`.

    Raises:
        KeyError: There is a bound, but the word is not of one.
    """
    if bound is None:
        return "withheld" if word == "withheld" else NO_BOUND
    if not bound:
        return f"{percent_at_least(bound)} %"
    return _FORMS[word].format(percent_at_least(bound))


def held_text(row: BoundSummary) -> str:
    """Return the bound of a row for the env's own steps, as text."""
    return bound_text(row.held_bound, row.held_word)


def continuous_text(row: BoundSummary) -> str:
    """Return the bound of a row for continuous control, as text."""
    return bound_text(row.continuous_bound, row.continuous_word)


def bound_cells(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return the bounds of a row that is JSON-able data: for held input and continuous control."""
    pairs = (("held_bound", "held_word"), ("continuous_bound", "continuous_word"))
    first, second = (bound_text(row.get(bound), row.get(word) or "none") for bound, word in pairs)
    return first, second
