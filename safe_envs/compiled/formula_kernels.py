"""Functions in formulas that compiled code would compute otherwise than NumPy: as kernels.

Compiled code has whole numbers of 64 bits, in which a huge `floor` does not fit, and its `max` and
`min` may lose a NaN, which has to show.
"""

from __future__ import annotations

from math import ceil, floor

WHOLE_FROM = 2.0**52
"""Size from which on all numbers are whole."""


def formula_floor(value: float) -> float:
    """Return the largest whole number that is not above a number."""
    return float(floor(value)) if abs(value) < WHOLE_FROM else value


def formula_ceiling(value: float) -> float:
    """Return the smallest whole number that is not below a number."""
    return float(ceil(value)) if abs(value) < WHOLE_FROM else value


def formula_sign(value: float) -> float:
    """Return -1, 0 or 1; NaN for NaN."""
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else float(value)


def formula_max(a: float, b: float) -> float:
    """Return the larger one of two numbers; NaN where one is.

    Args:
        a: a number.
        b: another one.
    """
    return float(a) if a >= b or a != a else float(b)


def formula_min(a: float, b: float) -> float:
    """Return the smaller one of two numbers; NaN where one is.

    Args:
        a: a number.
        b: another one.
    """
    return float(a) if a <= b or a != a else float(b)
