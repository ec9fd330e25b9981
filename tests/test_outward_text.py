"""Bounds as text: no digit says more than the number."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_envs.text import (
    number_at_least,
    number_at_most,
    percent_at_least,
    percent_at_most,
    percents_apart,
    percents_between,
)

SHARES = st.floats(0.0, 1.0)


@pytest.mark.parametrize(
    ("bound", "least", "most"),
    [
        (0.4229, "42.2", "42.3"),
        (0.29, "29.0", "29.0"),
        (0.0924, "9.2", "9.3"),
        (0.9999, "99.9", "99.99"),
        (1.0, "100.0", "100.0"),
        (0.0, "0.0", "0.0"),
        (0.00049, "0.04", "0.05"),
        (6e-19, "0.0", "0.000000001"),
        (Fraction(1, 3), "33.3", "33.4"),
    ],
)
def test_one_bound(bound, least, most):
    assert (percent_at_least(bound), percent_at_most(bound)) == (least, most)


@given(SHARES)
def test_no_digit_says_more_than_a_bound(bound):
    exact = 100 * Fraction(repr(bound))
    assert Fraction(percent_at_least(bound)) <= exact <= Fraction(percent_at_most(bound))
    assert exact - Fraction(percent_at_least(bound, 2)) <= Fraction(1, 100)


@given(SHARES, SHARES)
def test_no_digit_says_more_than_two_bounds(one, other):
    lower, upper = sorted((one, other))
    low, high = (Fraction(text) for text in percents_between(lower, upper))
    assert low <= 100 * Fraction(repr(lower))
    assert 100 * Fraction(repr(upper)) <= high


@given(st.floats(-1e300, 1e300, allow_subnormal=False), st.integers(1, 15))
def test_no_digit_says_more_than_a_number(value, digits):
    low, high = number_at_least(value, digits), number_at_most(value, digits)
    assert Fraction(low) <= Fraction(repr(value)) <= Fraction(high)
    if value and abs(value) > 1e-290:
        spacing = Fraction(10) ** (math.floor(math.log10(abs(value))) + 2 - digits)
        assert Fraction(high) - Fraction(low) <= spacing


@given(SHARES, SHARES)
def test_bounds_that_contradict_each_other_are_told_apart(one, other):
    upper, lower = sorted((one, other))
    most, least = (Fraction(text) for text in percents_apart(upper, lower))
    assert 100 * Fraction(repr(upper)) <= most
    assert least <= 100 * Fraction(repr(lower))
    assert most < least or lower - upper < 1e-15


def test_numbers_have_as_many_digits_as_are_asked_for():
    assert (number_at_most(0.0800001), number_at_least(0.0800001)) == ("0.08001", "0.08")
    assert number_at_most(123.0) == "123"
    assert number_at_most(Fraction(2, 3), 2) == "0.67"
    assert number_at_most(math.inf) == "infinite"
