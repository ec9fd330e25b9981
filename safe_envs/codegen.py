"""From sympy expressions to functions of plain floats, or of NumPy arrays over any batch.

Both flavours take their arguments one by one, component by component, and return a tuple: with arrays, every
component is an array over the batch, so that elementwise arithmetic runs on contiguous memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import sympy as sp
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.pycode import PythonCodePrinter

Flavour = Literal["floats", "arrays"]
Components = tuple[Any, ...]

_LARGEST_EXPANDED_POWER = 8
_REMEMBERED = 4


class _Remembering:
    """A costly ufunc that knows the last few arrays it was applied to.

    The observation, the filter and the next step ask for the sine of one and the same heading. Arrays are told
    apart by identity, so they must not be changed in place between calls: `compile_function` asks for that.
    """

    def __init__(self, ufunc: np.ufunc) -> None:
        self._ufunc = ufunc
        self._known: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __call__(self, argument: Any) -> Any:
        if type(argument) is not np.ndarray:
            return self._ufunc(argument)
        entry = self._known.get(id(argument))
        if entry is not None and entry[0] is argument:
            return entry[1]
        value = self._ufunc(argument)
        value.flags.writeable = False
        if len(self._known) >= _REMEMBERED:
            self._known = {}
        self._known[id(argument)] = (argument, value)
        return value


_ARRAY_FUNCTIONS = {name: _Remembering(getattr(np, name)) for name in ("sin", "cos")}


_PRINTER_SETTINGS = {"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True}


class _ArrayPrinter(NumPyPrinter):
    """Prints Min and Max as nested binary ufuncs, where sympy stacks the operands first, and names the constants.

    Attributes:
        constants: arrays without axes by name: see `constants`.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__(settings)
        self.constants: dict[str, np.ndarray] = {}

    def _named_constant(self, expr: Any) -> str:
        name = f"_c{len(self.constants)}"
        self.constants[name] = np.array(float(expr))
        return name

    def _as_ordered_terms(self, expr: Any, order: str | None = None) -> list[Any]:
        # A sum that begins with a negative term would cost a negation of its own.
        return sorted(super()._as_ordered_terms(expr, order), key=lambda term: term.could_extract_minus_sign())

    _print_Float = _print_Integer = _print_Rational = _print_Pi = _named_constant  # noqa: N815

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802  (sympy's dispatch by name)
        # NumPy's power has short cuts for exponents that are literal.
        return NumPyPrinter(_PRINTER_SETTINGS)._print_Pow(expr, rational)

    def _nested(self, function: str, expression: Any) -> str:
        first, *others = expression.args
        code = self._print(first)
        for argument in others:
            code = f"{self._module_format('numpy.' + function)}({code}, {self._print(argument)})"
        return code

    def _print_Max(self, expr: Any) -> str:  # noqa: N802
        return self._nested("maximum", expr)

    def _print_Min(self, expr: Any) -> str:  # noqa: N802
        return self._nested("minimum", expr)


def compile_function(arguments: Sequence[sp.Symbol], expressions: Sequence[Any], flavour: Flavour) -> Callable[..., Components]:
    """Compile expressions that share their common subexpressions.

    Args:
        arguments: symbols, in the order in which the function takes them.
        expressions: what it returns, in order; every free symbol must be an argument.
        flavour: "floats" for plain floats, "arrays" for NumPy arrays that broadcast against each other.

    Returns:
        A function of `len(arguments)` positional arguments that returns a tuple of `len(expressions)`. An
        expression without any argument in it comes back as a number without axes. Neither the arrays given nor
        those returned may be changed in place.
    """
    return _compile(tuple(arguments), tuple(sp.sympify(e) for e in expressions), flavour)


@lru_cache(maxsize=1024)
def _compile(arguments: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...], flavour: Flavour) -> Callable[..., Components]:
    arrays = _ArrayPrinter(_PRINTER_SETTINGS)
    function = sp.lambdify(
        arguments,
        tuple(sp.Float(sp.N(e, 17), 17) if e.is_number else e for e in expressions),
        modules=[_ARRAY_FUNCTIONS, np] if flavour == "arrays" else [math],
        printer=arrays if flavour == "arrays" else PythonCodePrinter(_PRINTER_SETTINGS),
        cse=_shared_subexpressions,  # pyright: ignore[reportArgumentType]  (annotated as bool, documented as callable)
        docstring_limit=0,
    )
    function.__globals__.update(arrays.constants)
    return function


def _shared_subexpressions(expressions: Any) -> tuple[list[tuple[sp.Symbol, sp.Expr]], list[sp.Expr]]:
    """Common subexpressions, with small integer powers written as products: `pow` is many times slower."""
    shared: Any
    reduced: Any
    shared, reduced = sp.cse(expressions, list=False)
    fresh = sp.numbered_symbols("p", exclude=set().union(*(e.free_symbols for e in (*reduced, *(s for s, _ in shared)))))
    replacements: list[tuple[sp.Symbol, sp.Expr]] = []

    def expand(expression: Any) -> Any:
        if not expression.args:
            return expression
        arguments = [expand(a) for a in expression.args]
        if isinstance(expression, sp.Pow) and expression.exp.is_Integer and 2 <= abs(expression.exp) <= _LARGEST_EXPANDED_POWER:
            base = arguments[0]
            if not base.is_Symbol:
                symbol = next(fresh)
                replacements.append((symbol, base))
                base = symbol
            product = sp.Mul(*[base] * abs(int(expression.exp)), evaluate=False)
            return product if expression.exp > 0 else sp.Pow(product, -1, evaluate=False)
        if arguments == list(expression.args):
            return expression
        # Only these would undo what was done, and not every other function knows the word.
        as_it_is = {"evaluate": False} if isinstance(expression, sp.Add | sp.Mul | sp.Pow) else {}
        return expression.func(*arguments, **as_it_is)

    for symbol, expression in shared:
        expanded = expand(expression)
        replacements.append((symbol, expanded))
    return replacements, type(reduced)(expand(e) for e in reduced)


def constants(values: Sequence[float]) -> list[np.ndarray]:
    """Numbers as arrays without axes: a ufunc converts a Python float anew at every call, for as long as a small batch takes."""
    return [np.array(v) for v in values]


def filled(component: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A component as an array of the batch's shape: what does not depend on the arguments comes back as a float."""
    return component if getattr(component, "shape", None) == shape else np.full(shape, component)


def stacked(components: Sequence[Any], size: int) -> np.ndarray:
    """Components side by side, shape (size, len(components)), in memory of their own."""
    table = np.empty((len(components), size))
    for row, component in zip(table, components, strict=True):
        row[:] = component
    return table.T


def finite(values: np.ndarray) -> bool:
    """Whether no entry is NaN or infinite; a quick look that may report huge finite entries as infinite."""
    flat = values.ravel()
    return math.isfinite(flat.dot(flat))
