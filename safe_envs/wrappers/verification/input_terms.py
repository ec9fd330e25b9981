"""Parts of systems in expressions for the judge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import sympy as sp


def largest_input_term(coefficients: Sequence[Any], bounds: Sequence[tuple[Any, Any]]) -> Any:
    """Return the largest a u for inputs within bounds.

    Args:
        coefficients: a, an expression for each input.
        bounds: lower and upper bound of each.
    """
    # max(low a, high a), as an expression whose enclosure is not below 0 where a changes its sign.
    return sum(
        (low + high) / 2 * a + (high - low) / 2 * sp.Abs(a)
        for a, (low, high) in zip(coefficients, bounds, strict=True)
        if a != 0
    )


def exact_number(value: float) -> Any:
    """Return the decimal that a float is written as, exactly; infinities stay what they are."""
    return sp.Rational(repr(float(value))) if math.isfinite(value) else sp.Float(value)


def not_polynomial(expressions: Sequence[Any], states: Sequence[sp.Symbol]) -> tuple[Any, ...]:
    """Return those of several expressions that may fail to be continuous, for a form alone.

    Args:
        expressions: of the states.
        states: symbols.
    """
    found = (sp.sympify(e) for e in expressions)
    return tuple(dict.fromkeys(e for e in found if not e.is_polynomial(*states)))
