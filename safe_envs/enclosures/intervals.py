"""Interval arithmetic, and functions of intervals compiled from SymPy expressions.

An interval [a, b] holds every real number x with a <= x <= b; an infinite end says that there is no
bound on this side. Each operation returns intervals that hold all values of the exact operation on
numbers of its arguments. Ends are never NaN: where nothing is known the interval is the whole line.
A compiled expression carries out each of its operations on intervals (its natural interval
extension), so that the result holds all of its values, and more where a symbol occurs twice.

Rounding: in floating point s = x + y, and s - c|s| with c = 2^-52 is at most the exact sum, for the
error of s is at most half of its last place, c|s| at least one, and sums below 2^-1021 are exact. A
sum of 0 is exact as well, and stays 0, so that a root of a sum of squares has its domain. Products
may underflow besides, which costs the smallest positive number more. `np.nextafter` would gain half
of that, and takes eight times as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import excerpt
from safe_envs.enclosures.expression_program import ExpressionProgram, Operation
from safe_envs.errors import SystemDefinitionError

_LAST_PLACE = 2.0**-52
_SMALLEST = 5e-324
# NumPy's vectorised functions are off by less than 4 units in the last place.
_ULPS_OF_FUNCTIONS = 5
_LONGEST_PRODUCT = 64


class Interval(NamedTuple):
    """Closed intervals: floats, or arrays of one shape.

    A point, an interval of one number, has one object as both of its ends; this makes it cheap.

    Attributes:
        low: lower ends, -inf for none.
        high: upper ends, inf for none.
    """

    low: Any
    high: Any


def _in_place(array: Any) -> Any:
    return array if isinstance(array, np.ndarray) else None


def _at_least(values: Any, bound: float) -> Any:
    """Return fresh values raised to a bound; NaN becomes the bound."""
    return np.fmax(values, bound, out=_in_place(values))


def _at_most(values: Any, bound: float) -> Any:
    return np.fmin(values, bound, out=_in_place(values))


def _is_point(a: Interval) -> bool:
    return a.low is a.high


def _is_nonnegative(a: Interval) -> bool:
    return bool(np.min(a.low) >= 0)


def negative(a: Interval) -> Interval:
    """Return -a."""
    low = np.negative(a.high)
    return Interval(low, low if _is_point(a) else np.negative(a.low))


def _without_bounds_at(where: Any, a: Interval) -> Interval:
    """Return a with the whole line at some entries."""
    if not np.any(where):
        return a
    return Interval(np.where(where, -np.inf, a.low), np.where(where, np.inf, a.high))


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


class IntervalArithmetic:
    """Operations on intervals, whose ends broadcast against each other.

    Functions of one argument are named by their SymPy classes. The letters a, b, x and y stand for
    intervals, n for a whole number, e for a point or an interval of two adjacent floats.

    Args:
        rounded: whether ends are rounded outwards. Without it they have the errors of floating
            point, and the caller has to widen them.
    """

    def __init__(self, rounded: bool = True) -> None:
        self._rounded = rounded

    def _slack(self, values: Any, ulps: int, tiny: float) -> Any:
        slack = np.abs(values)
        slack = np.multiply(slack, ulps * _LAST_PLACE, out=_in_place(slack))
        return np.add(slack, tiny, out=_in_place(slack)) if tiny else slack

    def _outward(
        self, low: Any, high: Any, ulps: int = 1, tiny: float = 0.0, ends: Any = (-np.inf, np.inf)
    ) -> Interval:
        """Return the interval between fresh values that are off by some units in the last place."""
        if not self._rounded:
            if high is low and not np.any(np.isnan(low)):
                low = _at_most(_at_least(low, ends[0]), ends[1])
                return Interval(low, low)
            upper = np.array(high) if high is low else high
            return Interval(_at_least(low, ends[0]), _at_most(upper, ends[1]))
        slack = self._slack(low, ulps, tiny)
        if high is low:
            upper = np.add(low, slack)
        else:
            above = self._slack(high, ulps, tiny)
            upper = np.add(high, above, out=_in_place(above))
        lower = np.subtract(low, slack, out=_in_place(slack))
        return Interval(_at_least(lower, ends[0]), _at_most(upper, ends[1]))

    def add(self, a: Interval, b: Interval) -> Interval:
        """Return a + b; see `IntervalArithmetic`."""
        low = np.add(a.low, b.low)
        return self._outward(low, low if _is_point(a) and _is_point(b) else np.add(a.high, b.high))

    def multiply(self, a: Interval, b: Interval) -> Interval:
        """Return a b; see `IntervalArithmetic`."""
        if _is_point(b) and np.ndim(b.low) == 0:
            a, b = b, a
        if _is_point(a) and np.ndim(a.low) == 0:
            if a.low < 0:
                return self.multiply(negative(a), negative(b))
            if a.low == 1:
                return b
        both = _is_nonnegative(a) and _is_nonnegative(b)
        ends = (0.0 if both else -np.inf, np.inf)
        low, high = self._products(a, b, both)
        return self._outward(low, high, tiny=_SMALLEST, ends=ends)

    def _products(self, a: Interval, b: Interval, nonnegative: bool) -> tuple[Any, Any]:
        if _is_point(a) and _is_point(b):
            product = np.multiply(a.low, b.low)
            return product, product
        if nonnegative or (_is_point(a) and np.ndim(a.low) == 0 and a.low >= 0):
            return np.multiply(a.low, b.low), np.multiply(a.high, b.high)
        if _is_point(b) or _is_nonnegative(b):
            a, b = b, a
        if _is_point(a):
            below, above = (np.multiply(a.low, end) for end in b)
            return np.minimum(below, above), np.maximum(below, above)
        if _is_nonnegative(a):
            low, other = np.multiply(a.low, b.low), np.multiply(a.high, b.low)
            low = np.minimum(low, other, out=_in_place(low))
            high, other = np.multiply(a.low, b.high), np.multiply(a.high, b.high)
            return low, np.maximum(high, other, out=_in_place(high))
        low = np.multiply(a.low, b.low)
        high = np.array(low)
        for left, right in ((a.low, b.high), (a.high, b.low), (a.high, b.high)):
            product = np.multiply(left, right)
            low = np.minimum(low, product, out=_in_place(low))
            high = np.maximum(high, product, out=_in_place(high))
        return low, high

    def reciprocal(self, a: Interval) -> Interval:
        """Return 1/a: the whole line where 0 is inside, one side of it where 0 is an end."""
        low = np.divide(1.0, a.high)
        high = low if _is_point(a) else np.divide(1.0, a.low)
        ends = (0.0 if _is_nonnegative(a) else -np.inf, np.inf)
        if not np.any(np.less_equal(a.low, 0) & np.greater_equal(a.high, 0)):
            return self._outward(low, high, tiny=_SMALLEST, ends=ends)
        low = np.where(np.equal(a.high, 0), -np.inf, low)
        high = np.where(np.equal(a.low, 0), np.inf, high)
        inside = np.less(a.low, 0) & np.greater(a.high, 0)
        inside |= np.equal(a.low, 0) & np.equal(a.high, 0)
        return _without_bounds_at(inside, self._outward(low, high, tiny=_SMALLEST, ends=ends))

    def absolute(self, a: Interval) -> Interval:
        """Return |a|."""
        low = np.maximum(a.low, np.negative(a.high))
        return Interval(
            np.maximum(low, 0.0, out=_in_place(low)), np.maximum(np.negative(a.low), a.high)
        )

    def integer_power(self, a: Interval, n: int) -> Interval:
        """Return a^n, as tight as its parity lets it be; see `IntervalArithmetic`."""
        if n == 0:
            return Interval(1.0, 1.0)
        if n < 0:
            return self.reciprocal(self.integer_power(a, -n))
        if n == 1:
            return a
        point = _is_point(a)
        a = self.absolute(a) if n % 2 == 0 else a
        ends = (0.0 if n % 2 == 0 or _is_nonnegative(a) else -np.inf, np.inf)
        if n > _LONGEST_PRODUCT:
            low = np.power(a.low, float(n))
            high = low if point else np.power(a.high, float(n))
            return self._outward(low, high, _ULPS_OF_FUNCTIONS, _SMALLEST, ends)
        low = _repeated_product(a.low, n)
        high = low if point else _repeated_product(a.high, n)
        # n - 1 products, each off by half a unit and by half of the smallest number.
        ulps = 1 if n == 2 else n // 2 + 1
        return self._outward(low, high, ulps, n * _SMALLEST, ends)

    def real_power(self, a: Interval, exponent: Interval) -> Interval:
        """Return a^e, the whole line where a reaches below 0; see `IntervalArithmetic`."""
        if exponent.high <= 0:
            return self.reciprocal(self.real_power(a, negative(exponent)))
        if exponent.low < 0:
            parts = Interval(exponent.low, 0.0), Interval(0.0, exponent.high)
            below, above = (self.real_power(a, part) for part in parts)
            return Interval(np.minimum(below.low, above.low), np.maximum(below.high, above.high))
        outside = np.less(a.low, 0)
        lows = [np.power(np.maximum(a.low, 0.0), e) for e in exponent]
        highs = [np.power(np.maximum(a.high, 0.0), e) for e in exponent]
        low, high = np.minimum(*lows), np.maximum(*highs)
        result = self._outward(low, high, _ULPS_OF_FUNCTIONS, _SMALLEST, (0.0, np.inf))
        return _without_bounds_at(outside, result)

    def square_root(self, a: Interval) -> Interval:
        """Return the root of a; the whole line where a reaches below 0."""
        low = np.sqrt(a.low)
        result = self._outward(low, low if _is_point(a) else np.sqrt(a.high), ends=(0.0, np.inf))
        return _without_bounds_at(np.less(a.low, 0), result)

    def increasing(
        self,
        function: Callable[..., Any],
        a: Interval,
        ends: tuple[float, float] = (-np.inf, np.inf),
    ) -> Interval:
        """Return an increasing function of a; the whole line where it has no value at an end of a.

        Args:
            function: NumPy's, NaN outside of its domain.
            a: argument.
            ends: numbers that no value of the function exceeds.
        """
        low = np.asarray(function(a.low))[()]
        high = low if _is_point(a) else np.asarray(function(a.high))[()]
        outside = np.isnan(low) | np.isnan(high)
        return _without_bounds_at(
            outside, self._outward(low, high, _ULPS_OF_FUNCTIONS, _SMALLEST, ends)
        )

    def wave(self, function: Callable[..., Any], a: Interval, peak: float) -> Interval:
        """Return the sine or the cosine of a.

        Args:
            function: `np.sin` or `np.cos`.
            a: argument.
            peak: where the function is 1, in turns.
        """
        low = function(a.low)
        if _is_point(a):
            return self._outward(low, low, _ULPS_OF_FUNCTIONS, _SMALLEST, (-1.0, 1.0))
        other = function(a.high)
        waves = self._outward(
            np.minimum(low, other), np.maximum(low, other), _ULPS_OF_FUNCTIONS, _SMALLEST, (-1, 1)
        )
        return Interval(
            np.where(_holds(a, 2 * math.pi, peak + 0.5), -1.0, waves.low),
            np.where(_holds(a, 2 * math.pi, peak), 1.0, waves.high),
        )

    def tan(self, a: Interval) -> Interval:
        """Return the tangent of a; the whole line where a pole is inside."""
        return _without_bounds_at(_holds(a, math.pi, 0.5), self.increasing(np.tan, a))

    def atan2(self, y: Interval, x: Interval) -> Interval:
        """Return the angle of (x, y), all where x <= 0 = y is met; see `IntervalArithmetic`."""
        xs = np.where(np.greater_equal(y.low, 0), x.high, x.low)
        low = np.arctan2(np.where(np.greater_equal(xs, 0), y.low, y.high), xs)
        xs = np.where(np.greater(y.high, 0), x.low, x.high)
        high = np.arctan2(np.where(np.greater_equal(xs, 0), y.high, y.low), xs)
        cut = np.less_equal(x.low, 0) & np.less_equal(y.low, 0) & np.greater_equal(y.high, 0)
        angle = self._outward(low, high, _ULPS_OF_FUNCTIONS, _SMALLEST, (-_PI, _PI))
        return Interval(np.where(cut, -_PI, angle.low), np.where(cut, _PI, angle.high))

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
            sp.acos: lambda a: negative(
                self.increasing(lambda v: np.negative(np.arccos(v)), a, (-_PI, 0.0))
            ),
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


def _repeated_product(base: Any, n: int) -> Any:
    result: Any = None
    while n:
        if n % 2:
            result = base if result is None else np.multiply(result, base)
        n //= 2
        base = np.multiply(base, base) if n else base
    return result


def _holds(a: Interval, period: float, phase: float) -> Any:
    """Return whether a holds one of (k + phase) period, or nearly so."""
    first, last = np.divide(a.low, period), np.divide(a.high, period)
    # Four roundings; a point that is this near changes the sine by less than the last place.
    first = np.ceil(first - phase - 4 * _LAST_PLACE * (np.abs(first) + 1))
    last = np.floor(last - phase + 4 * _LAST_PLACE * (np.abs(last) + 1))
    return ~np.greater(first, last)


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
        self._program = ExpressionProgram(symbols, expressions, IntervalArithmetic(rounded))

    def __call__(self, values: Sequence[Any]) -> tuple[Interval, ...]:
        return self._program([_interval(v) for v in values])

    def __reduce__(self) -> tuple[Any, ...]:
        return _compile, self._source

    def __deepcopy__(self, memo: dict[int, Any]) -> _IntervalProgram:
        return self


def _interval(value: Any) -> Interval:
    if isinstance(value, tuple):
        low, high = value
        if np.shape(low) != np.shape(high):
            low, high = np.broadcast_arrays(low, high)
        return Interval(low, high)
    return Interval(value, value)
