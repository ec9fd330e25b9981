"""Forms of many derivatives at once hold the exact values, as the forms of single ones do."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.enclosures.polynomial_forms import ExpandedPolynomial

X, Y = sp.symbols("x y", real=True)


def polynomial(degree: int, size: int) -> Polynomial:
    random = np.random.default_rng(degree)
    keys = [k for k in itertools.product(range(degree + 1), repeat=2) if sum(k) <= degree]
    values = [Fraction(int(v), 97) for v in random.integers(-size, size + 1, len(keys))]
    center, scale = (Fraction(1, 3), Fraction(-1, 7)), (Fraction(5, 4), Fraction(2))
    return Polynomial((X, Y), center, scale, dict(zip(keys, values, strict=True)))


def exact(p: Polynomial, order: tuple[int, ...], x: Fraction, y: Fraction) -> Fraction:
    for i, times in enumerate(order):
        for _ in range(times):
            p = p.derivative(i)
    z = [(v - c) / s for v, c, s in zip((x, y), p.center, p.scale, strict=True)]
    return sum((c * z[0] ** k[0] * z[1] ** k[1] for k, c in p.coefficients.items()), Fraction(0))


@pytest.mark.parametrize(("degree", "size"), [(3, 10), (8, 10**6)])
def test_many_derivatives_hold_exact_values_and_are_nearly_as_narrow(
    degree: int, size: int
) -> None:
    p = polynomial(degree, size)
    orders = [k for k in itertools.product(range(degree + 2), repeat=2) if sum(k) <= degree]
    random = np.random.default_rng(1)
    middle = random.uniform(-1.0, 1.0, (2, 6))
    half = 10.0 ** random.uniform(-9.0, -0.5, (2, 6))
    half[:, 0] = 0.0
    low, high = middle - half, middle + half
    together = ExpandedPolynomial(p).forms(low, high, orders)
    for order, form in zip(orders, together, strict=True):
        (alone,) = ExpandedPolynomial(p).forms(low, high, [order])
        width, single = (f.range.high - f.range.low for f in (form, alone))
        assert (width <= 4.0 * single + 1e-9 * (1.0 + np.abs(alone.center))).all()
        for box in range(6):
            for share in ((0.0, 0.0), (1.0, 1.0), (0.3, 0.8)):
                at = [
                    Fraction(float(low[i, box]))
                    + Fraction(s) * Fraction(float(high[i, box] - low[i, box]))
                    for i, s in enumerate(share)
                ]
                value = exact(p, order, at[0], at[1])
                assert form.range.low[box] <= value <= form.range.high[box]
                t = [
                    (a - Fraction(float(0.5 * lo + 0.5 * hi)))
                    / Fraction(float(0.5 * hi - 0.5 * lo))
                    if hi > lo
                    else Fraction(0)
                    for a, lo, hi in zip(at, low[:, box], high[:, box], strict=True)
                ]
                linear = Fraction(float(form.center[box])) + sum(
                    Fraction(float(s)) * v for s, v in zip(form.slopes[:, box], t, strict=True)
                )
                assert abs(value - linear) <= Fraction(float(form.radius[box]))
