"""Whether a formula is zero everywhere, decided region by region where it has kinks and jumps."""

from __future__ import annotations

import functools
import itertools
import random
from collections.abc import Iterator, Mapping
from typing import Any

import sympy as sp

_ANALYTIC = (
    *(sp.Add, sp.Mul, sp.Pow, sp.exp, sp.erf, sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc),
    *(sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch),
)
_SWITCHING = (sp.Abs, sp.sign, sp.Heaviside, sp.Max, sp.Min)
_MOST_SWITCHES = 6
_SCALES = (1, 1, 3)
_SMALLER = (sp.Rational(1, 100), sp.Rational(1, 10**4), sp.Rational(1, 10**7))
_SATURATED = (sp.tanh, sp.coth, sp.erf)
_MOST_SATURATED, _LONGEST = 12, sp.Integer(10) ** 50


def is_zero(expression: Any) -> bool:
    """Return whether an expression is zero for all real values, except at points of jumps.

    An analytic function that is not 0 everywhere is zero at random points with probability 0. Its
    value says so unless a part is lost in rounding to the others, as at a point where 1 + tanh(10^6
    (x - 5)) is less than 10^-10^6: such a point tells nothing. An expression with kinks and jumps
    is one in each region of the signs of what switches there: of a for |a|, of a - b for max(a, b),
    of the root's branch for sqrt(a), which may hide a kink as well. Every region is looked at,
    wherever it lies; one that is empty, which cannot be told in general, counts like the others.

    Returns:
        True where that is shown; False also where it is not, because of functions that are not
        looked into (logarithms, floors, inverse functions), of too many regions, or of points that
        all tell nothing.
    """
    expression = rational(expression)
    if expression == 0:
        return True
    if expression.is_number:
        return bool(expression.equals(0))
    if not expression.has(sp.Derivative, sp.Subs, sp.Integral) and _nonzero_somewhere(expression):
        return False
    return all(not _nonzero_somewhere(piece) for piece in Pieces(expression))


def rational(expression: Any) -> Any:
    """Return the expression with each float as a fraction, so that terms cancel exactly."""
    return expression.xreplace(
        {f: sp.Rational(repr(float(f))) for f in expression.atoms(sp.Float) if f.is_finite}
    )


def _nonzero_somewhere(expression: Any) -> bool:
    """Return whether an expression is nonzero at one of a few random points, or none tells."""
    if expression.is_zero:
        return False
    points, told = random.Random(0), False
    symbols = sorted(expression.free_symbols, key=sp.default_sort_key)
    for scale in (*_SCALES, *_SMALLER):
        if scale in _SMALLER and told:
            break
        at = {s: sp.Rational(points.randint(-(10**6), 10**6) or 1, 10**6) * scale for s in symbols}
        if any(
            _told_from_zero(part)
            for part in expression.xreplace(at).evalf(30, maxn=200).as_real_imag()
        ):
            return True
        told = told or not any(_loses(part, at) for part in sp.preorder_traversal(expression))
    return not told


def _loses(part: Any, at: Mapping[Any, Any]) -> bool:
    """Return whether a part of an expression may be lost in rounding to others at a point."""
    # That is where a saturated function is next to its limit, or a power or a number of a size that
    # the digits of an evaluation do not hold.
    if isinstance(part, _SATURATED):
        argument: Any = part.args[0].xreplace(at)
        argument = argument.evalf(15, maxn=200)
        return not abs(argument) <= _MOST_SATURATED
    if not isinstance(part, (sp.exp, sp.Pow, sp.Number)):
        return False
    value: Any = part.xreplace(at)
    value = abs(value.evalf(15, maxn=200))
    return _told_from_zero(value) and not 1 / _LONGEST <= value <= _LONGEST


def _told_from_zero(value: Any) -> bool:
    # What cancels down to the last of 200 digits comes back with a single bit.
    return bool(value.is_Float and value.is_finite and value != 0 and value._prec > 1)


class Pieces:
    """The analytic functions that an expression consists of, one for each region.

    One symbol stands for it where there are too many.

    Args:
        expression: of real symbols.

    Attributes:
        signs: a symbol for the sign, 1 or -1, of each expression that switches between functions.
        whole: the expression by these symbols.
    """

    def __init__(self, expression: Any) -> None:
        self.signs: dict[Any, sp.Dummy] = {}
        self._unknown: dict[Any, sp.Dummy] = {}
        self.whole = self._rewritten(expression)

    def __iter__(self) -> Iterator[Any]:
        signs = list(self.signs.values())
        if len(signs) > _MOST_SWITCHES:
            yield sp.Dummy("any")
            return
        for values in itertools.product((sp.S.One, sp.S.NegativeOne), repeat=len(signs)):
            yield self.whole.xreplace(dict(zip(signs, values, strict=True)))

    def _rewritten(self, e: Any) -> Any:
        """Replace kinks and jumps by signs of what switches, and the unknown by a symbol."""
        if isinstance(e, sp.Piecewise):
            return self._of_pieces(e)
        if not e.args:
            return e
        if not isinstance(e, (*_ANALYTIC, *_SWITCHING)):
            return self._other(e)
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
            return self._root(e, args)
        return e.func(*args)

    def _root(self, e: Any, args: list[Any]) -> Any:
        """Return a power, which has several branches, with its arguments rewritten."""
        square = args[1].is_Rational and args[1].q == 2
        return e.func(*args) * self._sign_of(("root", args[0])) if square else self._symbol(e)

    def _other(self, e: Any) -> Any:
        """Return a function that is not looked into."""
        return self._symbol(e)

    def _of_pieces(self, e: sp.Piecewise) -> Any:
        total, left = sp.S.Zero, sp.S.One
        for value, condition in e.args:  # pyright: ignore[reportGeneralTypeIssues]
            holds = self._indicator(condition)
            total += left * holds * self._rewritten(value)
            left *= 1 - holds
        return total

    def _indicator(self, condition: Any) -> Any:
        """Return 1 where a condition holds, 0 elsewhere."""
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
        """Return the sign of an expression as a symbol."""
        # It is the same for positive multiples of the expression, and the opposite for negative
        # ones.
        _, switch = sp.expand(switch).as_content_primitive()
        if switch.is_number:
            return sp.sign(switch)
        return (
            -self._sign_of(-switch) if switch.could_extract_minus_sign() else self._sign_of(switch)
        )

    def _sign_of(self, key: Any) -> sp.Dummy:
        return self.signs.setdefault(key, sp.Dummy("sign"))

    def _symbol(self, key: Any) -> sp.Dummy:
        return self._unknown.setdefault(key, sp.Dummy("unknown"))
