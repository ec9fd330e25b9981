"""Forms of polynomials and of their derivatives hold the exact values."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.enclosures.polynomial_forms import ExpandedPolynomial
from tests.oracles.exact_values import points_in

X, Y, Z = sp.symbols("x y z", real=True)


def exact_value(polynomial, order, state):
    """The derivative of a polynomial at floats, a fraction."""
    for i, times in enumerate(order):
        for _ in range(times):
            polynomial = polynomial.derivative(i)
    scaled = [
        (Fraction(float(x)) - c) / s
        for x, c, s in zip(state, polynomial.center, polynomial.scale, strict=True)
    ]
    total = Fraction(0)
    for key, value in polynomial.coefficients.items():
        for z, exponent in zip(scaled, key, strict=True):
            value *= z**exponent
        total += value
    return total


def exact_line(form, box, i, state):
    """The exact value of the linear part of a form at a state."""
    about = Fraction(float(form.center[i]))
    for j, x in enumerate(state):
        low, high = (Fraction(float(end)) for end in box[:, j])
        t = (Fraction(float(x)) - (low + high) / 2) / ((high - low) / 2) if high > low else 0
        about += Fraction(float(form.slopes[j, i])) * t
    return about


def random_polynomial(random, n, degree):
    states = (X, Y, Z)[:n]
    keys = [k for k in itertools.product(range(degree + 1), repeat=n) if sum(k) <= degree]
    keys = [keys[i] for i in random.permutation(len(keys))[:60]]
    numbers = 10.0 ** random.uniform(-6, 3, len(keys)) * random.choice([-1, 1], len(keys))
    center = tuple(Fraction(int(c), 7) for c in random.integers(-20, 20, n))
    scale = tuple(Fraction(int(c), 9) for c in random.integers(1, 40, n))
    coefficients = {k: Fraction(repr(float(v))) for k, v in zip(keys, numbers, strict=True)}
    return Polynomial(states, center, scale, coefficients)


def boxes_around(random, polynomial, count):
    center = np.array(polynomial.center, float)[:, None]
    scale = np.array(polynomial.scale, float)[:, None]
    middle = center + scale * random.uniform(-2, 2, (polynomial.n, count))
    wide = scale * 10.0 ** random.uniform(-12, 0.5, middle.shape)
    wide *= random.random(middle.shape) < 0.9
    return np.array([middle - wide, middle + wide])


@pytest.mark.parametrize(("n", "degree"), [(1, 3), (1, 16), (2, 5), (2, 16), (3, 4)])
@pytest.mark.parametrize("polynomials", [2, pytest.param(300, marks=pytest.mark.oracle)])
def test_forms_of_derivatives_hold_exact_values(n, degree, polynomials):
    random = np.random.default_rng(degree)
    orders = [o for o in itertools.product(range(3), repeat=n) if sum(o) <= 2]
    for _ in range(polynomials):
        polynomial = random_polynomial(random, n, degree)
        boxes = boxes_around(random, polynomial, 10)
        # One box at a time has its own error; together they share the largest one.
        for chosen in (boxes, boxes[:, :, :1]):
            forms = ExpandedPolynomial(polynomial).forms(*chosen, orders)
            for (order, form), i in itertools.product(
                zip(orders, forms, strict=True), range(chosen.shape[2])
            ):
                box = chosen[:, :, i]
                for state in points_in(box, random, 1):
                    value = exact_value(polynomial, order, state)
                    assert form.range.low[i] <= value <= form.range.high[i]
                    assert abs(exact_line(form, box, i, state) - value) <= form.radius[i]
                assert form.smooth[i]


def chebyshev(degree):
    """The polynomial cos(degree arccos z) of z = (x - 1/3)/(10/7)."""
    terms = sp.Poly(sp.chebyshevt_poly(degree, X), X).terms()
    return Polynomial(
        (X,),
        (Fraction(1, 3),),
        (Fraction(10, 7),),
        {key: Fraction(int(value)) for key, value in terms},
    )


def test_forms_of_chebyshev_polynomials_are_tight_on_narrow_boxes():
    polynomial = chebyshev(16)
    middles = 1 / 3 + 10 / 7 * np.linspace(-0.99, 0.99, 199)
    boxes = np.array([[middles - 1e-5], [middles + 1e-5]])
    (form,) = ExpandedPolynomial(polynomial).forms(*boxes, [(0,)])
    values = np.cos(16 * np.arccos(np.linspace(-0.99, 0.99, 199)))
    np.testing.assert_allclose(form.center, values, atol=1e-7)
    # Errors of rounding of coefficients up to 2e5, and the square of the width times T''.
    assert form.radius.max() < 1e-6
    assert (form.range.low <= values).all()
    assert (values <= form.range.high).all()


@pytest.mark.parametrize(
    "ends",
    [(-np.inf, np.inf), (0.0, np.inf), (-1e300, 1e300), (1e7, 1e8)],
)
def test_boxes_that_reach_far_are_not_wrong(ends):
    polynomial = chebyshev(3)
    boxes = np.array([[[ends[0], -1.0]], [[ends[1], 1.0]]])
    far, near = (
        np.array([form.range.low, form.range.high])
        for form in ExpandedPolynomial(polynomial).forms(*boxes, [(0,), (1,)])
    )
    for found in (far, near):
        assert not np.isnan(found).any()
        assert np.isinf(found[:, 0]).all()
        assert np.isfinite(found[:, 1]).all()
