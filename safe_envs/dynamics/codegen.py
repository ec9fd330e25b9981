"""From sympy expressions to functions of plain floats, or of NumPy arrays over any batch.

Both flavours take their arguments one by one, component by component, and return a tuple: with
arrays, every component is an array over the batch, so that elementwise arithmetic runs on
contiguous memory.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from types import MethodType
from typing import Any, Literal

import numpy as np
import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter

from safe_envs.errors import SystemDefinitionError

SUPPORTED = (
    *(sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc, sp.sinc, sp.exp, sp.log, sp.erf, sp.erfc),
    *(sp.asin, sp.acos, sp.atan, sp.atan2, sp.acot, sp.asec, sp.acsc),
    *(sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch, sp.asinh, sp.acosh, sp.atanh),
    *(sp.Abs, sp.sign, sp.Heaviside, sp.Piecewise, sp.floor, sp.ceiling, sp.frac, sp.Mod),
)
"""Functions that have the same values as floats and as arrays, in addition to sums, products,
powers, Max and Min."""

_BASE = sp.Symbol("_base_of_a_power_")

_SETTINGS = {
    "fully_qualified_modules": False,
    "inline": True,
    "allow_unknown_functions": False,
    "strict": True,
}


class FloatPrinter(PythonCodePrinter):
    """Prints code that raises or gives NaN where Python gives a complex number or None."""

    def __init__(self) -> None:
        super().__init__(_SETTINGS)

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802  (sympy's dispatch by name)
        if expr.exp.is_integer or abs(expr.exp) == sp.S.Half:
            return super()._print_Pow(expr, rational)
        return f"pow({self._print(expr.base)}, {self._print(expr.exp)})"

    def _print_Piecewise(self, expr: Any) -> Any:  # noqa: N802
        return super()._print_Piecewise(
            expr if expr.args[-1].cond == sp.true else sp.Piecewise(*expr.args, (sp.nan, True))
        )

    def _print_Mod(self, expr: Any) -> str:  # noqa: N802
        return f"({super()._print_Mod(expr)})"


class ArrayPrinter(NumPyPrinter):
    """Prints Min and Max as nested binary ufuncs, and names the constants.

    Attributes:
        constants: arrays without axes by name: see `constants`.
    """

    def __init__(self) -> None:
        super().__init__(_SETTINGS)
        self.constants: dict[str, np.ndarray] = {}

    def _named_constant(self, expr: Any) -> str:
        name = f"_c{len(self.constants)}"
        self.constants[name] = np.array(float(expr))
        return name

    def _as_ordered_terms(self, expr: Any, order: str | None = None) -> list[Any]:
        # A sum that begins with a negative term would cost a negation of its own.
        return sorted(
            super()._as_ordered_terms(expr, order), key=lambda term: term.could_extract_minus_sign()
        )

    _print_Float = _print_Integer = _print_Rational = _print_Pi = _named_constant  # noqa: N815

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802  (sympy's dispatch by name)
        if not expr.exp.is_number:
            return super()._print_Pow(expr, rational)
        # NumPy's power has short cuts for exponents that are literal. The base is printed here: in
        # it Max and Min may stand.
        code = NumPyPrinter(_SETTINGS)._print_Pow(sp.Pow(_BASE, expr.exp, evaluate=False), rational)
        return code.replace(_BASE.name, self.parenthesize(expr.base, PRECEDENCE["Pow"]))

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


_LARGEST_FLOAT = sp.Rational(sys.float_info.max)
_LONGEST_QUOTED = 120


def require_computable(expression: Any, arguments: tuple[sp.Symbol, ...]) -> None:
    """Check that an expression has a value for numbers in place of its arguments.

    Args:
        expression: any of SymPy's.
        arguments: the symbols that get numbers.

    Raises:
        SystemDefinitionError: It holds another symbol, a function without a numerical form, or a
            number that is not real or too large; or a symbol is an argument twice.
    """
    unknown = expression.free_symbols - set(arguments)
    if unknown:
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds {', '.join(sorted(map(str, unknown)))}, which is none"
            f" of {', '.join(map(str, arguments))}"
        )
    if len(set(arguments)) < len(arguments):
        raise SystemDefinitionError(
            f"a symbol stands for two arguments of {excerpt(expression)}:"
            f" {', '.join(map(str, arguments))}"
        )
    strange = {f.func for f in expression.atoms(sp.Function) if not isinstance(f, SUPPORTED)}
    if strange:
        advice = (
            "; DiracDelta is the derivative of a jump: use a smooth function"
            if sp.DiracDelta in strange
            else ""
        )
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds {', '.join(sorted(map(str, strange)))}, which has no"
            f" numerical form here; write it with {', '.join(f.__name__ for f in SUPPORTED)}, Max"
            f" and Min{advice}"
        )
    if expression.has(sp.I, sp.zoo):
        raise SystemDefinitionError(
            f"{excerpt(expression)} is not real everywhere, or has a division by 0; look at its"
            " numbers"
        )
    if any(abs(number) > _LARGEST_FLOAT for number in expression.atoms(sp.Float, sp.Rational)):
        raise SystemDefinitionError(
            f"{excerpt(expression)} holds a number beyond {float(_LARGEST_FLOAT):.2g}, the"
            " largest of floats"
        )


def excerpt(expression: Any) -> str:
    """Return the beginning of an expression as text."""
    try:
        text = str(expression)
    except ValueError:  # Python does not print whole numbers of thousands of digits.
        return "an expression"
    return text if len(text) <= _LONGEST_QUOTED else f"{text[:_LONGEST_QUOTED]}..."


_LARGEST_EXPANDED_POWER = 8


@lru_cache(maxsize=256)
def prepared(
    arguments: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...]
) -> tuple[tuple[sp.Symbol, ...], Any, Any, Any]:
    """Prepare what all flavours of code share.

    An env and a batch of it ask for the same formulas, one after the other, and to find what they
    share takes longest.

    Args:
        arguments: symbols of a function.
        expressions: what it returns.

    Returns:
        The arguments and the formulas with plain names; the formulas with rounded numbers; and what
        `sympy.cse` makes of these: the common subexpressions, and the formulas of them.

    Raises:
        SystemDefinitionError: See `compile_function`.
    """
    for expression in expressions:
        require_computable(expression, arguments)
    names, formulas = in_plain_names(arguments, expressions)
    numbers = tuple(sp.Float(float(sp.N(e, 30)), 17) if e.is_number else e for e in formulas)
    return names, formulas, numbers, _shared_subexpressions(numbers)


def in_plain_names(
    arguments: Sequence[sp.Symbol], expressions: Sequence[Any]
) -> tuple[tuple[sp.Symbol, ...], tuple[Any, ...]]:
    """Rename arguments to a000, a001, ..., so that generated code holds no name of a user's.

    A name of the user's may be a keyword, a function, no identifier at all, or one of those that
    common subexpressions get. The new names sort like the old ones, for sympy orders the terms of a
    sum by them, and rounding follows the order.

    Args:
        arguments: symbols.
        expressions: formulas of them.

    Returns:
        The new symbols in the order of the arguments, and the formulas of them.
    """
    ordered = sorted(arguments, key=sp.default_sort_key)
    plain = {s: sp.Symbol(f"a{i:03d}", **s.assumptions0) for i, s in enumerate(ordered)}
    known: dict[Any, Any] = dict(plain)

    def renamed(expression: Any) -> Any:
        if not expression.args:
            return known.get(expression, expression)
        if expression not in known:
            parts = [renamed(part) for part in expression.args]
            # Sympy would compare all parts with each other once more, which takes longer than all
            # else.
            as_it_is = {"evaluate": False} if isinstance(expression, sp.Max | sp.Min) else {}
            known[expression] = expression.func(*parts, **as_it_is)
        return known[expression]

    return tuple(plain[s] for s in arguments), tuple(renamed(e) for e in expressions)


def _shared_subexpressions(
    expressions: Any,
) -> tuple[list[tuple[sp.Symbol, sp.Expr]], list[sp.Expr]]:
    """Take out common subexpressions, and write small integer powers as products."""
    # `pow` is many times slower.
    shared: Any
    reduced: Any
    shared, reduced = sp.cse(expressions, symbols=sp.numbered_symbols("x"), list=False)
    fresh = sp.numbered_symbols("p")
    replacements: list[tuple[sp.Symbol, sp.Expr]] = []

    def expand(expression: Any) -> Any:
        if not expression.args:
            return expression
        arguments = [expand(a) for a in expression.args]
        if (
            isinstance(expression, sp.Pow)
            and expression.exp.is_Integer
            and 2 <= abs(expression.exp) <= _LARGEST_EXPANDED_POWER
        ):
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
        expanded = expand(expression)  # which may append too
        replacements.append((symbol, expanded))
    return replacements, type(reduced)(expand(e) for e in reduced)


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
    """Return a function of floats that evaluates only the pieces that apply."""
    # A subexpression that other pieces share may have no value.
    careful = sp.lambdify(
        (_OWNER, *names), tuple(formulas), [math], printer=FloatPrinter(), docstring_limit=0
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


def tabulated(
    states: Sequence[sp.Symbol], expressions: Sequence[Any]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that gives the values (B, k) of expressions at states (B, n).

    Args:
        states: n symbols.
        expressions: k of them, with numbers for all parameters.
    """
    compiled = compile_function(tuple(states), tuple(expressions), "arrays")
    return partial(_table, compiled)


def _table(compiled: Callable[..., Any], x: np.ndarray) -> np.ndarray:
    return stacked(compiled(*np.ascontiguousarray(x.T)), len(x))
