"""Class-K functions as text: arithmetic of s, read without running code, in bounded time."""

from __future__ import annotations

import ast
import math
import operator
from typing import Any

import sympy as sp

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.number_text import whole_or_real

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

_MOST_BITS = 1100
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
    """Raise ConfigurationError for an expression larger than a person writes.

    It does not recurse, since the tree may be as deep as it is large.
    """
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
    """Return an expression whose numbers are small, so that the next operation takes no time.

    Raises:
        ConfigurationError: one is not.
    """
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
        return max(number.p.bit_length(), number.q.bit_length()) <= _MOST_BITS
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
