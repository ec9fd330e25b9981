"""First-order forms hold the exact values, and say where a function is not smooth."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest
import sympy as sp

from tests.oracles.exact_values import (
    X,
    Y,
    errors_of,
    exact_function,
    forms_of,
    points_in,
    random_boxes,
    random_expression,
)

BOXES = 30


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cases", [2_000, pytest.param(250_000, marks=pytest.mark.oracle)])
def test_forms_of_random_compositions_hold_exact_values(cases, seed):
    random, looked_at = np.random.default_rng(seed), 0
    while looked_at < cases:
        expression = random_expression(random, int(random.integers(1, 4)))
        boxes = random_boxes(random, BOXES)
        (form,) = forms_of([expression], boxes)
        exact = exact_function(expression)
        for i in range(BOXES):
            for state in points_in(boxes[:, :, i], random, 2):
                value = exact(state)
                if value is None:
                    # Where the larger one of two is certain, the other one need not have a value.
                    assert expression.has(sp.Max, sp.Min) or not form.smooth[i], expression
                elif not mpmath.isnan(value):
                    found = errors_of(form, boxes[:, :, i], i, state, value)
                    assert not found, (expression, boxes[:, :, i], state, found)
                    looked_at += 1


ROUGH = {
    "corner of a kink": (sp.Abs(X), (0.0, 1.0)),
    "negative zero": (sp.Abs(X), (-1.0, -0.0)),
    "kink inside": (sp.Abs(X - 1), (0.0, 3.0)),
    "root of a square": (sp.sqrt(X**2 + 0 * Y), (-1.0, 1.0)),
    "hidden kink": (sp.Rational(1, 2) - sp.sqrt(2 - 2 * sp.cos(X)), (-1.0, 1.0)),
    "end of a root": (sp.sqrt(X), (0.0, 1.0)),
    "beyond a root": (sp.sqrt(X), (-2.0, -1.0)),
    "pole": (1 / X, (-1.0, 1.0)),
    "pole at a corner": (1 / X, (0.0, 1.0)),
    "pole of a bounded function": (sp.tanh(1 / X), (0.0, 1.0)),
    "logarithm of 0": (sp.log(X), (0.0, 1.0)),
    "end of asin": (sp.asin(X), (0.0, 1.0)),
    "end of acos": (sp.acos(X), (-1.0, 0.0)),
    "end of acosh": (sp.acosh(X), (1.0, 2.0)),
    "end of atanh": (sp.atanh(X), (0.0, 1.0)),
    "pole of tan": (sp.tan(X), (1.5, 1.6)),
    "cut of atan2": (sp.atan2(X, -1), (-1.0, 1.0)),
    "cut at a corner": (sp.atan2(X, -1), (0.0, 1.0)),
    "origin of atan2": (sp.atan2(X, X), (0.0, 1.0)),
    "maximum": (sp.Max(X, 0), (-1.0, 1.0)),
    "maximum at a corner": (sp.Max(X, 1 - X), (0.5, 1.0)),
    "minimum": (sp.Min(X, 1 - X), (0.0, 0.5)),
    "sign at a corner": (sp.sign(X), (0.0, 1.0)),
    "floor at a corner": (sp.floor(X), (0.25, 1.0)),
    "ceiling at a corner": (sp.ceiling(X), (-1.0, -0.25)),
    "power of a half": (X ** sp.Rational(3, 2), (0.0, 1.0)),
    "kink in a kink": (sp.Max(sp.Abs(X) - 1, X / 2), (-1.0, 0.5)),
}
SMOOTH = {
    "absolute value": (sp.Abs(X), (1e-9, 1.0)),
    "root": (sp.sqrt(1 + X**2), (-5.0, 5.0)),
    "pole elsewhere": (1 / X, (-1.0, -1e-9)),
    "asin": (sp.asin(X), (-0.999, 0.999)),
    "acosh": (sp.acosh(X), (1.001, 2.0)),
    "atanh": (sp.atanh(X), (-0.999, 0.999)),
    "tan": (sp.tan(X), (-1.57, 1.57)),
    "atan2 above": (sp.atan2(1, X), (-9.0, 9.0)),
    "atan2 on the right": (sp.atan2(X, 1), (-9.0, 9.0)),
    "atan2 below": (sp.atan2(-1, X), (-9.0, 9.0)),
    "maximum": (sp.Max(X, -1), (-0.5, 5.0)),
    "sign": (sp.sign(X), (0.5, 1.0)),
    "floor": (sp.floor(X), (0.25, 0.75)),
    "power": (X ** sp.Rational(3, 2), (0.1, 1.0)),
    "waves": (sp.sin(X) * sp.exp(-(X**2)) + sp.tanh(X) / sp.cosh(X), (-9.0, 9.0)),
}


def form_on(expression, low, high):
    (form,) = forms_of([expression], np.array([[[low]], [[high]]]), (X,))
    return form


@pytest.mark.parametrize(
    ("expression", "ends", "smooth"),
    [
        *(pytest.param(*case, False, id=name) for name, case in ROUGH.items()),
        *(pytest.param(*case, True, id=name) for name, case in SMOOTH.items()),
    ],
)
def test_what_has_a_kink_a_pole_or_an_end_in_the_closed_box_is_not_smooth(expression, ends, smooth):
    assert form_on(expression, *ends).smooth[0] == smooth


@pytest.mark.parametrize("ends", [(-math.inf, math.inf), (0.0, math.inf), (-math.inf, -1.0)])
@pytest.mark.parametrize("seed", range(5))
def test_boxes_without_end_have_neither_nan_nor_a_finite_range_that_is_wrong(ends, seed):
    random = np.random.default_rng(seed)
    expression = random_expression(random, 3)
    boxes = np.array([[[end], [other]] for end, other in zip(ends, (-1.0, 1.0), strict=True)])
    (form,) = forms_of([expression], boxes)
    near = np.clip(boxes, -1e6, 1e6)
    exact = exact_function(expression)
    parts = (form.center, form.radius, form.slopes, *form.range)
    assert not any(np.isnan(part).any() for part in parts)
    for state in points_in(near[:, :, 0], random, 20):
        value = exact(state)
        if value is not None and not mpmath.isnan(value):
            assert form.range.low[0] <= value <= form.range.high[0], (expression, state)


@pytest.mark.parametrize("wide", [1e-163, 1e-162, 1e-160])
def test_a_square_of_a_width_that_underflows_counts(wide):
    low, high = 1e-158, 1e-158 + 2 * wide
    form = form_on(sp.log(X), low, high)
    exact = exact_function(sp.log(X), (X,))
    box = np.array([[low], [high]])
    for state in points_in(box, np.random.default_rng(1), 20):
        assert not errors_of(form, box, 0, state, exact(state))


def test_the_error_of_a_smooth_function_falls_with_the_square_of_the_width():
    expression = sp.exp(X) * sp.sin(3 * X) / (2 + X)
    errors = [form_on(expression, 0.3, 0.3 + width).radius[0] for width in (1e-1, 1e-2, 1e-3, 1e-4)]
    for wide, narrow in itertools.pairwise(errors):
        assert 50 < wide / narrow < 200
