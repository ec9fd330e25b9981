"""A function with kinks as the least of maxima of functions without them.

Sums, multiples, Min, Max and Abs of functions are such: Abs(a) = Max(a, -a), -Max(a, b) = Min(-a,
-b), c + Min(a, b) = Min(c + a, c + b), Max(Min(a, b), c) = Min(Max(a, c), Max(b, c)).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from functools import lru_cache, reduce
from typing import Any

import sympy as sp

Clauses = tuple[tuple[sp.Expr, ...], ...]
"""h = min over the clauses of the max over the functions of each."""

MOST = 64
"""Number of clauses, and of functions in one: 1 - |x_1| - .. - |x_6| has as many."""

_BENT = (sp.Min, sp.Max, sp.Abs, sp.Piecewise)


@lru_cache(maxsize=256)
def clauses(expression: sp.Expr) -> Clauses:
    """Return the clauses of a function; itself alone where it is no minimum or maximum.

    A number that has no say in the sign of the function is left out: of Min(h, 1), h is left.

    Args:
        expression: h, of real symbols.
    """
    try:
        found = _clauses(expression)
    except _TooManyError:
        found = ((expression,),)
    kept = [
        tuple(e for e in clause if not e.is_number) or clause
        for clause in found
        if not any(e.is_number and e >= 0 for e in clause)
    ]
    return tuple(kept) or ((expression,),)


def pieces(expression: sp.Expr) -> tuple[sp.Expr, ...]:
    """Return all functions in the clauses of a function, each once."""
    return tuple(dict.fromkeys(itertools.chain.from_iterable(clauses(expression))))


class _TooManyError(Exception):
    """There are more clauses than `MOST`."""


def _clauses(e: Any) -> Clauses:
    whole: Clauses = ((e,),)
    if not e.has(*_BENT):
        return whole
    if isinstance(e, sp.Min):
        return _simplified(itertools.chain.from_iterable(map(_clauses, e.args)))
    if isinstance(e, sp.Max):
        return reduce(_larger, map(_clauses, e.args))
    if isinstance(e, sp.Abs):
        inside = _clauses(e.args[0])
        return _larger(inside, _scaled(inside, sp.Integer(-1)))
    if isinstance(e, sp.Add):
        return reduce(_sum, map(_clauses, e.args))
    if isinstance(e, sp.Mul):
        bent = [a for a in e.args if a.has(*_BENT)]
        factor = sp.Mul(*[a for a in e.args if a not in bent])
        signed = factor.is_nonnegative or factor.is_nonpositive
        return _scaled(_clauses(bent[0]), factor) if len(bent) == 1 and signed else whole
    found = _extremum(e) if isinstance(e, sp.Piecewise) else None
    return whole if found is None else _clauses(found)


def _extremum(e: sp.Piecewise) -> Any:
    """Return two pieces as the Max or Min that they are; None where they are neither."""
    parts: Any = e.args
    if len(parts) != 2:
        return None
    (value, condition), (other, otherwise) = parts
    if otherwise != sp.true or not isinstance(condition, sp.Gt | sp.Ge | sp.Lt | sp.Le):
        return None
    edge: Any = condition.gts - condition.lts  # pyright: ignore[reportOperatorIssue]
    ratio: Any = sp.cancel((value - other) / edge)
    if ratio.is_nonnegative:
        return sp.Max(value, other)
    return sp.Min(value, other) if ratio.is_nonpositive else None


def _larger(first: Clauses, second: Clauses) -> Clauses:
    """Return the clauses of the larger one of two functions."""
    return _simplified((*a, *b) for a in first for b in second)


def _sum(first: Clauses, second: Clauses) -> Clauses:
    """Return the clauses of the sum of two functions."""
    return _simplified([e + f for e in a for f in b] for a in first for b in second)


def _scaled(given: Clauses, factor: Any) -> Clauses:
    """Return the clauses of a multiple of a function, by a factor of one sign."""
    scaled = [[factor * e for e in clause] for clause in given]
    # The largest of minima is the least, over the ways to take one of each, of maxima.
    return _simplified(scaled if factor.is_nonnegative else itertools.product(*scaled))


def _simplified(given: Iterable[Iterable[Any]]) -> Clauses:
    """Return clauses without those that others imply."""
    found: list[dict[Any, None]] = []
    for clause in map(dict.fromkeys, given):
        if not any(other.keys() <= clause.keys() for other in found):
            found = [other for other in found if not clause.keys() <= other.keys()]
            found.append(clause)
        if len(found) > MOST or len(clause) > MOST:
            raise _TooManyError
    return tuple(map(tuple, found))
