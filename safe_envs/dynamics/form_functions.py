"""The functions of expressions on first-order forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.expression_program import Operation
from safe_envs.dynamics.first_order_forms import EPS, Form, is_finite, merged, opposite, with_range
from safe_envs.dynamics.form_arithmetic import FormArithmetic
from safe_envs.dynamics.interval_arithmetic import Interval, negative
from safe_envs.dynamics.intervals import IntervalOperations

_INTERVALS = IntervalOperations()

IntervalMap = Callable[[Interval], Interval]


class FormOperations(FormArithmetic):
    """Arithmetic of forms with the functions of expressions, by their SymPy classes."""

    def function(self, kind: Any) -> Operation:
        """Return a function of one argument, with its first two derivatives."""
        if kind is sp.Abs:
            return self._absolute
        value = _INTERVALS.function(kind)
        slope, curve = _DERIVATIVES[kind]
        inside = _DOMAINS.get(kind)

        def applied(a: Form) -> Form:
            regular = None if inside is None else inside(a.range)
            return self.composed(a, value, slope, curve, regular)

        return applied

    def _absolute(self, a: Form) -> Form:
        """Return |a|: a or -a by the sign of its center, plus what it may fall short by."""
        sign = np.where(a.center >= 0.0, 1.0, -1.0)
        below = np.maximum(np.where(sign > 0.0, -a.range.low, a.range.high), 0.0)
        known = _INTERVALS.absolute(a.range)
        certain = (a.range.low > 0.0) | (a.range.high < 0.0)
        return with_range(
            sign * a.center + np.where(np.isfinite(below), below, 0.0),
            sign * a.slopes,
            a.radius + below + EPS * (np.abs(a.center) + below),
            known,
            certain & a.smooth,
        )

    def step(self, kind: Any) -> Operation:
        """Return the sign, or a rounding down or up; smooth where it is constant."""
        step = _INTERVALS.step(kind)
        jumps_at_zero = kind is sp.sign

        def applied(a: Form) -> Form:
            known = step(a.range)
            flat = np.equal(known.low, known.high)
            # The values on both sides of a box that ends at a jump differ.
            ends = a.range.low, a.range.high
            for end in ends:
                flat &= ~np.equal(end, 0.0 if jumps_at_zero else np.round(end))
            return self.of_interval(known, flat & a.smooth)

        return applied

    def extreme(self, kind: Any) -> Operation:
        """Return the larger or the smaller of two; smooth where it is always the same one.

        The form of the larger one is that of the operand with the larger center, plus what the
        other one may exceed it by, so that its lower ends are not worse than those of the operand.
        """
        if kind is sp.Min:
            larger = self.extreme(sp.Max)
            return lambda a, b: opposite(larger(opposite(a), opposite(b)))

        def larger_one(a: Form, b: Form) -> Form:
            known_a, known_b = np.isfinite(a.radius), np.isfinite(b.radius)
            first = np.where(known_a == known_b, a.center >= b.center, known_a)
            top, other = merged(first, a, b), merged(first, b, a)
            gap = self.add(other, opposite(top)).range.high
            excess = np.maximum(gap, 0.0)
            half = 0.5 * excess
            known = Interval(
                np.maximum(a.range.low, b.range.low), np.maximum(a.range.high, b.range.high)
            )
            radius = top.radius + half + EPS * (np.abs(top.center) + half)
            certain = gap < 0.0
            return with_range(
                top.center + np.where(np.isfinite(half), half, 0.0),
                top.slopes,
                radius,
                known,
                certain & top.smooth,
            )

        return larger_one

    def atan2(self, y: Form, x: Form) -> Form:
        """Return the angle of (x, y), by a quotient that is regular; see `FormArithmetic`."""
        known = _INTERVALS.atan2(y.range, x.range)
        arctan = self.function(sp.atan)
        by_x = arctan(self.multiply(y, self.reciprocal(x)))
        by_y = opposite(arctan(self.multiply(x, self.reciprocal(y))))
        quarter = self.constant(sp.pi / 2)
        right, above, below = x.range.low > 0.0, y.range.low > 0.0, y.range.high < 0.0
        upper, lower = self.add(by_y, quarter), self.add(by_y, opposite(quarter))
        found = self.of_interval(known, np.zeros(np.size(known.low), dtype=bool))
        for where, form in ((below, lower), (above, upper), (right, by_x)):
            found = merged(where, form, found)
        return found._replace(
            range=Interval(
                np.maximum(known.low, found.range.low), np.minimum(known.high, found.range.high)
            )
        )


def _scaled(factor: float, a: Interval) -> Interval:
    return _INTERVALS.multiply(Interval(factor, factor), a)


def _one_plus(a: Interval) -> Interval:
    return _INTERVALS.add(Interval(1.0, 1.0), a)


def _square(a: Interval) -> Interval:
    return _INTERVALS.integer_power(a, 2)


def _tangent_slope(y: Interval) -> Interval:
    return _one_plus(_square(_INTERVALS.tan(y)))


def _of_root(base: IntervalMap, sign: float) -> tuple[IntervalMap, IntervalMap]:
    """Return 1/sqrt(base) and sign y/base^(3/2)."""
    root, inverse = _INTERVALS.square_root, _INTERVALS.reciprocal

    def curve(y: Interval) -> Interval:
        cubed = _INTERVALS.multiply(base(y), root(base(y)))
        return _scaled(sign, _INTERVALS.multiply(y, inverse(cubed)))

    return lambda y: inverse(root(base(y))), curve


def _of_quotient(base: IntervalMap, sign: float) -> tuple[IntervalMap, IntervalMap]:
    """Return 1/base and sign 2 y/base^2."""
    inverse = _INTERVALS.reciprocal
    return (
        lambda y: inverse(base(y)),
        lambda y: _scaled(2.0 * sign, _INTERVALS.multiply(y, inverse(_square(base(y))))),
    )


def _derivatives() -> dict[Any, tuple[IntervalMap, IntervalMap]]:
    named = _INTERVALS.function
    sin, cos, exp = named(sp.sin), named(sp.cos), named(sp.exp)
    sinh, cosh, tanh = named(sp.sinh), named(sp.cosh), named(sp.tanh)

    def plus(y: Interval) -> Interval:
        return _one_plus(_square(y))

    def minus(y: Interval) -> Interval:
        return _one_plus(negative(_square(y)))

    def beyond(y: Interval) -> Interval:
        return _INTERVALS.add(_square(y), Interval(-1.0, -1.0))

    def tanh_slope(y: Interval) -> Interval:
        return minus(tanh(y))

    asin = _of_root(minus, 1.0)
    return {
        sp.exp: (exp, exp),
        sp.log: (
            lambda y: _INTERVALS.integer_power(y, -1),
            lambda y: negative(_INTERVALS.integer_power(y, -2)),
        ),
        sp.sin: (cos, lambda y: negative(sin(y))),
        sp.cos: (lambda y: negative(sin(y)), lambda y: negative(cos(y))),
        sp.tan: (
            _tangent_slope,
            lambda y: _scaled(2.0, _INTERVALS.multiply(_INTERVALS.tan(y), _tangent_slope(y))),
        ),
        sp.asin: asin,
        sp.acos: (lambda y: negative(asin[0](y)), lambda y: negative(asin[1](y))),
        sp.atan: _of_quotient(plus, -1.0),
        sp.sinh: (cosh, sinh),
        sp.cosh: (sinh, cosh),
        sp.tanh: (
            tanh_slope,
            lambda y: _scaled(-2.0, _INTERVALS.multiply(tanh(y), tanh_slope(y))),
        ),
        sp.asinh: _of_root(plus, -1.0),
        sp.acosh: _of_root(beyond, -1.0),
        sp.atanh: _of_quotient(minus, 1.0),
    }


_DERIVATIVES = _derivatives()
"""First and second derivatives on intervals."""

_DOMAINS: dict[Any, Callable[[Interval], np.ndarray]] = {
    sp.log: lambda y: np.greater(y.low, 0.0),
    sp.asin: lambda y: np.greater(y.low, -1.0) & np.less(y.high, 1.0),
    sp.acos: lambda y: np.greater(y.low, -1.0) & np.less(y.high, 1.0),
    sp.acosh: lambda y: np.greater(y.low, 1.0),
    sp.atanh: lambda y: np.greater(y.low, -1.0) & np.less(y.high, 1.0),
    sp.tan: lambda y: is_finite(_INTERVALS.tan(y)),
}
"""Where a function is smooth, of those that are not smooth everywhere."""
