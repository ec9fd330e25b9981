"""From SymPy expressions to functions of intervals: their natural interval extensions.

Each operation of an expression is replaced by its operation on intervals, so that the result holds
all values that the expression takes on intervals of its arguments; it holds more where a symbol
occurs several times. Results are rounded outwards: see `interval_arithmetic`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.computable import excerpt, require_computable
from safe_envs.dynamics.interval_arithmetic import Interval, IntervalArithmetic, negative
from safe_envs.errors import SystemDefinitionError

__all__ = ["Interval", "interval_function"]

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
_INVERSES = {
    sp.sec: sp.cos,
    sp.csc: sp.sin,
    sp.cot: sp.tan,
    sp.sech: sp.cosh,
    sp.csch: sp.sinh,
    sp.coth: sp.tanh,
}

Operation = Callable[..., Interval]
IntervalFunction = Callable[[Sequence[Any]], tuple[Interval, ...]]


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
    for expression in expressions:
        require_computable(expression, symbols)
        strange = {f.func for f in expression.atoms(sp.Function) if _is_unknown(f)}
        if strange:
            raise SystemDefinitionError(
                f"{excerpt(expression)} holds {', '.join(sorted(map(str, strange)))}, which has no"
                " interval form; write it with powers, exponentials, logarithms, trigonometric and"
                " hyperbolic functions, Abs, Max, Min, sign, floor and ceiling"
            )
    shared: Any
    reduced: Any
    shared, reduced = sp.cse(expressions, symbols=sp.numbered_symbols(cls=sp.Dummy), list=False)
    program = _Program(symbols, rounded)
    for symbol, expression in shared:
        program.known[symbol] = program.slot(expression)
    return program.function([program.slot(e) for e in reduced])


def _is_unknown(function: Any) -> bool:
    known = (*_INCREASING, *_STEPS, *_INVERSES, sp.sin, sp.cos, sp.tan, sp.acos, sp.cosh, sp.Abs)
    return not isinstance(function, (*known, sp.atan2, sp.Max, sp.Min))


class _Program:
    """Operations in the order in which they are carried out, each on the results of others.

    Attributes:
        known: the places of the results that are at hand, by expression.
    """

    def __init__(self, symbols: tuple[sp.Symbol, ...], rounded: bool) -> None:
        self.known: dict[Any, int] = {symbol: i for i, symbol in enumerate(symbols)}
        self._arguments = len(symbols)
        self._size = len(symbols)
        self._constants: list[tuple[int, Interval]] = []
        self._operations: list[tuple[Operation, tuple[int, ...], int]] = []
        self._arithmetic = IntervalArithmetic(rounded)

    def slot(self, expression: Any) -> int:
        """Return the place of the result of an expression, after adding what computes it."""
        if expression not in self.known:
            if expression.is_number:
                self._constants.append((self._size, _enclosure(expression)))
                self._size += 1
                self.known[expression] = self._size - 1
            else:
                operation, parts = self._operation(expression)
                self.known[expression] = self._append(operation, [self.slot(p) for p in parts])
        return self.known[expression]

    def _append(self, operation: Operation, places: Sequence[int]) -> int:
        self._operations.append((operation, tuple(places), self._size))
        self._size += 1
        return self._size - 1

    def _operation(self, expression: Any) -> tuple[Operation, Sequence[Any]]:
        """Return an operation on intervals, and the expressions of which it takes the results."""
        ops = self._arithmetic
        kind, parts = expression.func, expression.args
        if kind is sp.Add:
            return partial(_folded, ops.add), parts
        if kind is sp.Mul:
            powers = Counter(parts)
            return partial(_folded, ops.multiply), [
                part if n == 1 else sp.Pow(part, n) for part, n in powers.items()
            ]
        if kind is sp.Pow:
            return self._power(*parts)
        if kind in _INCREASING and len(parts) == 1:
            function, ends = _INCREASING[kind]
            return partial(ops.increasing, function, ends=ends), parts
        if kind in _STEPS:
            step = _STEPS[kind]
            return lambda a: Interval(step(a.low), step(a.high)), parts
        if kind in _INVERSES:
            return ops.reciprocal, [_INVERSES[kind](*parts)]
        if kind in (sp.Max, sp.Min):
            chosen = np.maximum if kind is sp.Max else np.minimum
            return partial(
                _folded, lambda a, b: Interval(chosen(a.low, b.low), chosen(a.high, b.high))
            ), parts
        others: dict[Any, Operation] = {
            sp.sin: partial(ops.wave, np.sin, peak=0.25),
            sp.cos: partial(ops.wave, np.cos, peak=0.0),
            sp.tan: ops.tan,
            sp.acos: lambda a: negative(ops.increasing(_negative_arccos, a, (-_PI, 0.0))),
            sp.cosh: lambda a: ops.increasing(np.cosh, ops.absolute(a), (1.0, np.inf)),
            sp.Abs: ops.absolute,
            sp.atan2: ops.atan2,
        }
        if kind not in others:
            raise SystemDefinitionError(f"{excerpt(expression)} has no interval form")
        return others[kind], parts

    def _power(self, base: Any, exponent: Any) -> tuple[Operation, Sequence[Any]]:
        ops = self._arithmetic
        if exponent.is_Integer:
            return partial(ops.integer_power, n=int(exponent)), [base]
        if exponent.is_number:
            constant = _enclosure(exponent)
            value = constant.low if constant.low == constant.high else 0.0
            if value and value.is_integer():
                return partial(ops.integer_power, n=int(value)), [base]
            if value == 0.5:
                return ops.square_root, [base]
            if value == -0.5:
                return lambda a: ops.reciprocal(ops.square_root(a)), [base]
            return lambda a: ops.real_power(a, constant), [base]
        return partial(ops.increasing, np.exp, ends=(0.0, np.inf)), [
            sp.Mul(exponent, sp.log(base), evaluate=False)
        ]

    def function(self, results: Sequence[int]) -> IntervalFunction:
        """Return the function that carries out the operations, and drops what nobody needs."""
        last = {place: i for i, (_, places, _) in enumerate(self._operations) for place in places}
        steps = [
            (operation, places, target, [p for p in set(places) - set(results) if last[p] == i])
            for i, (operation, places, target) in enumerate(self._operations)
        ]
        constants, arguments, size = self._constants, self._arguments, self._size

        def evaluate(values: Sequence[Any]) -> tuple[Interval, ...]:
            if len(values) != arguments:
                raise TypeError(f"a function of {arguments} intervals got {len(values)}")
            memory: list[Any] = [*map(_interval, values), *[None] * (size - arguments)]
            for place, constant in constants:
                memory[place] = constant
            with np.errstate(all="ignore"):
                for operation, places, target, done in steps:
                    memory[target] = operation(*[memory[p] for p in places])
                    for place in done:
                        memory[place] = None
            return tuple(memory[place] for place in results)

        return evaluate


def _folded(operation: Operation, *intervals: Interval) -> Interval:
    """Return the operation on all intervals, the small ones first, for arrays grow on the way."""
    first, *others = sorted(intervals, key=lambda a: np.size(a.low))
    for other in others:
        first = operation(first, other)
    return first


def _negative_arccos(values: Any) -> Any:
    return np.negative(np.arccos(values))


def _interval(value: Any) -> Interval:
    if isinstance(value, tuple):
        low, high = value
        if np.shape(low) != np.shape(high):
            low, high = np.broadcast_arrays(low, high)
        return Interval(low, high)
    return Interval(value, value)


def _enclosure(number: Any) -> Interval:
    """Return the floats around a real number, or a point if it is one."""
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
