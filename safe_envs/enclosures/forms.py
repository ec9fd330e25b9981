"""First-order forms: enclosures of functions on many boxes that follow their slopes.

On a box the states are x_i = mid_i + rad_i t_i with t_i in [-1, 1]. A form encloses a function as
center + sum_i slopes_i t_i + e with |e| <= radius, and has its range as an interval too. The error
of a smooth function falls with the square of the width of a box, that of interval arithmetic alone
with the width. These are Taylor models of first order (Makino and Berz 2003), or affine arithmetic
with the states as its only symbols (de Figueiredo and Stolfi 2004).

Every operation notes where it is not known to be twice continuously differentiable on the whole
closed box: where it meets a pole, a branch cut, the end of its domain, a kink or a jump. That is
seen by evaluation, so that no name and no form hides it.

Rounding: the operations on centers and slopes are off by a few units in the last place of the
absolute values that enter; these are added to the radius. The ranges are rounded outwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.enclosures.expression_program import Operation
from safe_envs.enclosures.intervals import Interval, IntervalArithmetic, negative

EPS = 2.0**-52
TINY = 1e-300
SMALLEST = 5e-324
MORE = 1.0 + 64 * EPS


class Form(NamedTuple):
    """Enclosures of a function on B boxes of n states.

    Attributes:
        center: shape (B,).
        slopes: shape (n, B).
        radius: of the error, infinite where only the range is known; shape (B,).
        range: lower and upper ends, shape (B,) each.
        smooth: whether it is twice continuously differentiable on the closed box, shape (B,).
    """

    center: np.ndarray
    slopes: np.ndarray
    radius: np.ndarray
    range: Interval
    smooth: np.ndarray


def variables(low: np.ndarray, high: np.ndarray) -> list[Form]:
    """Return the forms of the states themselves.

    Args:
        low: lower ends of the boxes, shape (n, B); may be infinite.
        high: upper ends, shape (n, B).
    """
    found = []
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        mid, rad = middle(a, b)
        finite = np.isfinite(rad)
        slopes = np.zeros(low.shape)
        slopes[i] = np.where(finite, rad, 0.0)
        error = np.where(finite, EPS * (np.abs(mid) + rad) + TINY, np.inf)
        found.append(
            Form(
                np.where(finite, mid, 0.0),
                slopes,
                error,
                Interval(a, b),
                np.ones(len(a), dtype=bool),
            )
        )
    return found


def middle(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return midpoints and half widths, not finite where an interval is not.

    Args:
        low: lower ends.
        high: upper ends.
    """
    with np.errstate(invalid="ignore"):
        return 0.5 * low + 0.5 * high, 0.5 * high - 0.5 * low


def points(values: np.ndarray, n: int) -> Form:
    """Return the form of a number for each box.

    Args:
        values: shape (B,).
        n: number of states.
    """
    nothing = np.zeros(len(values))
    smooth = np.ones(len(values), dtype=bool)
    return Form(values, np.zeros((n, len(values))), nothing, Interval(values, values), smooth)


def with_range(
    center: np.ndarray,
    slopes: np.ndarray,
    radius: np.ndarray,
    known: Interval,
    smooth: np.ndarray,
) -> Form:
    """Return a form, with the range that follows from it cut to the one that is known.

    Args:
        center: see `Form`.
        slopes: see `Form`.
        radius: see `Form`; may be NaN where nothing is known.
        known: range.
        smooth: see `Form`.
    """
    radius = np.where(np.isfinite(center + radius), radius * MORE + TINY, np.inf)
    lost = ~(np.isfinite(radius) & np.isfinite(slopes).all(axis=0))
    if lost.any():
        center, radius = np.where(lost, 0.0, center), np.where(lost, np.inf, radius)
        slopes = np.where(lost, 0.0, slopes)
    reach = (np.abs(slopes).sum(axis=0) + radius) * MORE
    slack = EPS * (np.abs(center) + reach)
    low = np.maximum(known.low, center - reach - slack)
    high = np.minimum(known.high, center + reach + slack)
    return Form(center, slopes, radius, Interval(low, high), smooth)


def opposite(a: Form) -> Form:
    """Return -a."""
    return Form(-a.center, -a.slopes, a.radius, negative(a.range), a.smooth)


def merged(where: np.ndarray, a: Form, b: Form) -> Form:
    """Return a on some boxes and b on the others.

    Args:
        where: flags of the boxes, shape (B,).
        a: taken where they are true.
        b: taken where they are not.
    """
    return Form(
        np.where(where, a.center, b.center),
        np.where(where, a.slopes, b.slopes),
        np.where(where, a.radius, b.radius),
        Interval(
            np.where(where, a.range.low, b.range.low), np.where(where, a.range.high, b.range.high)
        ),
        np.where(where, a.smooth, b.smooth),
    )


def is_finite(a: Interval) -> np.ndarray:
    """Return where both ends are finite, shape (B,)."""
    return np.isfinite(a.low) & np.isfinite(a.high)


_INTERVALS = IntervalArithmetic()
IntervalMap = Callable[[Interval], Interval]


class FormOperations:
    """Operations on forms a, b, x and y; constants have one entry, which broadcasts over the boxes.

    Functions of one argument are named by their SymPy classes. Powers have a whole number n or a
    constant exponent.
    """

    def __init__(self, n: int) -> None:
        """Prepare for boxes of n states."""
        self._n = n

    def constant(self, number: Any) -> Form:
        """Return the form of a real number."""
        low, high = (np.array([end]) for end in _INTERVALS.constant(number))
        return self.of_interval(Interval(low, low if low == high else high))

    def of_interval(self, a: Interval, smooth: np.ndarray | None = None) -> Form:
        """Return a form that knows nothing but a range.

        Args:
            a: the range.
            smooth: see `Form`; by default true.
        """
        mid, rad = middle(*a)
        radius = rad + EPS * (np.abs(mid) + rad)
        radius = np.where(np.equal(a.low, a.high), 0.0, radius)
        known = np.isfinite(radius)
        boxes = np.size(radius)
        smooth = np.ones(boxes, dtype=bool) if smooth is None else smooth
        slopes = np.zeros((self._n, boxes))
        return Form(np.where(known, mid, 0.0), slopes, np.where(known, radius, np.inf), a, smooth)

    def size(self, a: Form) -> int:
        """Return the number of boxes; a constant has one."""
        return int(np.size(a.center))

    def add(self, a: Form, b: Form) -> Form:
        """Return a + b; see `FormOperations`."""
        center, slopes = a.center + b.center, a.slopes + b.slopes
        error = EPS * (np.abs(center) + np.abs(slopes).sum(axis=0))
        known = _INTERVALS.add(a.range, b.range)
        return with_range(center, slopes, a.radius + b.radius + error, known, a.smooth & b.smooth)

    def multiply(self, a: Form, b: Form) -> Form:
        """Return a b; see `FormOperations`."""
        known = _INTERVALS.multiply(a.range, b.range)
        center = a.center * b.center
        slopes = a.center * b.slopes + b.center * a.slopes
        steep, other = np.abs(a.slopes).sum(axis=0), np.abs(b.slopes).sum(axis=0)
        # t_i^2 lies in [0, 1]: half of its coefficient goes to the center.
        squares = a.slopes * b.slopes
        half = 0.5 * squares.sum(axis=0)
        mixed = _mixed(a.slopes, b.slopes)
        largest = np.maximum(np.abs(b.range.low), np.abs(b.range.high))
        radius = (
            0.5 * np.abs(squares).sum(axis=0)
            + mixed
            + _times(a.radius, largest)
            + _times(b.radius, np.abs(a.center) + steep)
        )
        radius = np.where(np.isfinite(a.radius) & np.isfinite(b.radius), radius, np.inf)
        scale = (np.abs(a.center) + steep) * (np.abs(b.center) + other)
        rounding = (self._n + 6) * (EPS * scale + TINY)
        return with_range(center + half, slopes, radius + rounding, known, a.smooth & b.smooth)

    def reciprocal(self, a: Form) -> Form:
        """Return 1/a; not smooth where 0 is met."""
        regular = (a.range.low > 0.0) | (a.range.high < 0.0)
        powers = [lambda y, k=k: _INTERVALS.integer_power(y, -k) for k in (1, 2, 3)]
        return self.composed(
            a,
            powers[0],
            lambda y: negative(powers[1](y)),
            lambda y: _scaled(2.0, powers[2](y)),
            regular,
        )

    def square_root(self, a: Form) -> Form:
        """Return the root of a; not smooth where a reaches 0."""
        root, inverse = _INTERVALS.square_root, _INTERVALS.reciprocal
        return self.composed(
            a,
            root,
            lambda y: _scaled(0.5, inverse(root(y))),
            lambda y: _scaled(-0.25, inverse(_INTERVALS.multiply(y, root(y)))),
            a.range.low > 0.0,
        )

    def integer_power(self, a: Form, n: int) -> Form:
        """Return a^n; see `FormOperations`."""
        if n < 0:
            return self.reciprocal(self.integer_power(a, -n))
        if n == 1:
            return a
        power = _INTERVALS.integer_power
        if n == 0:
            return self.constant(sp.Integer(1))
        return self.composed(
            a,
            lambda y: power(y, n),
            lambda y: _scaled(float(n), power(y, n - 1)),
            lambda y: _scaled(float(n * (n - 1)), power(y, n - 2)),
        )

    def real_power(self, a: Form, exponent: Form) -> Form:
        """Return a^exponent, not smooth where a reaches 0; see `FormOperations`."""
        e = Interval(float(exponent.range.low[0]), float(exponent.range.high[0]))
        less = [_INTERVALS.add(e, Interval(-k, -k)) for k in (0.0, 1.0, 2.0)]
        factor = _INTERVALS.multiply(e, less[1])
        power = _INTERVALS.real_power
        return self.composed(
            a,
            lambda y: power(y, e),
            lambda y: _INTERVALS.multiply(e, power(y, less[1])),
            lambda y: _INTERVALS.multiply(factor, power(y, less[2])),
            a.range.low > 0.0,
        )

    def composed(
        self,
        a: Form,
        value: IntervalMap,
        slope: IntervalMap,
        curve: IntervalMap,
        regular: np.ndarray | None = None,
    ) -> Form:
        """Return a function of a form, by Taylor's formula about its center.

        Args:
            a: argument.
            value: the function on intervals.
            slope: its derivative.
            curve: its second derivative.
            regular: where it is twice continuously differentiable on the whole range of a.
        """
        known = value(a.range)
        at = np.clip(a.center, a.range.low, a.range.high)
        at = np.where(np.isfinite(at), at, 0.0)
        point = Interval(at, at)
        middles, rises = value(point), slope(point)
        bend = curve(a.range)
        below, above = at - a.range.low, a.range.high - at
        distance = np.maximum(below, above) * MORE
        center, error = _ball(middles)
        rise, uncertain = _ball(rises)
        # A square that underflows is not 0: the curvature may be as large as that is small.
        curved = 0.5 * distance * distance * MORE + SMALLEST
        low = -_times(-np.minimum(bend.low, 0.0), curved)
        high = _times(np.maximum(bend.high, 0.0), curved)
        half, spread = _ball(Interval(low, high))
        moved = rise * (a.center - at)
        slopes = rise * a.slopes
        radius = (
            error
            + spread
            + _times(uncertain, distance)
            + _times(np.abs(rise), a.radius)
            + 8 * EPS * (np.abs(center) + np.abs(half) + np.abs(moved))
            + 8 * EPS * np.abs(slopes).sum(axis=0)
        )
        smooth = a.smooth & is_finite(known)
        smooth = smooth if regular is None else smooth & regular
        if regular is not None:
            radius = np.where(regular, radius, np.inf)  # Taylor's formula says nothing there.
        return with_range(center + half + moved, slopes, radius, known, smooth)

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
        """Return the angle of (x, y), by a quotient that is regular; see `FormOperations`."""
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


def _mixed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum over i < j of |a_i b_j + a_j b_i|, shape (B,)."""
    found = np.zeros(max(a.shape[1], b.shape[1]))
    for i in range(1, len(a)):
        found += np.abs(a[i] * b[:i] + a[:i] * b[i]).sum(axis=0)
    return found


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a b for nonnegative numbers, 0 where one is 0 and the other infinite."""
    return np.where((a == 0.0) | (b == 0.0), 0.0, a * b)


def _ball(a: Interval) -> tuple[np.ndarray, np.ndarray]:
    """Return center and radius of intervals."""
    mid, rad = middle(np.asarray(a.low, dtype=float), np.asarray(a.high, dtype=float))
    return mid, rad + EPS * (np.abs(mid) + rad)


def _scaled(factor: float, a: Interval) -> Interval:
    """Return a times a number that is a float exactly."""
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


_CLOSED = {sp.asin: (-1.0, 1.0), sp.acos: (-1.0, 1.0), sp.acosh: (1.0, math.inf)}
"""Domains of functions that are continuous up to their ends."""


class ContinuousOperations(FormOperations):
    """Operations whose forms are `smooth` where the function is continuous on the closed box.

    A sign of a continuous function changes at a zero only. At a pole or a jump it may change
    without one, and boxes that end there may all be without a zero: 1/x is above 0 on [0, 1] and
    below it on [-1, 0].
    """

    def function(self, kind: Any) -> Operation:
        """Return a function of one argument."""
        applied = super().function(kind)
        if kind not in _CLOSED:
            return applied
        low, high = _CLOSED[kind]

        def continuous(a: Form) -> Form:
            inside = (a.range.low >= low) & (a.range.high <= high)
            return applied(a)._replace(smooth=a.smooth & inside)

        return continuous

    def composed(
        self,
        a: Form,
        value: IntervalMap,
        slope: IntervalMap,
        curve: IntervalMap,
        regular: np.ndarray | None = None,
    ) -> Form:
        """Return a function of a form, which need not be finite on a box without end."""
        smooth = a.smooth if regular is None else a.smooth & regular
        return super().composed(a, value, slope, curve, regular)._replace(smooth=smooth)

    def square_root(self, a: Form) -> Form:
        """Return the root of a."""
        return super().square_root(a)._replace(smooth=a.smooth & (a.range.low >= 0.0))

    def real_power(self, a: Form, exponent: Form) -> Form:
        """Return a^e for a constant e."""
        continuous = a.range.low >= 0.0 if exponent.range.low[0] > 0.0 else a.range.low > 0.0
        return super().real_power(a, exponent)._replace(smooth=a.smooth & continuous)

    def extreme(self, kind: Any) -> Operation:
        """Return the larger or the smaller of two."""
        applied = super().extreme(kind)
        return lambda a, b: applied(a, b)._replace(smooth=a.smooth & b.smooth)

    def _absolute(self, a: Form) -> Form:
        return super()._absolute(a)._replace(smooth=a.smooth)
