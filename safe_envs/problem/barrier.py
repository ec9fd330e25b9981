"""A barrier: the function whose superlevel set is safe."""

from __future__ import annotations

import numbers
from dataclasses import dataclass
from typing import Any

import sympy as sp

from safe_envs.errors import SystemDefinitionError


@dataclass(frozen=True)
class Barrier:
    """h, with the safe set C = {x : h(x) >= 0}; a violation is h < 0.

    It is a function of the states alone, with numbers for its constants: plant and model may
    differ, what is safe is the same for both.

    Attributes:
        expression: h(x).
        name: how it is called in tables and plots.

    Raises:
        SystemDefinitionError: h is no expression.

    Source: thesis Eq. (3.3), (4.8).
    """

    expression: sp.Expr
    name: str = "h"

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", formula("a barrier", self.expression))


def formula(what: str, given: Any) -> sp.Expr:
    """Return a SymPy expression, or a number as one.

    Args:
        what: name of the argument, for errors.
        given: of SymPy, or a number.

    Raises:
        SystemDefinitionError: it is a text, a function, an inequality or something else.
    """
    if isinstance(given, sp.Expr):
        return given
    if isinstance(given, sp.logic.boolalg.Boolean):
        raise SystemDefinitionError(
            f"{what} is {given}, which is true or false; give the expression itself, 1 - x**2 for 1"
            " - x**2 >= 0"
        )
    if isinstance(given, numbers.Real) and not isinstance(given, bool):
        return sp.sympify(given)  # pyright: ignore[reportReturnType]
    kind = (
        "a text"
        if isinstance(given, str)
        else "a function"
        if callable(given)
        else type(given).__name__
    )
    raise SystemDefinitionError(
        f"{what} is {kind}, {given!r}; give a sympy expression of the symbols of the system, like 1"
        " - x**2"
    )
