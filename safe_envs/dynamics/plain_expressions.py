"""Expressions with plain names, rounded numbers and shared parts, from which code is printed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import sympy as sp

from safe_envs.dynamics.computable import require_computable

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
    """Take out common subexpressions, and write small integer powers as products.

    `pow` is many times slower.
    """
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
        expanded = expand(expression)
        replacements.append((symbol, expanded))
    return replacements, type(reduced)(expand(e) for e in reduced)
