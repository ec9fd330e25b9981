"""From SymPy expressions to functions of intervals: their natural interval extensions.

Each operation of an expression is replaced by its operation on intervals, so that the result holds
all values that the expression takes on intervals of its arguments; it holds more where a symbol
occurs several times. Results are rounded outwards: see `interval_arithmetic`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.computable import excerpt
from safe_envs.dynamics.expression_program import ExpressionProgram, Operation
from safe_envs.dynamics.interval_arithmetic import Interval, IntervalArithmetic, negative
from safe_envs.errors import SystemDefinitionError

__all__ = ["Interval", "IntervalOperations", "interval_function"]

_HALF_PI = math.nextafter(math.pi / 2, 2)
_PI = math.nextafter(math.pi, 4)
_ALL = (-np.inf, np.inf)

_INCREASING: dict[Any, tuple[Callable[..., Any], tuple[float, float]]] = {
    sp.exp: (np.exp, (0.0, np.inf)),
    sp.log: (np.log, _ALL),
    sp.asin: (np.arcsin, (-_HALF_PI, _HALF_PI)),
    sp.atan: (np.arctan, (-_HALF_PI, _HALF_PI)),
    sp.sinh: (np.sinh, _ALL),
    sp.tanh: (np.tanh, (-1.0, 1.0)),
    sp.asinh: (np.arcsinh, _ALL),
    sp.acosh: (np.arccosh, (0.0, np.inf)),
    sp.atanh: (np.arctanh, _ALL),
}
_STEPS = {sp.sign: np.sign, sp.floor: np.floor, sp.ceiling: np.ceil}

IntervalFunction = Callable[[Sequence[Any]], tuple[Interval, ...]]


class IntervalOperations(IntervalArithmetic):
    """Interval arithmetic with the functions of expressions, by their SymPy classes."""

    def constant(self, number: Any) -> Interval:
        """Return the floats around a real number, or a point if it is one.

        Args:
            number: of SymPy.

        Raises:
            SystemDefinitionError: It is not real.
        """
        exact = number.is_Rational or number.is_Float
        try:
            value = float(number if exact else sp.N(number, 40))
        except TypeError as error:
            raise SystemDefinitionError(f"{excerpt(number)} is not a real number") from error
        if math.isnan(value):
            raise SystemDefinitionError(f"{excerpt(number)} is not a real number")
        if exact and sp.Rational(number) == sp.Rational(value):
            return Interval(value, value)
        return Interval(math.nextafter(value, -math.inf), math.nextafter(value, math.inf))

    def size(self, a: Interval) -> int:
        """Return the number of entries of an interval."""
        return int(np.size(a.low))

    def function(self, kind: Any) -> Operation:
        """Return a function of one argument."""
        if kind in _INCREASING:
            function, ends = _INCREASING[kind]
            return partial(self.increasing, function, ends=ends)
        others: dict[Any, Operation] = {
            sp.sin: partial(self.wave, np.sin, peak=0.25),
            sp.cos: partial(self.wave, np.cos, peak=0.0),
            sp.tan: self.tan,
            sp.acos: lambda a: negative(self.increasing(_negative_arccos, a, (-_PI, 0.0))),
            sp.cosh: lambda a: self.increasing(np.cosh, self.absolute(a), (1.0, np.inf)),
            sp.Abs: self.absolute,
        }
        return others[kind]

    def step(self, kind: Any) -> Operation:
        """Return the sign, or a rounding down or up."""
        step = _STEPS[kind]
        return lambda a: Interval(step(a.low), step(a.high))

    def extreme(self, kind: Any) -> Operation:
        """Return the larger or the smaller of two."""
        chosen = np.maximum if kind is sp.Max else np.minimum
        return lambda a, b: Interval(chosen(a.low, b.low), chosen(a.high, b.high))


def interval_function(
    symbols: Sequence[sp.Symbol], expressions: Sequence[Any], rounded: bool = True
) -> IntervalFunction:
    """Compile expressions into a function of intervals; common subexpressions are shared.

    Args:
        symbols: arguments, in the order in which the function takes them.
        expressions: what it returns, in order; every free symbol must be an argument.
        rounded: whether results hold all values in spite of rounding. False is quicker, and for a
            caller that widens the results itself.

    Returns:
        A function of one sequence of `len(symbols)` intervals, floats or arrays, which broadcast
        against each other. It returns an `Interval` for each expression, of the shape that its
        symbols have together. Where an argument reaches beyond the domain of an operation, the
        result of this operation is the whole line. The arrays returned may be those given, and must
        not be changed in place.

    Raises:
        SystemDefinitionError: An expression holds a symbol that is no argument, a function without
            an interval form here, or a number that is not real; or a symbol is an argument twice.
    """
    return _compile(tuple(symbols), tuple(sp.sympify(e) for e in expressions), rounded)


@lru_cache(maxsize=256)
def _compile(
    symbols: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...], rounded: bool
) -> IntervalFunction:
    return _IntervalProgram(symbols, expressions, rounded)


class _IntervalProgram:
    """A function of intervals, which is pickled as the expressions that it is made of."""

    def __init__(
        self, symbols: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...], rounded: bool
    ) -> None:
        self._source = symbols, expressions, rounded
        self._program = ExpressionProgram(symbols, expressions, IntervalOperations(rounded))

    def __call__(self, values: Sequence[Any]) -> tuple[Interval, ...]:
        return self._program([_interval(v) for v in values])

    def __reduce__(self) -> tuple[Any, ...]:
        return _compile, self._source

    def __deepcopy__(self, memo: dict[int, Any]) -> _IntervalProgram:
        return self


def _negative_arccos(values: Any) -> Any:
    return np.negative(np.arccos(values))


def _interval(value: Any) -> Interval:
    if isinstance(value, tuple):
        low, high = value
        if np.shape(low) != np.shape(high):
            low, high = np.broadcast_arrays(low, high)
        return Interval(low, high)
    return Interval(value, value)
