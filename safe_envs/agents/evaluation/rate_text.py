"""Rates as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MOST_DIGITS = 9


def percent(rate: float | None) -> str:
    """Return a rate in per cent as text; "-" for None."""
    return "-" if rate is None else f"{_percents(rate)[0]} %"


def percent_in(rate: float, low: float, high: float) -> str:
    """Return a rate with its interval, in per cent, as text.

    Args:
        rate: from 0 to 1.
        low: lower end of its interval.
        high: upper end.
    """
    rate_text, low_text, high_text = _percents(rate, low, high)
    return f"{rate_text} % [{low_text}, {high_text}]"


def points_in(difference: float, low: float, high: float, unit: str = " points") -> str:
    """Return a difference of rates with its interval, in points, as text.

    It has one digit, or as many as tell it from 0 where its interval does.

    Args:
        difference: of two rates from 0 to 1.
        low: lower end of its interval.
        high: upper end.
        unit: after the difference.
    """
    telling = (difference, low, high) if low * high > 0.0 else (max(abs(low), abs(high)),)
    # What rounding has left of 0 is the same.
    nonzero = [100 * each for each in telling if abs(each) > 1e-12]
    digits = next(
        (d for d in range(1, _MOST_DIGITS) if all(round(each, d) for each in nonzero)), _MOST_DIGITS
    )
    # What rounds to 0 has no minus sign.
    first, lower, upper = (round(100 * each, digits) + 0.0 for each in (difference, low, high))
    return f"{first:+.{digits}f}{unit} [{lower:.{digits}f}, {upper:.{digits}f}]"


def rate_of(row: Mapping[str, Any]) -> str:
    """Return the safety rate of a row with its interval, in per cent."""
    return percent_in(row["safety_rate"], row["ci_low"], row["ci_high"])


def _percents(*rates: float) -> list[str]:
    """Return percentages with one digit, or as many as tell each from 0 and from 1."""
    # What rounding has left of 0 and 1 is the same.
    open_ended = [rate for rate in rates if 1e-12 < rate < 1.0 - 1e-12]
    digits = next(
        (
            d
            for d in range(1, _MOST_DIGITS)
            if all(0.0 < round(100 * rate, d) < 100.0 for rate in open_ended)
        ),
        _MOST_DIGITS,
    )
    return [f"{100 * rate:.{digits}f}" for rate in rates]
