"""What symbols are declared to be, and matrices of expressions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sympy as sp

from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.number_text import finite_number

_REAL = sp.Symbol("real", real=True).assumptions0


def read_matrix(name: str, entries: Any, shape: tuple[int, int | None]) -> sp.ImmutableMatrix:
    """Read a matrix as an immutable matrix of a required shape.

    Args:
        name: of the matrix, for errors.
        entries: a matrix, or lists of its entries.
        shape: rows and columns; None as a width allows any.

    Raises:
        SystemDefinitionError: It is no matrix, or of another shape.
    """
    try:
        matrix = sp.ImmutableMatrix(entries)
    except (TypeError, ValueError) as error:
        raise SystemDefinitionError(f"{name} is no matrix of expressions: {error}") from error
    rows, columns = shape
    if matrix.rows != rows or (columns is not None and matrix.cols != columns):
        wanted = f"{rows} x {'any' if columns is None else columns}"
        raise SystemDefinitionError(
            f"{name} has shape {matrix.rows} x {matrix.cols}; the states and inputs need {wanted}"
        )
    # To sympy 0.0 is not 0, and a channel of such entries would count as noise.
    return sp.ImmutableMatrix(
        matrix.applyfunc(lambda entry: sp.Integer(0) if entry.is_Float and entry.is_zero else entry)
    )


def require_real(states: Iterable[Any], inputs: Iterable[Any], parameters: Iterable[Any]) -> None:
    """Check that states and inputs are declared real, and nothing more, and parameters real.

    Args:
        states: symbols.
        inputs: symbols.
        parameters: symbols.

    Raises:
        SystemDefinitionError: One is no symbol, or declared otherwise.
    """
    wrong = []
    for symbol in (*states, *inputs, *parameters):
        if not isinstance(symbol, sp.Symbol):
            raise SystemDefinitionError(
                f"{symbol!r} among states, inputs and parameters is no symbol; make it by"
                " sympy.symbols"
            )
        if symbol.assumptions0 != _REAL and not (symbol.is_real and symbol in parameters):
            wrong.append(symbol)
    if wrong:
        told = "; ".join(
            f"{s} is declared {_declared(s) or 'nothing, so that it may be complex'}" for s in wrong
        )
        names = " ".join(s.name for s in wrong)
        raise SystemDefinitionError(
            "states and inputs are to be declared real and nothing more, parameters real at least,"
            f" for sympy simplifies by that: {told}. Make them by sympy.symbols({names!r},"
            " real=True), in the system and in all that is said of it"
        )


def _declared(symbol: sp.Symbol) -> str:
    """Return what a symbol was declared to be, like "positive=True"."""
    return ", ".join(
        f"{word}={value}"
        for word, value in getattr(symbol, "_assumptions_orig", symbol.assumptions0).items()
    )


def fitting(symbol: sp.Symbol, value: Any) -> float:
    """Return the value of a parameter, checked against the declaration of its symbol.

    Args:
        symbol: the parameter.
        value: a number.

    Raises:
        ConfigurationError: The value is not finite, or not what the symbol is declared to be.
    """
    number = finite_number(f"parameter {symbol}", value)
    if symbol.assumptions0 != _REAL:
        exact = sp.Rational(number)
        wrong = [
            word
            for word, holds in symbol.assumptions0.items()
            if getattr(exact, f"is_{word}") is (not holds)
        ]
        if wrong:
            raise ConfigurationError(
                f"parameter {symbol} = {number:g}, but its symbol is declared {_declared(symbol)},"
                " and sympy simplifies by that; give another value, or make the symbol by"
                f" sympy.symbols({symbol.name!r}, real=True)"
            )
    return number
