"""From SymPy expressions to programs: each operation carried out on values of some arithmetic.

The values are intervals (`intervals`) or first-order forms (`forms`). Both enclose what
the expressions are, so that a program encloses them too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import excerpt, require_computable
from safe_envs.errors import SystemDefinitionError

Operation = Callable[..., Any]

_FUNCTIONS = (
    *(sp.exp, sp.log, sp.sin, sp.cos, sp.tan, sp.asin, sp.acos, sp.atan, sp.Abs),
    *(sp.sinh, sp.cosh, sp.tanh, sp.asinh, sp.acosh, sp.atanh),
)
_STEPS = (sp.sign, sp.floor, sp.ceiling)
_INVERSES = {
    sp.sec: sp.cos,
    sp.csc: sp.sin,
    sp.cot: sp.tan,
    sp.sech: sp.cosh,
    sp.csch: sp.sinh,
    sp.coth: sp.tanh,
}
_EXTREMES: dict[Any, Any] = {
    sp.Max: sp.Function("_largest", real=True),
    sp.Min: sp.Function("_smallest", real=True),
}
"""Functions in their place while common parts are looked for."""


class ExpressionProgram:
    """Operations in the order in which they are carried out, each on the results of others.

    Args:
        symbols: arguments, in the order in which the program takes them.
        expressions: what it returns, in order; every free symbol must be an argument.
        arithmetic: operations on values, with the methods of `intervals.IntervalArithmetic`.

    Raises:
        SystemDefinitionError: An expression holds a symbol that is no argument, a function without
            an interval form, or a number that is not real; or a symbol is an argument twice.
    """

    def __init__(
        self, symbols: Sequence[sp.Symbol], expressions: Sequence[Any], arithmetic: Any
    ) -> None:
        for expression in expressions:
            require_computable(expression, tuple(symbols))
            _require_known(expression)
        self._known: dict[Any, int] = {symbol: i for i, symbol in enumerate(symbols)}
        self._arguments = self._size = len(symbols)
        self._constants: list[tuple[int, Any]] = []
        self._operations: list[tuple[Operation, tuple[int, ...], int]] = []
        self._arithmetic = arithmetic
        shared: Any
        reduced: Any
        # SymPy compares the parts of Max and Min in pairs whenever it makes one.
        opaque = [
            sp.sympify(e).replace(sp.Max, _EXTREMES[sp.Max]).replace(sp.Min, _EXTREMES[sp.Min])
            for e in expressions
        ]
        shared, reduced = sp.cse(opaque, symbols=sp.numbered_symbols(cls=sp.Dummy), list=False)
        for symbol, expression in shared:
            self._known[symbol] = self._slot(expression)
        self._results = [self._slot(e) for e in reduced]
        self._steps = self._with_last_uses()

    def _slot(self, expression: Any) -> int:
        """Return the place of the result of an expression, after adding what computes it."""
        if expression not in self._known:
            if _is_plain(expression):
                self._constants.append((self._size, self._arithmetic.constant(expression)))
            else:
                operation, parts = self._operation(expression)
                places = tuple(self._slot(p) for p in parts)
                self._operations.append((operation, places, self._size))
            self._known[expression] = self._size
            self._size += 1
        return self._known[expression]

    def _operation(self, expression: Any) -> tuple[Operation, Sequence[Any]]:
        """Return an operation on values, and the expressions of which it takes the results."""
        ops = self._arithmetic
        kind, parts = expression.func, expression.args
        if kind is sp.Add:
            return partial(self._folded, ops.add), parts
        if kind is sp.Mul:
            powers = Counter(parts)
            return partial(self._folded, ops.multiply), [
                part if n == 1 else sp.Pow(part, n) for part, n in powers.items()
            ]
        if kind is sp.Pow:
            return self._power(*parts)
        if kind in _FUNCTIONS and len(parts) == 1:
            return ops.function(kind), parts
        if kind in _STEPS:
            return ops.step(kind), parts
        if kind in _INVERSES:
            return ops.reciprocal, [_INVERSES[kind](*parts)]
        for extreme, opaque in _EXTREMES.items():
            if kind in (extreme, opaque):
                return partial(self._folded, ops.extreme(extreme)), parts
        if kind is sp.atan2:
            return ops.atan2, parts
        raise SystemDefinitionError(f"{excerpt(expression)} has no interval form")

    def _power(self, base: Any, exponent: Any) -> tuple[Operation, Sequence[Any]]:
        ops = self._arithmetic
        if exponent.is_number:
            # Exactly: a number that rounds to a whole one is none.
            exact = sp.Rational(exponent) if exponent.is_Rational or exponent.is_Float else None
            if exact and exact.is_Integer:
                return partial(ops.integer_power, n=int(exact)), [base]
            if exact == sp.Rational(1, 2):
                return ops.square_root, [base]
            if exact == sp.Rational(-1, 2):
                return lambda a: ops.reciprocal(ops.square_root(a)), [base]
            if _is_plain(exponent):
                constant = ops.constant(exponent)
                return lambda a: ops.real_power(a, constant), [base]
        return ops.function(sp.exp), [sp.Mul(exponent, sp.log(base), evaluate=False)]

    def _folded(self, operation: Operation, *values: Any) -> Any:
        """Return the operation on all values, the small ones first, for arrays grow on the way."""
        first, *others = sorted(values, key=self._arithmetic.size)
        for other in others:
            first = operation(first, other)
        return first

    def _with_last_uses(self) -> list[tuple[Operation, tuple[int, ...], int, list[int]]]:
        """Return the operations, each with the results that nobody needs after it."""
        last = {place: i for i, (_, places, _) in enumerate(self._operations) for place in places}
        kept = set(self._results)
        return [
            (operation, places, target, [p for p in set(places) - kept if last[p] == i])
            for i, (operation, places, target) in enumerate(self._operations)
        ]

    def __call__(self, values: Sequence[Any]) -> tuple[Any, ...]:
        """Return the enclosures of the expressions.

        Args:
            values: of the symbols.
        """
        if len(values) != self._arguments:
            raise TypeError(f"a function of {self._arguments} values got {len(values)}")
        memory: list[Any] = [*values, *[None] * (self._size - self._arguments)]
        for place, constant in self._constants:
            memory[place] = constant
        with np.errstate(all="ignore"):
            for operation, places, target, done in self._steps:
                memory[target] = operation(*[memory[p] for p in places])
                for place in done:
                    memory[place] = None
        return tuple(memory[place] for place in self._results)


def _is_plain(expression: Any) -> bool:
    """Return whether an expression is a number that is not composed of others."""
    # A composed one is carried out, for digits of sin(1)^2 + cos(1)^2 - 1 say nothing of its sign.
    return expression.is_Rational or expression.is_Float or isinstance(expression, sp.NumberSymbol)


def _require_known(expression: Any) -> None:
    known = (*_FUNCTIONS, *_STEPS, *_INVERSES, sp.atan2, sp.Max, sp.Min)
    strange = {f.func for f in expression.atoms(sp.Function) if not isinstance(f, known)}
    if strange:
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds {', '.join(sorted(map(str, strange)))}, which has no"
            " interval form; write it with powers, exponentials, logarithms, trigonometric and"
            " hyperbolic functions, Abs, Max, Min, sign, floor and ceiling"
        )
