"""Where functions by pieces, and those with Abs, Min, Max, sign or Heaviside, are not smooth."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.identities import Pieces, is_zero, rational

_BENT = (sp.Abs, sp.Min, sp.Max, sp.Piecewise, sp.sign, sp.Heaviside)
STEPS = (sp.floor, sp.ceiling, sp.frac, sp.Mod, sp.DiracDelta, sp.Derivative, sp.Subs)
"""Functions of which it is not known where they jump."""

_CONDITIONS = (sp.Gt, sp.Ge, sp.Lt, sp.Le, sp.And, sp.Or, sp.Not)
_MOST_SIGNS = 6


def edges(expression: Any, symbols: Sequence[sp.Symbol], order: int = 0) -> list[Any]:
    """Return where a function, or one of its derivatives up to an order, jumps.

    Sympy differentiates each piece by itself, and says nothing of a jump or a kink between two of
    them.

    Args:
        expression: of real symbols.
        symbols: that the derivatives are taken by.
        order: of the highest derivative that has to be continuous.

    Returns:
        Expressions that are 0 where it jumps, or parts of it of which that is not known. Empty
        where it is shown that it does not: that takes switches that can be solved for one of the
        symbols, or pieces whose difference is a multiple of a power of what switches.
    """
    return _Switches(rational(expression)).edges(symbols, order) if is_bent(expression) else []


def switches(expression: Any) -> set[Any]:
    """Return all expressions that are 0 where a function changes its piece; see `edges`."""
    found = _Switches(rational(expression))
    return {*found.signs, *found.unclear}


def is_bent(expression: Any) -> bool:
    """Return whether a function has parts that may jump or have kinks."""
    return bool(expression.has(*_BENT, *STEPS))


class _Switches(Pieces):
    """A function by the signs of what switches between its pieces."""

    def __init__(self, expression: Any) -> None:
        self.unclear: list[Any] = []
        super().__init__(expression)

    def _root(self, e: Any, args: list[Any]) -> Any:
        return e.func(*args)

    def _other(self, e: Any) -> Any:
        if isinstance(e, STEPS) or not all(isinstance(a, sp.Expr) for a in e.args):
            self.unclear.append(e)
            return self._symbol(e)
        return e.func(*map(self._rewritten, e.args))

    def _of_pieces(self, e: sp.Piecewise) -> Any:
        if e.args[-1].cond != sp.true:  # pyright: ignore[reportAttributeAccessIssue]
            self.unclear.append(e)
        return super()._of_pieces(e)

    def _indicator(self, condition: Any) -> Any:
        if condition not in (sp.true, sp.false) and not isinstance(condition, _CONDITIONS):
            self.unclear.append(condition)
        return super()._indicator(condition)

    def edges(self, symbols: Sequence[sp.Symbol], order: int) -> list[Any]:
        """Return where a derivative up to an order jumps, or may."""
        # What switches must not jump itself: another switch would flip with it.
        parts = [(self.whole, order), *((key, 0) for key in self.signs)]
        return [
            *self.unclear,
            *(
                edge
                for edge, sign in self.signs.items()
                if not all(self._agree(part, edge, sign, symbols, k) for part, k in parts)
            ),
        ]

    def _agree(
        self, part: Any, edge: Any, sign: sp.Dummy, symbols: Sequence[sp.Symbol], order: int
    ) -> bool:
        """Return whether two pieces have equal derivatives where a switch between them is 0."""
        jump = part.xreplace({sign: sp.S.One}) - part.xreplace({sign: sp.S.NegativeOne})
        signs = [s for s in self.signs.values() if jump.has(s) or edge.has(s)]
        if jump == 0 or len(signs) > _MOST_SIGNS:
            return jump == 0
        return all(
            self._vanishes(jump, edge, values, symbols, order)
            for values in itertools.product((sp.S.One, sp.S.NegativeOne), repeat=len(signs))
            for values in [dict(zip(signs, values, strict=True))]
        )

    def _vanishes(
        self,
        jump: Any,
        edge: Any,
        signs: Mapping[Any, Any],
        symbols: Sequence[sp.Symbol],
        order: int,
    ) -> bool:
        """Return whether a jump and its derivatives are 0 on an edge, where other signs are so."""
        difference, at = jump.xreplace(signs), edge.xreplace(signs)
        if sp.expand(difference) == 0:
            return True
        symbol, places = _solved(at, symbols)
        if not places:
            return _is_multiple(difference, at ** (order + 1))
        # A function that is zero on the edge has no slope along it.
        slopes = [difference.diff(symbol, k) for k in range(order + 1)]
        return all(
            is_zero(slope.subs(symbol, place))
            for place in places
            if self._possible(signs, symbol, place)
            for slope in slopes
        )

    def _possible(self, signs: Mapping[Any, Any], symbol: sp.Symbol, place: Any) -> bool:
        """Return whether other switches may have their signs at a place."""
        for key, sign in self.signs.items():
            value: Any = sp.expand(key.xreplace(signs).subs(symbol, place))
            if sign in signs and value.is_number and value * signs[sign] < 0:
                return False
        return True


def _solved(edge: Any, symbols: Sequence[sp.Symbol]) -> tuple[Any, list[Any]]:
    """Return a symbol and where an expression is 0 by it; no places where that is not known."""
    for degree in (1, 2):
        for s in symbols:
            of_symbol = sp.Poly(edge, s) if edge.is_polynomial(s) else None
            if of_symbol and of_symbol.degree() == degree and of_symbol.LC().is_nonzero:
                a, b, *c = of_symbol.all_coeffs()
                if degree == 1:
                    return s, [sp.simplify(-b / a)]
                root = sp.sqrt(b**2 - 4 * a * c[0])
                return s, [(-b + root) / (2 * a), (-b - root) / (2 * a)]
    return None, []


def _is_multiple(expression: Any, factor: Any) -> bool:
    """Return whether a polynomial, of whatever functions, is shown to be a multiple of another."""
    try:
        return sp.reduced(sp.expand(expression), [sp.expand(factor)])[1] == 0
    except sp.PolynomialError:
        return False
