"""Bounds as text, rounded outwards: a lower bound down, an upper bound up.

No text says more than the number that was proved. A float counts as the decimal number that JSON
has for it, so that 0.9 is 90.0 %.
"""

from __future__ import annotations

import math
from decimal import Decimal
from fractions import Fraction
from numbers import Rational
from typing import SupportsFloat

_MOST_PLACES = 9
"""Of a percentage."""

_FINEST = 18
"""Places of a percentage that tell any two floats apart that are not next to each other."""

Number = SupportsFloat | Rational


def rounded(value: Number, places: int, *, up: bool) -> Decimal:
    """Return a finite number, rounded in one direction.

    Args:
        value: to round; a `Fraction` is exact.
        places: after the decimal point; negative ones are before it.
        up: whether it is an upper bound.
    """
    scaled = _exact(value) * Fraction(10) ** places
    whole = math.ceil(scaled) if up else math.floor(scaled)
    return Decimal(f"{whole}e{-places}")


def percent_at_least(bound: Number, places: int = 1) -> str:
    """Return a lower bound of a share in per cent, rounded down.

    Args:
        bound: in [0, 1].
        places: after the point, at least: there are as many as tell it from 0.
    """
    share = 100 * _exact(bound)
    choices = (rounded(share, d, up=False) for d in range(places, _MOST_PLACES))
    return f"{next((each for each in choices if each), rounded(0, places, up=False)):f}"


def percent_at_most(bound: Number) -> str:
    """Return an upper bound of a share in per cent, rounded up.

    There is a digit after the point, or as many as tell it from 0 and from 1.

    Args:
        bound: in [0, 1].
    """
    share = 100 * _exact(bound)
    places = next((d for d in range(1, _MOST_PLACES) if _tells(share, d)), _MOST_PLACES)
    return f"{rounded(share, places, up=True):f}"


def percents_between(lower: Number, upper: Number, places: int = 1) -> tuple[str, str]:
    """Return bounds of a share in per cent, the lower one rounded down and the upper one up.

    Args:
        lower: in [0, 1].
        upper: in [0, 1].
        places: after the point, at least: there are as many as tell an upper bound from 1.
    """
    low, high = 100 * _exact(lower), 100 * _exact(upper)
    choices = (d for d in range(places, _MOST_PLACES) if high >= 100 or _below_all(high, d))
    digits = next(choices, _MOST_PLACES)
    return f"{rounded(low, digits, up=False):f}", f"{rounded(high, digits, up=True):f}"


def percents_apart(upper: Number, lower: Number) -> tuple[str, str]:
    """Return an upper bound and a lower one above it in per cent, with digits that tell them apart.

    Args:
        upper: in [0, 1], rounded up.
        lower: in [0, 1], rounded down.
    """
    high, low = 100 * _exact(upper), 100 * _exact(lower)
    pairs = [(rounded(high, d, up=True), rounded(low, d, up=False)) for d in range(1, _FINEST)]
    most, least = next((pair for pair in pairs if pair[0] < pair[1]), pairs[-1])
    return f"{most:f}", f"{least:f}"


def number_at_most(value: Number, digits: int = 4) -> str:
    """Return an upper bound, rounded up; "infinite" for infinity.

    Args:
        value: of any size.
        digits: that it has at most.
    """
    return _significant(value, digits, up=True)


def number_at_least(value: Number, digits: int = 4) -> str:
    """Return a lower bound, rounded down; "infinite" for infinity.

    Args:
        value: of any size.
        digits: that it has at most.
    """
    return _significant(value, digits, up=False)


def _significant(value: Number, digits: int, *, up: bool) -> str:
    if not math.isfinite(float(value)):
        return "infinite" if float(value) == math.inf else str(float(value))
    exact = _exact(value)
    if not exact:
        return "0"
    size = (Decimal(abs(exact.numerator)) / Decimal(exact.denominator)).adjusted()
    return f"{float(rounded(exact, digits - 1 - size, up=up)):.{digits}g}"


def _exact(value: Number) -> Fraction:
    return Fraction(value) if isinstance(value, Rational) else Fraction(repr(float(value)))


def _below_all(share: Fraction, places: int) -> bool:
    return rounded(share, places, up=True) < 100


def _tells(share: Fraction, places: int) -> bool:
    """Return whether a number in per cent, rounded either way, differs from 0 and 100 if it is."""
    above_none = not share or rounded(share, places, up=False) > 0
    return above_none and (share >= 100 or _below_all(share, places))
