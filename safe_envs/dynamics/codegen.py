"""From sympy expressions to functions of plain floats, or of NumPy arrays over any batch.

Both flavours take their arguments one by one, component by component, and return a tuple: with
arrays, every component is an array over the batch, so that elementwise arithmetic runs on
contiguous memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from types import MethodType
from typing import Any, Literal

import numpy as np
import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from safe_envs.dynamics.computable import excerpt
from safe_envs.dynamics.plain_expressions import prepared
from safe_envs.dynamics.printers import ArrayPrinter, FloatPrinter
from safe_envs.errors import SystemDefinitionError

Flavour = Literal["floats", "arrays"]
Components = tuple[Any, ...]

_OWNER = sp.Symbol("owner")
"""First argument of generated code, which makes no use of it."""


_settled: dict[int, np.ndarray] = {}


class _Remembering:
    """A costly ufunc that knows its values at the arrays that were last given to `settled`.

    The observation, the filter and the next step ask for the sine of one and the same heading. No
    other array is remembered: its owner may change it in place between two calls.
    """

    def __init__(self, ufunc: np.ufunc) -> None:
        self._ufunc = ufunc
        self.known: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        # Another object would not be told when its arrays are outdated.
        return _remembering, (self._ufunc.__name__,)

    def __call__(self, argument: Any) -> Any:
        entry = self.known.get(id(argument))
        if entry is not None and entry[0] is argument:
            return entry[1]
        value = self._ufunc(argument)
        if _settled.get(id(argument)) is argument:
            value.setflags(write=False)
            self.known[id(argument)] = (argument, value)
        return value


_REMEMBERING = {name: _Remembering(getattr(np, name)) for name in ("sin", "cos")}


def _remembering(name: str) -> _Remembering:
    return _REMEMBERING[name]


def _elementwise(function: Callable[[float], float]) -> Callable[[Any], np.ndarray]:
    """Return a function of arrays that NumPy lacks, applied to one element at a time."""
    ufunc = np.frompyfunc(function, 1, 1)
    return lambda argument: np.asarray(ufunc(argument), dtype=float)


_ARRAY_FUNCTIONS = {**_REMEMBERING, "erf": _elementwise(math.erf), "erfc": _elementwise(math.erfc)}


def settled(components: Sequence[Any], shape: tuple[int, ...]) -> Components:
    """Return components as read-only arrays whose sines and cosines are computed once.

    Args:
        components: arrays that were made for the caller, and that nobody else can write to, or
            numbers.
        shape: of the arrays returned.
    """
    global _settled
    arrays = tuple(
        [
            a if type(a) is np.ndarray and a.base is None and a.ndim else np.array(filled(a, shape))
            for a in components
        ]
    )
    for array in arrays:
        array.setflags(False)  # pyright: ignore[reportCallIssue]  (a keyword takes three times as long)
    _settled = {id(array): array for array in arrays}
    for function in _REMEMBERING.values():
        function.known = {}
    return arrays


def compile_function(
    arguments: Sequence[sp.Symbol], expressions: Sequence[Any], flavour: Flavour
) -> Callable[..., Components]:
    """Compile expressions that share their common subexpressions.

    Args:
        arguments: symbols, in the order in which the function takes them; their names may be any
            texts.
        expressions: what it returns, in order; every free symbol must be an argument.
        flavour: "floats" for plain floats, "arrays" for NumPy arrays that broadcast against each
            other.

    Returns:
        A function of `len(arguments)` positional arguments that returns a tuple of
        `len(expressions)`. An expression without any argument in it comes back as a number without
        axes. The arrays returned may be those given, and must not be changed in place.

    Raises:
        SystemDefinitionError: an expression holds a symbol that is no argument, a function without
            a numerical form, or a number that is not real or too large; or a symbol is an argument
            twice.
    """
    return _compile(tuple(arguments), tuple(sp.sympify(e) for e in expressions), flavour).evaluate


class _CompiledExpressions:
    """The owner of a compiled function, which is a method of it.

    As a method the function is as fast as without an owner, and is copied and pickled by it: what
    is pickled is the expressions, of which code is generated again.

    Attributes:
        source: arguments, expressions and flavour, of which it is made.
        evaluate: the function.
    """

    __slots__ = ("evaluate", "source")

    def __init__(self, source: tuple[Any, ...], function: Callable[..., Components]) -> None:
        # By its name a method that was pickled is found again.
        function.__name__ = "evaluate"
        self.source, self.evaluate = source, MethodType(function, self)

    def __reduce__(self) -> tuple[Any, ...]:
        return _compile, self.source

    def __deepcopy__(self, memo: dict[int, Any]) -> _CompiledExpressions:
        return self


@lru_cache(maxsize=1024)
def _compile(
    arguments: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...], flavour: Flavour
) -> _CompiledExpressions:
    names, formulas, numbers, shared = prepared(arguments, expressions)
    printer = ArrayPrinter() if flavour == "arrays" else FloatPrinter()
    try:
        function = sp.lambdify(
            (_OWNER, *names),
            numbers,
            modules=[_ARRAY_FUNCTIONS, np] if flavour == "arrays" else [math],
            printer=printer,
            cse=lambda _: shared,  # pyright: ignore[reportArgumentType]  (annotated as bool, documented as callable)
            docstring_limit=0,
        )
    except PrintMethodNotImplementedError as error:
        raise SystemDefinitionError(
            f"{excerpt(expressions)} has no numerical form: {str(error).splitlines()[0]}"
        ) from error
    if isinstance(printer, ArrayPrinter):
        function.__globals__.update(printer.constants)
    elif any(e.has(sp.Piecewise, sp.Heaviside, sp.sinc) for e in formulas):
        function = _piece_by_piece(function, names, formulas)
    return _CompiledExpressions((arguments, expressions, flavour), function)


def _piece_by_piece(
    quick: Callable[..., Components], names: Sequence[sp.Symbol], formulas: Sequence[Any]
) -> Callable[..., Components]:
    """Return a function of floats that evaluates only the pieces that apply.

    A subexpression that other pieces share may have no value.
    """
    careful = sp.lambdify(
        (_OWNER, *names),
        tuple(formulas),
        modules=[math],
        printer=FloatPrinter(),
        docstring_limit=0,
    )

    def function(*arguments: Any) -> Components:
        try:
            return quick(*arguments)
        except (ArithmeticError, ValueError):
            return careful(*arguments)

    return function


def constants(values: Sequence[float]) -> list[np.ndarray]:
    """Return numbers as arrays without axes.

    A ufunc converts a Python float at every call, which takes as long as a small batch.
    """
    return [np.array(v) for v in values]


def filled(component: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a component as an array of the batch's shape; constants come as floats.

    Args:
        component: a number, or an array that broadcasts to the shape.
        shape: of the batch.
    """
    return component if getattr(component, "shape", None) == shape else np.full(shape, component)


def stacked(components: Sequence[Any], size: int) -> np.ndarray:
    """Return components as columns, shape (size, len(components)), in memory of their own.

    Args:
        components: numbers, or arrays of shape (size,).
        size: of the batch.
    """
    table = np.empty((len(components), size))
    for row, component in zip(table, components, strict=True):
        row[:] = component
    return table.T


def finite(values: np.ndarray) -> bool:
    """Return whether no entry is NaN or infinite; huge finite entries may count as infinite."""
    flat = values.ravel()
    return math.isfinite(flat.dot(flat))
