"""Class-K functions: strictly increasing functions through 0, linear ones as plain rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mpmath
import sympy as sp
from sympy.printing.str import StrPrinter

from safe_envs.errors import ConfigurationError, shortened, shown
from safe_envs.number_text import finite_number
from safe_envs.wrappers.conditions.class_k_text import S, parsed

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
    """Return the modulus of a number.

    That of a complex number is real, but floats have no complex number on the way there.
    """
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
