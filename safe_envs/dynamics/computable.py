"""Whether an expression can be computed, checked before code is generated."""

from __future__ import annotations

import sys
from typing import Any

import sympy as sp

from safe_envs.dynamics.printers import SUPPORTED
from safe_envs.errors import SystemDefinitionError

_LARGEST_FLOAT = sp.Rational(sys.float_info.max)
_LONGEST_QUOTED = 120


def require_computable(expression: Any, arguments: tuple[sp.Symbol, ...]) -> None:
    """Check that an expression has a value for numbers in place of its arguments.

    Args:
        expression: any of SymPy's.
        arguments: the symbols that get numbers.

    Raises:
        SystemDefinitionError: It holds another symbol, a function without a numerical form, or a
            number that is not real or too large; or a symbol is an argument twice.
    """
    unknown = expression.free_symbols - set(arguments)
    if unknown:
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds {', '.join(sorted(map(str, unknown)))}, which is none"
            f" of {', '.join(map(str, arguments))}"
        )
    if len(set(arguments)) < len(arguments):
        raise SystemDefinitionError(
            f"a symbol stands for two arguments of {excerpt(expression)}:"
            f" {', '.join(map(str, arguments))}"
        )
    strange = {f.func for f in expression.atoms(sp.Function) if not isinstance(f, SUPPORTED)}
    if strange:
        advice = (
            "; DiracDelta is the derivative of a jump: use a smooth function"
            if sp.DiracDelta in strange
            else ""
        )
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds {', '.join(sorted(map(str, strange)))}, which has no"
            f" numerical form here; write it with {', '.join(f.__name__ for f in SUPPORTED)}, Max"
            f" and Min{advice}"
        )
    if expression.has(sp.I, sp.zoo):
        raise SystemDefinitionError(
            f"{excerpt(expression)} is not real everywhere, or has a division by 0; look at its"
            " numbers"
        )
    if any(abs(number) > _LARGEST_FLOAT for number in expression.atoms(sp.Float, sp.Rational)):
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds a number beyond {float(_LARGEST_FLOAT):.2g}, the"
            " largest of floats"
        )


def excerpt(expression: Any) -> str:
    """Return the beginning of an expression as text."""
    try:
        text = str(expression)
    except ValueError:  # Python does not print whole numbers of thousands of digits.
        return "an expression"
    return text if len(text) <= _LONGEST_QUOTED else f"{text[:_LONGEST_QUOTED]}..."
