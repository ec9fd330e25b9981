"""Class-K functions: strictly increasing functions through 0, linear ones as plain rates."""

from __future__ import annotations

import ast
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mpmath
import sympy as sp
from sympy.printing.str import StrPrinter

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.sde import finite_number

S = sp.Symbol("s", real=True)
"""The argument of a class-K function."""

_FUNCTIONS: dict[str, Any] = {
    name: getattr(sp, name) for name in ("Abs", "asinh", "atan", "cos", "cosh", "erf", "exp", "log", "sin", "sinh", "sqrt", "tanh")
}
_CONSTANTS: dict[str, Any] = {"s": S, "pi": sp.pi, "E": sp.E}
_OPERATORS: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_LARGEST_EXPONENT = 100
_DIGITS = 150
_NEAR = 1e-12


@dataclass(frozen=True)
class ClassK:
    """A function alpha(s) with alpha(0) = 0, strictly increasing for s of either sign.

    Attributes:
        expression: alpha as an expression of `S`, or its text, like "2*s**3" or "tanh(s)".

    Raises:
        ConfigurationError: it is no such function, as found on a grid of 600 points in [-1e4, 1e4].

    Source: thesis Def. 2.1.7, with the whole line as its domain, since a state may be outside the safe set.
    """

    expression: Any

    def __post_init__(self) -> None:
        given = self.expression
        try:
            expression = _parsed(given) if isinstance(given, str) else given
            expression = expression.subs({s: S for s in expression.free_symbols if s.name == S.name})
        except AttributeError:
            raise ConfigurationError(f"class-K function {given!r} is no expression of s, like 2*s**3 or tanh(s)") from None
        if expression.free_symbols != {S} or expression.has(sp.zoo, sp.nan, sp.oo):
            raise ConfigurationError(f"class-K function {given}: give a finite expression of s alone, like 2*s**3")
        object.__setattr__(self, "expression", expression)
        _require_increasing(expression)
        if _parsed(str(self)) != expression:
            raise ConfigurationError(f"class-K function {given} cannot be written and read again as {self}; write numbers as floats")

    def __call__(self, value: sp.Expr) -> sp.Expr:
        """Return alpha(value)."""
        return self.expression.subs(S, value)

    def is_smooth(self, order: int) -> bool:
        """Whether the derivatives up to an order are finite and continuous at 0, the one place where s |s| and the like are not."""
        slopes = [sp.diff(self.expression, S, i).replace(sp.DiracDelta, lambda *_: sp.Integer(0)) for i in range(order + 1)]
        value = sp.lambdify(S, slopes, "mpmath")
        try:
            with mpmath.workdps(_DIGITS):
                middle, below, above, wide = [value(mpmath.mpf(s)) for s in (0, -_NEAR, _NEAR, 1e6 * _NEAR)]
                return all(
                    mpmath.isfinite(c) and abs(b - a) <= abs(w - c) + abs(c) / 2
                    for c, a, b, w in zip(middle, below, above, wide, strict=True)
                )
        except (ArithmeticError, TypeError, ValueError):
            return False

    def __str__(self) -> str:
        return _Printer().doprint(self.expression).replace(" ", "")

    __repr__ = __str__


class _Printer(StrPrinter):
    """Writes floats with all their digits, so that a spec is read as what it was."""

    def _print_Float(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        return repr(float(expr))


def power(rate: float, exponent: float) -> ClassK:
    """The function rate s |s|^(exponent - 1), which is rate s^exponent where that is odd.

    Args:
        rate: positive.
        exponent: at least 1: below that the slope at 0 is infinite, and the closed loop need not have a solution.

    Raises:
        ConfigurationError: an argument is out of its range.
    """
    if not (finite_number("rate", rate) > 0 and finite_number("exponent", exponent) >= 1):
        raise ConfigurationError(f"rate = {rate}, exponent = {exponent}; give a positive rate and an exponent of at least 1")
    if exponent == int(exponent):
        exponent = int(exponent)
    odd = isinstance(exponent, int) and exponent % 2 == 1
    return ClassK(sp.sympify(rate) * (S**exponent if odd else S * sp.Abs(S) ** (exponent - 1)))


Rate = float | ClassK
"""A class-K function, with a number p for the linear one p s."""


def rates(name: str, given: Any) -> tuple[Rate, ...]:
    """Return class-K functions, the linear ones as positive floats in 1/s, or say which one is none.

    Raises:
        ConfigurationError: there is none, or one is neither a positive number nor a class-K function.
    """
    entries = tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    found = tuple(ClassK(r) if isinstance(r, str) or getattr(r, "free_symbols", None) else r for r in entries)
    numbers = [r for r in found if not isinstance(r, ClassK)]
    if numbers or not found:
        positive_rates(name, numbers)
    return tuple(r if isinstance(r, ClassK) else float(r) for r in found)


def positive_rates(name: str, given: Any) -> tuple[float, ...]:
    """Return linear class-K functions as floats, or say that one is not positive.

    Raises:
        ConfigurationError: there is none, or one is not a positive finite number.
    """
    entries = tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    try:
        values = tuple(float(r) for r in entries)
    except (TypeError, ValueError):
        values = ()
    if not values or not all(0 < v < float("inf") for v in values):
        listing = ", ".join(map(str, entries)) or "none"
        raise ConfigurationError(f"{name} = {listing}; give positive numbers")
    return values


def applied(rate: Rate, value: sp.Expr) -> sp.Expr:
    """Return alpha(value) for a rate of either kind."""
    return rate(value) if isinstance(rate, ClassK) else sp.Float(rate, 17) * value


def _require_increasing(alpha: sp.Expr) -> None:
    value = sp.lambdify(S, alpha, "mpmath")
    near, far = [k / 100 for k in range(1, 201)], [10 ** (k / 25) for k in range(9, 101)]
    with mpmath.workdps(_DIGITS):
        try:
            at_zero = value(mpmath.mpf(0))
            values = [value(mpmath.mpf(s)) for s in (*(-s for s in reversed(near + far)), 0, *near, *far)]
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ConfigurationError(f"class-K function {alpha} has no value somewhere in [-1e4, 1e4]: {error}") from error
        if any(not isinstance(v, mpmath.mpf) or not mpmath.isfinite(v) for v in values):
            raise ConfigurationError(f"class-K function {alpha} is not real and finite everywhere; for even powers write s*Abs(s)")
        if at_zero != 0:
            raise ConfigurationError(f"class-K function {alpha} is {mpmath.nstr(at_zero, 4)} at 0; it has to go through 0")
        middle = slice(len(far), len(values) - len(far))
        rising = all(a < b for a, b in pairwise(values[middle]))
        if not rising or any(a > b for a, b in pairwise(values)):
            raise ConfigurationError(f"class-K function {alpha} is not strictly increasing; for even powers write s*Abs(s)")


def _parsed(text: str) -> Any:
    """Evaluate arithmetic of s without Python's eval, which would run whatever stands in a spec."""
    try:
        return _evaluated(ast.parse(text.replace("^", "**"), mode="eval").body)
    except (SyntaxError, TypeError, ZeroDivisionError) as error:
        raise ConfigurationError(f"class-K function {text!r} is no expression of s, like 2*s**3 or tanh(s)") from error


def _evaluated(node: ast.AST) -> Any:
    match node:
        case ast.Name(name) if name in _CONSTANTS:
            return _CONSTANTS[name]
        case ast.Constant(int() | float() as number):
            return sp.sympify(number)
        case ast.BinOp(left, kind, right) if type(kind) in _OPERATORS:
            first, second = _evaluated(left), _evaluated(right)
            if isinstance(kind, ast.Pow) and not (second.is_number and abs(second) <= _LARGEST_EXPONENT):
                raise ConfigurationError(f"class-K function: the exponent {ast.unparse(right)} is no number up to {_LARGEST_EXPONENT}")
            return _OPERATORS[type(kind)](first, second)
        case ast.UnaryOp(kind, operand) if type(kind) in _OPERATORS:
            return _OPERATORS[type(kind)](_evaluated(operand))
        case ast.Call(ast.Name(name), [argument], []):
            if name not in _FUNCTIONS:
                raise ConfigurationError(f"class-K function: unknown function {name!r}; {nearest(name, _FUNCTIONS)}")
            return _FUNCTIONS[name](_evaluated(argument))
    raise ConfigurationError(f"class-K function: {ast.unparse(node)!r} is not allowed; write arithmetic of s, like 2*s**3 or tanh(s)")
