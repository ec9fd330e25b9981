"""Polynomials of scaled states, exact."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs import SystemDefinitionError
from safe_envs.dynamics.polynomial import Polynomial

X, Y = sp.symbols("x y", real=True)
MADE = Polynomial(
    (X, Y),
    (Fraction(1, 3), Fraction(-2)),
    (Fraction(3, 7), Fraction(5)),
    {(0, 0): Fraction(1, 10), (3, 1): Fraction(-7, 3), (0, 4): Fraction(2), (2, 0): Fraction(0)},
)


def test_the_expression_has_the_exact_coefficients():
    first, second = (X - sp.Rational(1, 3)) * sp.Rational(7, 3), (Y + 2) / 5
    expected = sp.Rational(1, 10) - sp.Rational(7, 3) * first**3 * second + 2 * second**4
    assert sp.expand(MADE.expression - expected) == 0
    assert MADE.degree == 4


@pytest.mark.parametrize("i", [0, 1])
def test_derivatives_are_those_of_the_expression(i):
    expected = sp.diff(MADE.expression, (X, Y)[i])
    assert sp.expand(MADE.derivative(i).expression - expected) == 0
    twice = MADE.derivative(i).derivative(1 - i)
    assert sp.expand(twice.expression - sp.diff(expected, (X, Y)[1 - i])) == 0


def test_values_are_those_of_the_expression():
    states = np.random.default_rng(1).normal(0, 3, (50, 2))
    expected = [
        float(MADE.expression.subs({X: sp.Rational(a), Y: sp.Rational(b)})) for a, b in states
    ]
    np.testing.assert_allclose(MADE.values(states), expected, rtol=1e-12)


@pytest.mark.parametrize("degree", [0, 1])
def test_the_last_derivative_is_zero(degree):
    one = Polynomial((X,), (Fraction(0),), (Fraction(1),), {(degree,): Fraction(5)})
    for _ in range(degree + 1):
        one = one.derivative(0)
    assert one.expression == 0
    assert one.degree == 0
    np.testing.assert_array_equal(one.values(np.ones((3, 1))), 0.0)


@pytest.mark.parametrize(
    "change",
    [
        {"center": (Fraction(0),)},
        {"scale": (Fraction(1), Fraction(0))},
        {"scale": (Fraction(1), Fraction(-1))},
        {"coefficients": {(1,): Fraction(1)}},
        {"coefficients": {(1, -1): Fraction(1)}},
        {"coefficients": {(1, 0.5): Fraction(1)}},
    ],
)
def test_what_is_no_polynomial_is_refused(change):
    parts = {
        "states": (X, Y),
        "center": (Fraction(0), Fraction(0)),
        "scale": (Fraction(1), Fraction(1)),
        "coefficients": {(1, 1): Fraction(1)},
    }
    with pytest.raises(SystemDefinitionError):
        Polynomial(**{**parts, **change})
