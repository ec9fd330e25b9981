"""Expressions as text: arithmetic of named symbols, read without running code."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import sympy as sp

from safe_envs.errors import ConfigurationError, nearest, shortened, shown

FUNCTIONS: dict[str, Any] = {
    name: getattr(sp, name)
    for name in ("Abs", "Max", "Min", "atan", "cos", "exp", "log", "sin", "sqrt", "tanh")
}
"""Those that both checkers know; a plant has them in place of tan, sinh and cosh."""

SENSOR_FUNCTIONS: dict[str, Any] = {**FUNCTIONS, "atan2": sp.atan2, "tan": sp.tan}
"""Those of measurements: no checker has to know them."""

_CONSTANTS: dict[str, Any] = {"pi": sp.pi, "E": sp.E}
_OPERATORS: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_NUMBER = re.compile(r"[0-9]+(\.[0-9]*)?([eE][-+]?[0-9]{1,3})?|\.[0-9]+([eE][-+]?[0-9]{1,3})?")
_EXACT = re.compile(r"-?[0-9]{1,400}(\.[0-9]{1,400})?(e-?[0-9]{1,3})?|-?[0-9]{1,400}/[0-9]{1,400}")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,39}")

MOST_BITS = 1100
"""Of the numerator and the denominator of a fraction, as far as floats reach."""

_LARGEST_EXPONENT = 100
_MOST_CHARACTERS = 20_000
_MOST_PARTS = 3000
_MOST_FUNCTIONS = 100
_DEEPEST = 100
_MOST_ARGUMENTS = 12


def require_name(name: Any, where: str) -> str:
    """Return the name of a symbol.

    Args:
        name: what was given.
        where: it stands, for errors.

    Raises:
        ConfigurationError: a text of an expression cannot have it.
    """
    taken = {*FUNCTIONS, *_CONSTANTS, "and", "or", "not", "in", "is", "if", "else", "lambda"}
    if isinstance(name, str) and _NAME.fullmatch(name) and name not in taken:
        try:
            if isinstance(ast.parse(name, mode="eval").body, ast.Name):
                return name
        except SyntaxError:
            pass
    raise ConfigurationError(
        f"{where}: the name {shown(name)} cannot stand in a certificate; give at most 40 letters,"
        " digits and underscores, which are no function or word of Python"
    )


def write_expression(expression: sp.Expr, names: Mapping[str, sp.Symbol], where: str) -> str:
    """Return the text of an expression, which is read back as an equal one.

    Args:
        expression: with exact numbers.
        names: the symbols that it may have, by name.
        where: it stands, for errors.

    Raises:
        ConfigurationError: it has a float, or something else that cannot be read back.
    """
    text = str(expression)
    found = read_expression(text, names, where)
    same = found == expression or sp.expand(found - expression) == 0
    if not same or expression.atoms(sp.Float):
        raise ConfigurationError(
            f"{where}: {shortened(expression)} is read back as {shortened(found)}; give exact"
            " numbers and sympy's own forms of expressions"
        )
    return text


def read_expression(
    text: Any,
    names: Mapping[str, Any],
    where: str,
    functions: Mapping[str, Any] = FUNCTIONS,
) -> sp.Expr:
    """Read arithmetic of symbols, with exact numbers, without Python's eval.

    Nothing is computed whose size is not known to be small before.

    Args:
        text: such as "x_1**3 - 3*x_2/5".
        names: the symbols, or expressions that stand for them, by name.
        where: it stands, for errors.
        functions: that it may have, by name.

    Raises:
        ConfigurationError: it is no such arithmetic, or too long.
    """
    if not isinstance(text, str) or not 0 < len(text) <= _MOST_CHARACTERS:
        raise ConfigurationError(
            f"{where} is {shown(text)}; give an expression as text of 1 to {_MOST_CHARACTERS:,}"
            " characters"
        )
    if not (text.isascii() and text.isprintable()):
        raise ConfigurationError(f"{where}: {shown(text)} has characters beyond ASCII; use none")
    source = text.strip()
    try:
        tree = ast.parse(source, mode="eval").body
        _require_few_parts(tree, where)
        return _Reading(names, source, where, functions).value(tree)
    except ConfigurationError:
        raise
    except (
        *(SyntaxError, RecursionError, MemoryError, TypeError, ValueError),
        *(ArithmeticError, AttributeError),
    ) as error:
        raise ConfigurationError(
            f"{where}: {shown(text)} is no expression; write it like x_1**3 - 3*x_2/5"
        ) from error


def number_text(value: Fraction) -> str:
    """Return an exact text of a number: a decimal where there is a short one, or a fraction."""
    rest, places = value.denominator, 0
    while rest % 10 == 0 or (places < 60 and (rest % 2 == 0 or rest % 5 == 0)):
        divisor = math.gcd(rest, 10)
        rest, places = rest // divisor, places + 1
    if rest != 1 or places > 60:
        return f"{value.numerator}/{value.denominator}"
    digits = str(abs(value.numerator) * 10**places // value.denominator).rjust(places + 1, "0")
    sign, cut = "-" if value < 0 else "", len(digits) - places
    return f"{sign}{digits[:cut]}.{digits[cut:]}" if places else f"{sign}{digits}"


def read_number(text: Any) -> Fraction | None:
    """Return the number of a text, as `number_text` writes it; None where it is none.

    Args:
        text: of a file.
    """
    try:
        found = Fraction(text) if isinstance(text, str) and _EXACT.fullmatch(text) else None
    except ZeroDivisionError:
        return None
    if found is None or max(map(int.bit_length, found.as_integer_ratio())) > MOST_BITS:
        return None
    return found


def _require_few_parts(tree: ast.expr, where: str) -> None:
    parts, functions, left = 0, 0, [(tree, 0)]
    while left:
        node, depth = left.pop()
        parts, functions = parts + 1, functions + isinstance(node, ast.Call)
        if parts > _MOST_PARTS or functions > _MOST_FUNCTIONS or depth > _DEEPEST:
            raise ConfigurationError(
                f"{where}: the expression has more than {_MOST_PARTS} parts, more than"
                f" {_MOST_FUNCTIONS} functions, or is nested more than {_DEEPEST} deep; give a"
                " simpler one"
            )
        # The terms of a long sum are nested in its left side, and read one after the other.
        for child in ast.iter_child_nodes(node):
            is_sum = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub)
            left.append((child, depth + (not (is_sum and child is node.left))))  # pyright: ignore


class _Reading:
    """One expression that is being read."""

    def __init__(
        self, names: Mapping[str, Any], source: str, where: str, functions: Mapping[str, Any]
    ) -> None:
        self._names, self._source, self._where = {**_CONSTANTS, **names}, source, where
        self._functions = functions

    def value(self, node: ast.expr) -> Any:
        terms = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            last = self.value(node.right)
            terms.append(last if isinstance(node.op, ast.Add) else -last)
            node = node.left
        first = self._combined(node)
        return self._small(sp.Add(first, *reversed(terms)) if terms else first, node)

    def _combined(self, node: ast.expr) -> Any:
        match node:
            case ast.Name(name):
                if name in self._names:
                    return self._names[name]
                raise ConfigurationError(
                    f"{self._where}: unknown name {shown(name)}; {nearest(name, self._names)}"
                )
            case ast.Constant(int() | float()):
                text = self._source[node.col_offset : node.end_col_offset]
                if _NUMBER.fullmatch(text) and len(text) <= _MOST_CHARACTERS:
                    return sp.Rational(text)
            case ast.BinOp(left, kind, right) if type(kind) in _OPERATORS:
                first, second = self.value(left), self.value(right)
                if isinstance(kind, ast.Pow) and not _is_exponent(second):
                    raise ConfigurationError(
                        f"{self._where}: the exponent {shortened(ast.unparse(right))} is no"
                        f" number up to {_LARGEST_EXPONENT}"
                    )
                return _OPERATORS[type(kind)](first, second)
            case ast.UnaryOp(kind, operand) if type(kind) in _OPERATORS:
                return _OPERATORS[type(kind)](self.value(operand))
            case ast.Call(ast.Name(name), arguments, []) if arguments:
                most = {"Max": _MOST_ARGUMENTS, "Min": _MOST_ARGUMENTS, "atan2": 2}.get(name, 1)
                least = 2 if name == "atan2" else 1
                if name in self._functions and least <= len(arguments) <= most:
                    found = self._functions[name](*map(self.value, arguments))
                    # sympy compares each two of them, and flattens what is nested.
                    if len(found.args) <= _MOST_ARGUMENTS or name not in ("Max", "Min"):
                        return found
                raise ConfigurationError(
                    f"{self._where}: unknown function {shown(name)} of {len(arguments)} arguments;"
                    f" {nearest(name, self._functions)}"
                )
        raise ConfigurationError(
            f"{self._where}: {shown(ast.unparse(node))} is not allowed; write arithmetic with"
            " decimal numbers, like x_1**3 - 3*x_2/5"
        )

    def _small(self, found: Any, node: ast.expr) -> Any:
        numbers, powers = found.atoms(sp.Number, sp.NumberSymbol), found.atoms(sp.Pow)
        fits = all(map(_is_small, numbers)) and all(_is_exponent(p.exp) for p in powers)
        if not fits or found.has(sp.I, sp.zoo, sp.nan, sp.oo) or not _is_real(found):
            raise ConfigurationError(
                f"{self._where}: {shown(ast.unparse(node))} has a number that is not real, beyond"
                f" floats or too long, or an exponent above {_LARGEST_EXPONENT}; give smaller ones"
            )
        return found


def _is_exponent(value: Any) -> bool:
    return bool(value.is_Rational) and abs(value) <= _LARGEST_EXPONENT


def _is_small(value: Any) -> bool:
    if value.is_Rational:
        return max(int(value.p).bit_length(), int(value.q).bit_length()) <= MOST_BITS
    return bool(value.is_NumberSymbol)


def _is_real(found: Any) -> bool:
    """Whether floats hold an expression without symbols."""
    if found.free_symbols:
        return True
    try:
        return math.isfinite(float(found))
    except (TypeError, ValueError, OverflowError):
        return False
