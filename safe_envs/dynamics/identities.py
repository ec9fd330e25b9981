"""Whether a formula is zero everywhere, decided region by region where it has kinks and jumps."""

from __future__ import annotations

import functools
import itertools
import random
from collections.abc import Iterator, Sequence
from typing import Any

import sympy as sp

_ANALYTIC = (
    *(sp.Add, sp.Mul, sp.Pow, sp.exp, sp.erf, sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc),
    *(sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch),
)
_SWITCHING = (sp.Abs, sp.sign, sp.Heaviside, sp.Max, sp.Min)
_MOST_SWITCHES = 6
_SCALES = (1, 1, 3)


def is_zero(expression: Any) -> bool:
    """Whether an expression is zero for all real values of its symbols, but for single points of
    jumps.

    An analytic function that is not zero everywhere is zero at random points with probability 0. An
    expression with kinks and jumps is one in each region of the signs of what switches there: of a
    for |a|, of a - b for max(a, b), of the root's branch for sqrt(a), which may hide a kink as
    well. Every region is looked at, wherever it lies; one that is empty, which cannot be told in
    general, counts like the others.

    Returns:
        True where that is shown; False also where it is not, because of functions that are not
        looked into (logarithms, floors, inverse functions) or of too many regions.
    """
    expression = _rational(expression)
    if expression == 0:
        return True
    if expression.is_number:
        return bool(expression.equals(0))
    if not expression.has(sp.Derivative, sp.Subs, sp.Integral) and _nonzero_somewhere(expression):
        return False
    return all(not _nonzero_somewhere(piece) for piece in _Pieces(expression))


def _rational(expression: Any) -> Any:
    """The expression with the decimal value of each float as a fraction, so that terms cancel
    exactly.
    """
    return expression.xreplace(
        {f: sp.Rational(repr(float(f))) for f in expression.atoms(sp.Float) if f.is_finite}
    )


def _nonzero_somewhere(expression: Any) -> bool:
    """Whether an expression has a value other than zero at one of a few random points."""
    if expression.is_zero:
        return False
    points = random.Random(0)
    symbols = sorted(expression.free_symbols, key=sp.default_sort_key)
    for scale in _SCALES:
        at = {s: sp.Rational(points.randint(-(10**6), 10**6) or 1, 10**6) * scale for s in symbols}
        if any(
            _told_from_zero(part)
            for part in expression.xreplace(at).evalf(30, maxn=200).as_real_imag()
        ):
            return True
    return False


def _told_from_zero(value: Any) -> bool:
    # What cancels down to the last of 200 digits comes back with a single bit.
    return bool(value.is_Float and value.is_finite and value != 0 and value._prec > 1)


class _Pieces:
    """The analytic functions that an expression is made of, one for each region; one symbol where
    there are too many.
    """

    def __init__(self, expression: Any) -> None:
        self._signs: dict[Any, sp.Dummy] = {}
        self._unknown: dict[Any, sp.Dummy] = {}
        self._expression = self._rewritten(expression)

    def __iter__(self) -> Iterator[Any]:
        signs = list(self._signs.values())
        if len(signs) > _MOST_SWITCHES:
            yield sp.Dummy("any")
            return
        for values in itertools.product((sp.S.One, sp.S.NegativeOne), repeat=len(signs)):
            yield self._expression.xreplace(dict(zip(signs, values, strict=True)))

    def _rewritten(self, e: Any) -> Any:
        """An expression with signs of what switches in place of kinks and jumps, and a symbol for
        what is not looked into.
        """
        if isinstance(e, sp.Piecewise):
            return self._of_pieces(e)
        if not e.args:
            return e
        if not isinstance(e, (*_ANALYTIC, *_SWITCHING)):
            return self._symbol(e)
        args = [self._rewritten(a) for a in e.args]
        if isinstance(e, sp.Max | sp.Min):
            up = 1 if isinstance(e, sp.Max) else -1
            return functools.reduce(
                lambda a, b: (a + b + up * (a - b) * self._sign(a - b)) / 2, args
            )
        if isinstance(e, _SWITCHING):
            sign = self._sign(args[0])
            return (
                args[0] * sign
                if isinstance(e, sp.Abs)
                else sign
                if isinstance(e, sp.sign)
                else (1 + sign) / 2
            )
        if isinstance(e, sp.Pow) and not (args[1].is_integer or args[0].is_positive):
            root = args[1].is_Rational and args[1].q == 2
            return e.func(*args) * self._sign_of(("root", args[0])) if root else self._symbol(e)
        return e.func(*args)

    def _of_pieces(self, e: sp.Piecewise) -> Any:
        total, left = sp.S.Zero, sp.S.One
        for value, condition in e.args:  # pyright: ignore[reportGeneralTypeIssues]
            holds = self._indicator(condition)
            total += left * holds * self._rewritten(value)
            left *= 1 - holds
        return total

    def _indicator(self, condition: Any) -> Any:
        """1 where a condition holds, 0 elsewhere."""
        if condition in (sp.true, sp.false):
            return sp.Integer(condition == sp.true)
        if isinstance(condition, sp.Gt | sp.Ge | sp.Lt | sp.Le):
            larger, smaller = condition.gts, condition.lts
            return (1 + self._sign(self._rewritten(larger - smaller))) / 2  # pyright: ignore[reportOperatorIssue]
        if isinstance(condition, sp.Eq | sp.Ne):
            return sp.Integer(isinstance(condition, sp.Ne))
        if isinstance(condition, sp.Not):
            return 1 - self._indicator(condition.args[0])
        if isinstance(condition, sp.And):
            return sp.Mul(*[self._indicator(part) for part in condition.args])
        if isinstance(condition, sp.Or):
            return 1 - sp.Mul(*[1 - self._indicator(part) for part in condition.args])
        return self._symbol(condition)

    def _sign(self, switch: Any) -> Any:
        """The sign of an expression: a symbol, the same one for positive multiples of it, and the
        opposite for negative ones.
        """
        _, switch = sp.expand(switch).as_content_primitive()
        if switch.is_number:
            return sp.sign(switch)
        return (
            -self._sign_of(-switch) if switch.could_extract_minus_sign() else self._sign_of(switch)
        )

    def _sign_of(self, key: Any) -> sp.Dummy:
        return self._signs.setdefault(key, sp.Dummy("sign"))

    def _symbol(self, key: Any) -> sp.Dummy:
        return self._unknown.setdefault(key, sp.Dummy("unknown"))


def pieces_fit(expression: Any, symbols: Sequence[sp.Symbol], order: int) -> bool:
    """Whether the pieces of every `Piecewise` meet with the same value and the same derivatives up
    to an order.

    Sympy differentiates each piece by itself, and says nothing of a jump or a kink between two of
    them.

    Args:
        expression: of the symbols.
        symbols: that the derivatives are taken by.
        order: of the highest derivative that has to be continuous.

    Returns:
        True where that is shown, which takes conditions that can be solved for one of the symbols.
    """
    return all(_fits(piecewise, symbols, order) for piecewise in expression.atoms(sp.Piecewise))


def _fits(piecewise: sp.Piecewise, symbols: Sequence[sp.Symbol], order: int) -> bool:
    pieces: Any = piecewise.args
    if pieces[-1].cond != sp.true:
        return False
    for i, (value, condition) in enumerate(pieces[:-1]):
        others = sp.Piecewise(*pieces[i + 1 :])
        edges: Any = condition.atoms(sp.core.relational.Relational)
        for edge in edges:
            difference = edge.lhs - edge.rhs
            solved = [
                s
                for s in symbols
                if difference.diff(s).is_nonzero and not difference.diff(s).has(s)
            ]
            if not solved or isinstance(edge, sp.Eq | sp.Ne):
                return False
            s = solved[0]
            at = s - difference / difference.diff(s)
            # A function that is zero on the edge has no slope along it.
            if not all(
                is_zero((value.diff(s, k) - others.diff(s, k)).subs(s, sp.simplify(at)))
                for k in range(order + 1)
            ):
                return False
    return True
