"""Chebyshev bases: values, derivatives and exact polynomials."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs.proofs.linear_program import ChebyshevBasis

X, Y = sp.symbols("x y", real=True)
BASIS = ChebyshevBasis(
    (X, Y), (Fraction(1, 2), Fraction(-1)), (Fraction(2), Fraction(3, 10)), degree=5
)
RNG = np.random.default_rng(0)
STATES = np.array([0.5, -1.0]) + np.array([2.0, 0.3]) * RNG.uniform(-1, 1, (20, 2))


def test_members_are_products_of_chebyshev_polynomials():
    z = (STATES - [0.5, -1.0]) / [2.0, 0.3]
    for key, values in zip(BASIS.exponents, BASIS.values(STATES).T, strict=True):
        expected = np.cos(key * np.arccos(z)).prod(axis=1)
        np.testing.assert_allclose(values, expected, atol=1e-12)


def test_the_first_member_is_one_and_all_degrees_are_there():
    assert BASIS.exponents[0].tolist() == [0, 0]
    assert len(BASIS.exponents) == 21
    even = ChebyshevBasis(BASIS.states, BASIS.center, BASIS.scale, 5, even=True)
    assert sorted({sum(key) for key in even.exponents.tolist()}) == [0, 2, 4]


def test_derivatives_are_those_of_the_exact_polynomial():
    coefficients = RNG.uniform(-1, 1, len(BASIS.exponents))
    psi, jets = BASIS.polynomial(coefficients, decimals=9), BASIS.jets(STATES)
    np.testing.assert_allclose(psi.values(STATES), jets.values @ coefficients, atol=1e-7)
    for i in range(2):
        first = psi.derivative(i)
        np.testing.assert_allclose(
            first.values(STATES), jets.gradients[:, i] @ coefficients, atol=1e-5
        )
        for j in range(2):
            np.testing.assert_allclose(
                first.derivative(j).values(STATES),
                jets.hessians[:, i, j] @ coefficients,
                atol=1e-3,
            )


@pytest.mark.parametrize("even", [False, True])
def test_a_polynomial_of_a_lower_degree_is_one_of_a_higher_degree(even):
    low, high = (
        ChebyshevBasis(BASIS.states, BASIS.center, BASIS.scale, degree, even) for degree in (2, 4)
    )
    coefficients = RNG.uniform(-1, 1, len(low.exponents))
    embedded = high.embedded(low, coefficients)
    np.testing.assert_allclose(high.values(STATES) @ embedded, low.values(STATES) @ coefficients)


def test_coefficients_are_rounded_to_short_decimals():
    one = ChebyshevBasis((X,), (Fraction(0),), (Fraction(1),), degree=2)
    psi = one.polynomial(np.array([1 / 3, 0.0, 0.25]), decimals=3)
    assert psi.coefficients == {(0,): Fraction(83, 1000), (2,): Fraction(1, 2)}


@pytest.mark.parametrize("degree", [0, 1, 2, 7])
def test_the_number_of_members(degree):
    basis = ChebyshevBasis(BASIS.states, BASIS.center, BASIS.scale, degree)
    assert basis.values(STATES).shape == (20, (degree + 1) * (degree + 2) // 2)
