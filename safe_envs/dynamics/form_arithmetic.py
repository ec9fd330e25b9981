"""The arithmetic of first-order forms: sums, products, and functions by Taylor's formula."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.first_order_forms import (
    EPS,
    MORE,
    SMALLEST,
    TINY,
    Form,
    is_finite,
    middle,
    with_range,
)
from safe_envs.dynamics.interval_arithmetic import Interval, negative
from safe_envs.dynamics.intervals import IntervalOperations

_INTERVALS = IntervalOperations()


class FormArithmetic:
    """Operations on forms a, b, x and y; constants have one entry, which broadcasts over the boxes.

    Powers have a whole number n or a constant exponent.
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
        """Return a + b; see `FormArithmetic`."""
        center, slopes = a.center + b.center, a.slopes + b.slopes
        error = EPS * (np.abs(center) + np.abs(slopes).sum(axis=0))
        known = _INTERVALS.add(a.range, b.range)
        return with_range(center, slopes, a.radius + b.radius + error, known, a.smooth & b.smooth)

    def multiply(self, a: Form, b: Form) -> Form:
        """Return a b; see `FormArithmetic`."""
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
        """Return a^n; see `FormArithmetic`."""
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
        """Return a^exponent, not smooth where a reaches 0; see `FormArithmetic`."""
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
        value: Callable[[Interval], Interval],
        slope: Callable[[Interval], Interval],
        curve: Callable[[Interval], Interval],
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
