"""Formulas of a problem as functions of a compiled program.

Compiled code has whole numbers of 64 bits, in which a huge `floor` does not fit, and its `max` and
`min` may lose a NaN, which has to show.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor
from typing import Any

import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from safe_envs.dynamics.codegen import FloatPrinter, excerpt, prepared
from safe_envs.engine.slots import Data
from safe_envs.engine.trigonometry_kernel import arc_tangent, cosine, sine
from safe_envs.errors import SystemDefinitionError

WHOLE_FROM = 2.0**52
"""Size from which on all numbers are whole."""


def formula_floor(value: float) -> float:
    """Return the largest whole number that is not above a number."""
    return float(floor(value)) if abs(value) < WHOLE_FROM else value


def formula_ceiling(value: float) -> float:
    """Return the smallest whole number that is not below a number."""
    return float(ceil(value)) if abs(value) < WHOLE_FROM else value


def formula_sign(value: float) -> float:
    """Return -1, 0 or 1; NaN for NaN."""
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else float(value)


def formula_max(a: float, b: float) -> float:
    """Return the larger one of two numbers; NaN where one is.

    Args:
        a: a number.
        b: another one.
    """
    return float(a) if a >= b or a != a else float(b)


def formula_min(a: float, b: float) -> float:
    """Return the smaller one of two numbers; NaN where one is.

    Args:
        a: a number.
        b: another one.
    """
    return float(a) if a <= b or a != a else float(b)


_LARGE = 2**31


@dataclass(frozen=True)
class Source:
    """Generated functions of a program.

    Attributes:
        text: their definitions.
        uses: functions of kernel modules that they call.
        work: entries that they need of the scratch array `work`.
    """

    text: str
    uses: tuple[Callable[..., Any], ...] = ()
    work: int = 0

    def __add__(self, other: Source) -> Source:
        return Source(
            f"{self.text}\n{other.text}",
            (*self.uses, *other.uses),
            max(self.work, other.work),
        )


class _KernelPrinter(FloatPrinter):
    """Prints numbers as entries of the program's data.

    Attributes:
        uses: kernels that the code calls.
    """

    def __init__(self, data: Data) -> None:
        super().__init__()
        self._data = data
        self.uses: list[Callable[..., Any]] = []

    def _print_Float(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        # By way of its digits, as plain floats get it: that may round differently.
        return f"data[{self._data.add([float(super()._print_Float(expr))])}]"

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802
        # Compiled code has whole numbers of 64 bits.
        small = abs(expr) < _LARGE
        return super()._print_Integer(expr) if small else self._print_Float(sp.Float(expr, 17))

    def _call(self, kernel: Callable[..., Any], *arguments: str) -> str:
        if kernel not in self.uses:
            self.uses.append(kernel)
        return f"{kernel.__name__}({', '.join(arguments)})"

    def _nested(self, kernel: Callable[..., Any], expr: Any) -> str:
        first, *others = (self._print(argument) for argument in expr.args)
        for argument in others:
            first = self._call(kernel, first, argument)
        return first

    def _print_Max(self, expr: Any) -> str:  # noqa: N802
        return self._nested(formula_max, expr)

    def _print_Min(self, expr: Any) -> str:  # noqa: N802
        return self._nested(formula_min, expr)

    def _print_sin(self, expr: Any) -> str:
        return self._call(sine, self._print(expr.args[0]))

    def _print_cos(self, expr: Any) -> str:
        return self._call(cosine, self._print(expr.args[0]))

    def _print_atan2(self, expr: Any) -> str:
        return self._call(arc_tangent, *map(self._print, expr.args))

    def _print_sign(self, e: Any) -> str:
        return self._call(formula_sign, self._print(e.args[0]))

    def _print_floor(self, expr: Any) -> str:
        return self._call(formula_floor, self._print(expr.args[0]))

    def _print_ceiling(self, expr: Any) -> str:
        return self._call(formula_ceiling, self._print(expr.args[0]))


def formulas(
    name: str,
    arguments: Mapping[str, Sequence[sp.Symbol] | sp.Symbol],
    expressions: Sequence[Any],
    data: Data,
) -> Source:
    """Return a function that evaluates expressions.

    It takes the arguments by position and the program's data after them, and returns a tuple of
    floats, one for each expression.

    Args:
        name: of the function.
        arguments: by name, the symbols that a tuple of floats stands for, or the symbol that a
            float stands for.
        expressions: real formulas of the symbols.
        data: receives their numbers.

    Raises:
        SystemDefinitionError: See `safe_envs.dynamics.codegen.compile_function`.
    """
    symbols = [
        s
        for given in arguments.values()
        for s in ([given] if isinstance(given, sp.Symbol) else given)
    ]
    exprs = tuple(sp.sympify(e) for e in expressions)
    names, _, _, (shared, results) = prepared(tuple(symbols), exprs)
    plain = dict(zip(symbols, names, strict=True))
    used = {str(s) for e in (*results, *(value for _, value in shared)) for s in e.free_symbols}
    printer = _KernelPrinter(data)
    lines = [f"def {name}({', '.join([*arguments, 'data'])}):"]
    for argument, given in arguments.items():
        single = isinstance(given, sp.Symbol)
        for i, symbol in enumerate([given] if single else given):
            if str(plain[symbol]) in used:
                entry = argument if single else f"{argument}[{i}]"
                lines.append(f"    {plain[symbol]} = {entry}")
    try:
        lines += [f"    {symbol} = {printer.doprint(value)}" for symbol, value in shared]
        entries = [f"float({printer.doprint(e)})," for e in results]
    except PrintMethodNotImplementedError as error:
        raise SystemDefinitionError(
            f"{excerpt(exprs)} has no numerical form: {str(error).splitlines()[0]}"
        ) from error
    lines.append(f"    return ({' '.join(entries)})")
    return Source("\n".join(lines) + "\n", tuple(printer.uses))
