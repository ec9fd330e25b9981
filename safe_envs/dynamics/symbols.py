"""What symbols are declared to be, and expressions as users give them."""

from __future__ import annotations

import numbers
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import (
    ConfigurationError,
    SystemDefinitionError,
    SystemDefinitionWarning,
    shown,
)
from safe_envs.text import finite_number

TIME = sp.Symbol("t", nonnegative=True)
"""Time since the start of the episode or of the control loop, in s. No state or input, which may
have any sign, is the same symbol, even if its name is t."""

MOST_TERMS = 1000
"""Of a sum or product over an index, which is written out term by term."""

_INDEXED = (sp.Sum, sp.Product)

_REAL = sp.Symbol("real", real=True).assumptions0

_SIGNS = {
    word: sp.Symbol("sign", **{"real": True, word: True}).assumptions0
    for word in ("real", "positive", "nonnegative", "negative", "nonpositive", "nonzero")
}
"""What is known of a real symbol whose sign is declared, by the word that declares it."""


def formula(what: str, given: Any) -> sp.Expr:
    """Return a SymPy expression, or a number as one.

    Args:
        what: name of the argument, for errors.
        given: of SymPy, or a number.

    Raises:
        SystemDefinitionError: it is a text, a function, an inequality or something else, or see
            `written_out`.
    """
    if isinstance(given, sp.Expr):
        return written_out(what, given)
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
        f"{what} is {kind}, {shown(given)}; give a sympy expression of the symbols of the system,"
        " like 1 - x**2"
    )


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
        matrix.applyfunc(
            lambda entry: (
                sp.Integer(0) if entry.is_Float and entry.is_zero else written_out(name, entry)
            )
        )
    )


def doubt_shared_noise(given: Any) -> None:
    """Warn where a diffusion is a flat list with several entries that are not zero.

    Args:
        given: as users give it to the constructor of a system.
    """
    is_list = isinstance(given, list | tuple | np.ndarray)
    if is_list and sum(isinstance(e, sp.Expr | numbers.Number) and e != 0 for e in given) > 1:
        warnings.warn(
            f"diffusion = {shown(given)} is one column: a single Wiener process moves several"
            " states at once. Give a list for each state: [[a, 0], [0, b]] for independent noises,"
            " [[a], [b]] for a single one",
            SystemDefinitionWarning,
            stacklevel=4,  # past the generated constructor
        )


def written_out(what: str, expression: Any) -> Any:
    """Return an expression whose sums and products over an index are written out, term by term.

    The index is no quantity: code for one of its terms would not know it.

    Args:
        what: name of the argument, for errors.
        expression: of symbols and such sums.

    Raises:
        SystemDefinitionError: An index does not run over whole numbers, `MOST_TERMS` at most.
    """
    if not expression.has(*_INDEXED):
        return expression
    if not isinstance(expression, _INDEXED):
        return expression.func(*[written_out(what, part) for part in expression.args])
    *inner, (index, *ends) = expression.limits  # the last one is the outermost
    low, high = ends if len(ends) == 2 else (None, None)
    if not (isinstance(low, sp.Integer) and isinstance(high, sp.Integer)) or not (
        0 <= high - low < MOST_TERMS
    ):
        raise SystemDefinitionError(
            f"{what} holds {expression}, which cannot be written out; let the index run over whole"
            f" numbers, the lower one first, and at most {MOST_TERMS} of them"
        )
    rest = expression.func(expression.function, *inner) if inner else expression.function
    terms: list[Any] = [rest.subs(index, k) for k in range(int(low), int(high) + 1)]
    found = sp.Add(*terms) if isinstance(expression, sp.Sum) else sp.Mul(*terms)
    return written_out(what, found)


def require_mappings(parameters: Any, signals: Any) -> None:
    """Raise SystemDefinitionError unless values of parameters and rates of signals are dicts.

    Args:
        parameters: as users give them.
        signals: likewise.
    """
    for name, given, entry in (("parameters", parameters, "value"), ("signals", signals, "rate")):
        if not isinstance(given, Mapping):
            raise SystemDefinitionError(
                f"{name} = {shown(given)}; give a dict, {name}={{symbol: {entry}}}"
            )


def signal_rate(signal: sp.Symbol, given: Any) -> sp.Expr:
    """Return the rate of a signal as an expression.

    Args:
        signal: of which it is.
        given: of SymPy, or a number.

    Raises:
        SystemDefinitionError: it is no expression, or not finite.
    """
    found = formula(f"the rate of {signal}", given)
    if found.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise SystemDefinitionError(
            f"the rate of the signal {signal} is {found}; give a finite expression, 0 for a"
            " quantity that does not change by itself"
        )
    return found


def declared_sign(symbol: sp.Symbol) -> str | None:
    """Return the word by which the sign of a real symbol is declared.

    Args:
        symbol: of a quantity whose values are given at run time.

    Returns:
        "real" for one of any sign, "positive" and so on; None where more is declared than a sign.
    """
    return next((word for word, known in _SIGNS.items() if symbol.assumptions0 == known), None)


def require_real(
    states: Iterable[Any],
    inputs: Iterable[Any],
    parameters: Iterable[Any],
    signals: Iterable[Any] = (),
) -> None:
    """Check that states and inputs are declared real, and nothing more, and the others real.

    Args:
        states: symbols.
        inputs: symbols.
        parameters: symbols.
        signals: symbols, of which the sign may be declared too.

    Raises:
        SystemDefinitionError: One is no symbol, or declared otherwise.
    """
    wrong = []
    for symbol in (*states, *inputs, *parameters, *signals):
        if not isinstance(symbol, sp.Symbol):
            raise SystemDefinitionError(
                f"{symbol!r} among states, inputs, parameters and signals is no symbol; make it by"
                " sympy.symbols"
            )
        if symbol in signals:
            if declared_sign(symbol) is None or symbol == TIME:
                raise SystemDefinitionError(
                    f"the signal {symbol} is declared {_declared(symbol) or 'nothing'}; make it by"
                    f" sympy.symbols({symbol.name!r}, real=True), or with positive=True and the"
                    " like. The time is no signal: it is known to every system"
                )
            continue
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


def advice_on_unknown(unknown: Iterable[sp.Symbol], allowed: Iterable[sp.Symbol]) -> str:
    """Return what to do about symbols that an expression may not hold.

    Args:
        unknown: the symbols.
        allowed: those that it may hold.
    """
    if TIME in unknown:
        return (
            "the time is known to rewards, features, and filters in a loop of your own; here, make"
            " it a state whose rate is 1"
        )
    twins = {s.name for s in unknown} & {s.name for s in allowed}
    if twins:
        return (
            f"{', '.join(sorted(twins))} has other assumptions there: Symbol('x', real=True) is not"
            " Symbol('x'); the time is problem.TIME"
        )
    return (
        "a parameter gets its value in parameters={...} of the system, and what is measured at run"
        " time its rate in signals={...}"
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
