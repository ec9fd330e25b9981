"""Class-K functions: strictly increasing functions through 0, linear ones as plain rates."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mpmath
import sympy as sp
from sympy.printing.str import StrPrinter

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.text import finite_number, whole_or_real

S = sp.Symbol("s", real=True)
"""The argument of a class-K function."""

_FUNCTIONS: dict[str, Any] = {
    name: getattr(sp, name)
    for name in ("Abs", "asinh", "atan", "cos", "cosh", "exp", "log", "sin", "sinh", "sqrt", "tanh")
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

_MOST_CHARACTERS = 400
_MOST_PARTS = 60
"""Numbers, names and operations: the derivatives that a chain of four takes of a product of as many
as fit need a second."""

_MOST_FUNCTIONS = 8
_DEEPEST = 3
"""Functions within functions. A fourth exponential of a number above 1 has no value that a computer
can hold."""

_MOST_FRACTION_BITS = 1100
"""Of the numerator and the denominator of a fraction, as far as floats reach."""


def parsed(text: str) -> Any:
    """Evaluate arithmetic of s without Python's eval, which would run any code in a text.

    Nothing is evaluated whose size is not known to be small before: sympy would compute 9**9**9 for
    days.

    Raises:
        ConfigurationError: it is no such arithmetic, or too long.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ConfigurationError(
            f"class-K function {shown(text)} has {len(text):,} characters; give at most"
            f" {_MOST_CHARACTERS}"
        )
    if not (text.isascii() and text.isprintable()):
        raise ConfigurationError(
            f"class-K function {shown(text)} has characters beyond ASCII; write it like 2*s**3 or"
            " tanh(s)"
        )
    source = text.replace("^", "**").strip()
    try:
        tree = ast.parse(source, mode="eval").body
        _require_few_parts(tree)
        return _evaluated(tree, source)
    except (SyntaxError, RecursionError, MemoryError, TypeError, ZeroDivisionError) as error:
        raise ConfigurationError(
            f"class-K function {shown(text)} is no expression of s, like 2*s**3 or tanh(s)"
        ) from error


def _require_few_parts(tree: ast.expr) -> None:
    """Raise ConfigurationError for an expression larger than a person writes."""
    # It does not recurse, since the tree may be as deep as it is large.
    parts, functions, left = 0, 0, [(tree, 0)]
    while left:
        node, depth = left.pop()
        is_call = isinstance(node, ast.Call)
        parts, functions, depth = parts + 1, functions + is_call, depth + is_call
        if parts > _MOST_PARTS or functions > _MOST_FUNCTIONS or depth > _DEEPEST:
            raise ConfigurationError(
                f"class-K function: it has more than {_MOST_PARTS} numbers, names and operations,"
                f" more than {_MOST_FUNCTIONS} functions, or functions more than {_DEEPEST} deep"
                " within each other; give a simpler one, like 2*s**3 or tanh(s)"
            )
        # The name of a function is a part of its call.
        children = node.args if isinstance(node, ast.Call) else ast.iter_child_nodes(node)
        left += [(child, depth) for child in children if isinstance(child, ast.expr)]


def _evaluated(node: ast.expr, source: str) -> Any:
    return _small(_combined(node, source), node)


def _combined(node: ast.expr, source: str) -> Any:
    match node:
        case ast.Name(name) if name in _CONSTANTS:
            return _CONSTANTS[name]
        case ast.Constant(int() | float()):
            return sp.sympify(_number(source[node.col_offset : node.end_col_offset]))
        case ast.BinOp(left, kind, right) if type(kind) in _OPERATORS:
            first, second = _evaluated(left, source), _evaluated(right, source)
            if isinstance(kind, ast.Pow) and not (
                second.is_Number and abs(second) <= _LARGEST_EXPONENT
            ):
                raise ConfigurationError(
                    f"class-K function: the exponent {shortened(ast.unparse(right))} is no number"
                    f" up to {_LARGEST_EXPONENT}"
                )
            return _OPERATORS[type(kind)](first, second)
        case ast.UnaryOp(kind, operand) if type(kind) in _OPERATORS:
            return _OPERATORS[type(kind)](_evaluated(operand, source))
        case ast.Call(ast.Name(name), [argument], []):
            if name not in _FUNCTIONS:
                raise ConfigurationError(
                    f"class-K function: unknown function {shown(name)}; {nearest(name, _FUNCTIONS)}"
                )
            return _FUNCTIONS[name](_evaluated(argument, source))
    raise ConfigurationError(
        f"class-K function: {shown(ast.unparse(node))} is not allowed; write arithmetic of s, like"
        " 2*s**3 or tanh(s)"
    )


def _number(text: str) -> int | float:
    try:
        return whole_or_real(text)
    except ValueError as error:
        raise ConfigurationError(
            f"class-K function: {shown(text)} is no decimal number; write it with the digits 0 to 9"
        ) from error


def _small(expression: Any, node: ast.expr) -> Any:
    """Return an expression whose numbers are small, so that the next operation takes no time."""
    exponents = [power.exp for power in expression.atoms(sp.Pow)]
    numbers = expression.atoms(sp.Number)
    fits = all(e.is_Number and abs(e) <= _LARGEST_EXPONENT for e in exponents) and all(
        map(_is_small, numbers)
    )
    if not fits or not (expression.free_symbols or _is_real(expression)):
        raise ConfigurationError(
            f"class-K function: {shown(ast.unparse(node))} has a number that is not real, beyond"
            f" floats or too long, or an exponent above {_LARGEST_EXPONENT}; give smaller ones"
        )
    return expression


def _is_small(number: Any) -> bool:
    if number.is_Rational:
        return max(number.p.bit_length(), number.q.bit_length()) <= _MOST_FRACTION_BITS
    return _is_real(number)


def _is_real(constant: Any) -> bool:
    """Whether a float holds a constant."""
    # The error of a division by 0 names the whole function.
    if constant.has(sp.zoo, sp.nan, sp.oo):
        return True
    try:
        value = float(constant)
    except (TypeError, OverflowError):
        return False
    return math.isfinite(value) and (value != 0.0 or constant.is_zero is not False)


_DIGITS = 150
_NEAR = 1e-12

_MOST_BITS = 20_000
"""Of the arguments of exponentials and sines: exp(exp(1e4)) is computed at once, and the
exponential of that never."""

_SATURATED = 20
"""Bits of arguments beyond which tanh is 1, to all digits."""


def _guarded(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function of mpmath that refuses arguments at which it would take long."""

    def value(argument: Any) -> Any:
        if mpmath.mag(argument) > _MOST_BITS:
            raise OverflowError("a number gets too large")
        return function(argument)

    return value


def _tanh(argument: Any) -> Any:
    return mpmath.sign(argument) if mpmath.mag(argument) > _SATURATED else mpmath.tanh(argument)


def _modulus(argument: Any) -> Any:
    """Return the modulus of a number."""
    # That of a complex number is real, but floats have no complex number on the way there.
    if isinstance(argument, mpmath.mpc):
        raise ValueError("the modulus of a number that is not real")
    return abs(argument)


_GUARDED = {name: _guarded(getattr(mpmath, name)) for name in ("cos", "cosh", "exp", "sin", "sinh")}
_MODULES: list[Any] = [{"abs": _modulus, "tanh": _tanh, **_GUARDED}, "mpmath"]


@dataclass(frozen=True)
class ClassK:
    """A function alpha(s) with alpha(0) = 0, strictly increasing for s of either sign.

    Attributes:
        expression: alpha as an expression of `S`, or its text, like "2*s**3" or "tanh(s)".

    Raises:
        ConfigurationError: it is no such function, as found on a grid of 600 points in [-1e4, 1e4].

    Source: thesis Def. 2.1.7, with the whole line as its domain, since a state may be outside the
        safe set.
    """

    expression: Any

    def __post_init__(self) -> None:
        given = self.expression
        try:
            expression = parsed(given) if isinstance(given, str) else given
            expression = expression.subs(
                {s: S for s in expression.free_symbols if s.name == S.name}
            )
        except AttributeError:
            raise ConfigurationError(
                f"class-K function {shown(given)} is no expression of s, like 2*s**3 or tanh(s)"
            ) from None
        if expression.free_symbols != {S} or expression.has(sp.zoo, sp.nan, sp.oo):
            raise ConfigurationError(
                f"class-K function {shortened(given)}: give a finite expression of s alone, like"
                " 2*s**3"
            )
        object.__setattr__(self, "expression", expression)
        # Before its values are computed: what can be read is small.
        if parsed(str(self)) != expression:
            texts = f"{shortened(given)} cannot be written and read again as {shortened(self)}"
            raise ConfigurationError(f"class-K function {texts}; write numbers as floats")
        _require_increasing(expression)
        if sp.diff(expression, S).has(sp.Derivative, sp.Subs):
            raise ConfigurationError(
                f"class-K function {shortened(self)}: sympy cannot tell its slope; write it without"
                " that Abs"
            )

    def __call__(self, value: sp.Expr) -> sp.Expr:
        """Return alpha(value)."""
        return self.expression.subs(S, value)

    def is_smooth(self, order: int) -> bool:
        """Return whether the derivatives up to an order are finite and continuous at 0.

        That is the one place where those of s |s| and the like are not.
        """
        slopes = [
            sp.diff(self.expression, S, i).replace(sp.DiracDelta, lambda *_: sp.Integer(0))
            for i in range(order + 1)
        ]
        if any(slope.has(sp.Derivative, sp.Subs) for slope in slopes):
            return False
        value = sp.lambdify(S, slopes, _MODULES)
        try:
            with mpmath.workdps(_DIGITS):
                middle, below, above, wide = [
                    value(mpmath.mpf(s)) for s in (0, -_NEAR, _NEAR, 1e6 * _NEAR)
                ]
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
    """Return the function rate s |s|^(exponent - 1), which is rate s^exponent for an odd exponent.

    Args:
        rate: positive.
        exponent: at least 1: below that the slope at 0 is infinite, and the closed loop need not
            have a solution.

    Raises:
        ConfigurationError: an argument is out of its range.
    """
    if not (finite_number("rate", rate) > 0 and finite_number("exponent", exponent) >= 1):
        raise ConfigurationError(
            f"rate = {rate}, exponent = {exponent}; give a positive rate and an exponent of at"
            " least 1"
        )
    if exponent == int(exponent):
        exponent = int(exponent)
    odd = isinstance(exponent, int) and exponent % 2 == 1
    return ClassK(sp.sympify(rate) * (S**exponent if odd else S * sp.Abs(S) ** (exponent - 1)))


Rate = float | ClassK
"""A class-K function, with a number p for the linear one p s."""


def entries_of(given: Any) -> tuple[Any, ...]:
    """Return the entries of a sequence; one that is none, or a text, is its only entry."""
    several = isinstance(given, Sequence) and not isinstance(given, str)
    return tuple(given) if several else (given,)


def rates(name: str, given: Any) -> tuple[Rate, ...]:
    """Return class-K functions, the linear ones as positive floats in 1/s.

    Args:
        name: of the parameter, for errors.
        given: a function or a sequence of them, each a number, a text, an expression or a `ClassK`.

    Raises:
        ConfigurationError: there is none, or one is neither a positive number nor a class-K
            function.
    """
    entries = entries_of(given)
    found = tuple(
        ClassK(r) if isinstance(r, str) or getattr(r, "free_symbols", None) else r for r in entries
    )
    numbers = [r for r in found if not isinstance(r, ClassK)]
    if numbers or not found:
        positive_rates(name, numbers)
    return tuple(r if isinstance(r, ClassK) else float(r) for r in found)


def positive_rates(name: str, given: Any) -> tuple[float, ...]:
    """Return linear class-K functions as floats, or say that one is not positive.

    Args:
        name: of the parameter, for errors.
        given: a rate or a sequence of them, in 1/s.

    Raises:
        ConfigurationError: there is none, or one is not a positive finite number.
    """
    entries = entries_of(given)
    try:
        # A text that is a number is one already.
        values = (
            () if any(isinstance(r, str) for r in entries) else tuple(float(r) for r in entries)
        )
    except (TypeError, ValueError, OverflowError):
        values = ()
    if not values or not all(0 < v < float("inf") for v in values):
        listing = ", ".join(r if isinstance(r, str) else shown(r) for r in entries) or "none"
        raise ConfigurationError(f"{name} = {shortened(listing)}; give positive numbers")
    return values


def applied(rate: Rate, value: sp.Expr) -> sp.Expr:
    """Return alpha(value) for a rate of either kind.

    Args:
        rate: the class-K function alpha.
        value: expression to which it is applied.
    """
    return rate(value) if isinstance(rate, ClassK) else sp.Float(rate, 17) * value


def _require_increasing(alpha: sp.Expr) -> None:
    value = sp.lambdify(S, alpha, _MODULES)
    name = shortened(alpha)
    near, far = [k / 100 for k in range(1, 201)], [10 ** (k / 25) for k in range(9, 101)]
    with mpmath.workdps(_DIGITS):
        try:
            at_zero = value(mpmath.mpf(0))
            values = [
                value(mpmath.mpf(s)) for s in (*(-s for s in reversed(near + far)), 0, *near, *far)
            ]
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ConfigurationError(
                f"class-K function {name} has no value somewhere in [-1e4, 1e4]: {error}"
            ) from error
        if any(not isinstance(v, mpmath.mpf) or not mpmath.isfinite(v) for v in values):
            raise ConfigurationError(
                f"class-K function {name} is not real and finite everywhere; for even powers write"
                " s*Abs(s)"
            )
        if at_zero != 0:
            raise ConfigurationError(
                f"class-K function {name} is {mpmath.nstr(at_zero, 4)} at 0; it has to go through 0"
            )
        middle = slice(len(far), len(values) - len(far))
        rising = all(a < b for a, b in pairwise(values[middle]))
        if not rising or any(a > b for a, b in pairwise(values)):
            raise ConfigurationError(
                f"class-K function {name} is not strictly increasing; for even powers write"
                " s*Abs(s)"
            )
