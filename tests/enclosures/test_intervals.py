"""Functions of intervals: they hold all values, in exact arithmetic too, and hardly more."""

from __future__ import annotations

import copy
import math
import pickle

import mpmath
import numpy as np
import pytest
import sympy as sp

from safe_envs import SystemDefinitionError
from safe_envs.dynamics.codegen import compile_function
from safe_envs.enclosures.intervals import Interval, interval_function
from tests.oracles.exact_values import (
    X,
    Y,
    exact_function,
    points_in,
    random_boxes,
    random_expression,
)

Z = sp.Symbol("z", real=True)
INF = math.inf
# Every operation, with boxes inside of its domain, at its turning points and across its jumps.
CASES = (
    (X + Y - Z, ((-1, 2), (0.1, 0.3), (-5, 7))),
    (X * Y * Z, ((-1, 2), (0.1, 0.3), (-5, 7))),
    (X * Y, ((0.5, 2), (-4, 3), (0, 1))),
    (-3.7 * X + sp.Rational(1, 3) * Y + sp.pi * Z, ((-1, 2), (0.1, 0.3), (-5, 7))),
    (X**2 + Y**3 - Z**4, ((-1, 2), (-2, 0.3), (-5, -3))),
    (X**-1 + Y**-2 + Z**-3, ((0.3, 2), (-2, -0.3), (-5, -3))),
    (sp.sqrt(X**2 + Y**2) / Z, ((-0.5, 0.5), (-1, 0.3), (2, 3))),
    (X**1.5 + Y ** sp.Rational(-2, 3) + Z**2.25, ((0, 2), (0.1, 0.3), (1, 7))),
    (X**Y + 2**Z, ((0.5, 2), (-2, 3), (-5, 7))),
    (sp.exp(X) - sp.log(Y) + sp.tanh(Z), ((-1, 2), (0.1, 3), (-5, 7))),
    (sp.sin(X) + sp.cos(Y) * sp.sin(Z), ((-1, 1), (-0.3, 0.4), (3, 4))),
    (sp.sin(X) * sp.cos(Y) + sp.sin(Z), ((1, 2), (3, 3.5), (-100, -98.5))),
    (sp.tan(X) + sp.atan(Y) - sp.cot(Z), ((-1.5, 1.5), (-30, 30), (0.1, 3))),
    (sp.asin(X) + sp.acos(Y) + sp.sec(Z), ((-1, 1), (-0.3, 1), (-1, 1.5))),
    (sp.atan2(X, Y) + Z, ((-1, 2), (0.1, 0.3), (0, 1))),
    (sp.atan2(X, Y) + Z, ((0.1, 2), (-3, 1), (0, 1))),
    (sp.atan2(X, Y) + Z, ((-2, -0.1), (-3, 1), (0, 1))),
    (sp.atan2(X, Y) + Z, ((-2, 0.1), (-3, 1), (0, 1))),
    (sp.sinh(X) + sp.cosh(Y) - sp.coth(Z), ((-1, 2), (-2, 1), (1, 7))),
    (sp.asinh(X) + sp.acosh(Y) - sp.atanh(Z), ((-1, 2), (1, 7), (-0.9, 0.9))),
    (sp.Max(X, Y, 0.5) - sp.Min(X, Z) + abs(Y), ((-1, 2), (-3, 1), (-5, 7))),
    (sp.sign(X) + sp.floor(Y) * sp.ceiling(Z), ((-1, 2), (-3, 1), (-5, 7))),
)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("seed", range(4))
def test_exact_values_of_random_expressions_lie_inside(seed):
    random = np.random.default_rng(seed)
    for _ in range(60):
        expression = random_expression(random, int(random.integers(1, 4)))
        boxes, exact = random_boxes(random, 3), exact_function(expression)
        with np.errstate(all="ignore"):
            (result,) = interval_function((X, Y), (expression,))(
                [Interval(*e) for e in boxes.swapaxes(0, 1)]
            )
        low, high = (np.broadcast_to(end, 3) for end in result)
        for i in range(3):
            for state in points_in(boxes[:, :, i], random, 2):
                value = exact(state)
                if value is not None and not mpmath.isnan(value):
                    assert low[i] <= value <= high[i], (expression, state)


@pytest.mark.parametrize(("expression", "box"), CASES)
def test_exact_values_lie_inside_and_near_at_points(expression, box):
    low, high = np.array(box, float).T
    points = np.concatenate([np.random.default_rng(2).uniform(low, high, (20, 3)), [low, high]])
    program = interval_function((X, Y, Z), (expression,))
    (whole,) = program([Interval(float(a), float(b)) for a, b in box])
    (result,) = program(list(points.T))
    with mpmath.workdps(50):
        for point, low, high in zip(points, *map(np.ravel, result), strict=True):
            numbers = {s: sp.Float(v, 50) for s, v in zip((X, Y, Z), point, strict=True)}
            value = mpmath.mpf(sp.N(expression.xreplace(numbers), 45))
            assert mpmath.mpf(low) <= value <= mpmath.mpf(high)
            assert mpmath.mpf(float(whole.low)) <= value <= mpmath.mpf(float(whole.high))
            if not (expression.has(sp.atan2) and high - low > 6):  # [-pi, pi] at the cut
                assert high - low <= 1e-12 * (1 + abs(value))


@pytest.mark.parametrize(
    ("expression", "box", "expected"),
    [
        (X**2, (-1, 2), (0, 4)),
        (X**3, (-1, 2), (-1, 8)),
        (X**4, (-3, 2), (0, 81)),
        (sp.Mul(X, X, evaluate=False), (-1, 2), (0, 4)),
        (1 / X, (-1, 2), (-INF, INF)),
        (1 / X, (0, 2), (0.5, INF)),
        (1 / X, (-2, 0), (-INF, -0.5)),
        (1 / X**2, (-1, 2), (0.25, INF)),
        (sp.sqrt(X), (-1, 4), (-INF, INF)),
        (X**1.5, (-1, 4), (-INF, INF)),
        (X ** sp.Float(0.5), (0, 4), (0, 2)),
        (X ** sp.Rational(-1, 2), (0, 4), (0.5, INF)),
        (X ** sp.Rational(1, 3), (1, 8), (1, 2)),
        (sp.log(X), (0, 1), (-INF, 0)),
        (sp.log(X), (-1, 1), (-INF, INF)),
        (sp.asin(X), (-2, 0.5), (-INF, INF)),
        (sp.acos(X), (-1, 1), (0, math.pi)),
        (sp.sin(X), (-1, 2), (math.sin(-1), 1)),
        (sp.sin(X), (0, 7), (-1, 1)),
        (sp.sin(X), (1e6, 1e6 + 0.5), (math.sin(1e6), math.sin(1e6 + 0.5))),
        (sp.sin(X), (1.57, 1.571), (math.sin(1.57), 1)),
        (sp.sin(X), (1.5709, 4.7123), (math.sin(4.7123), math.sin(1.5709))),
        (sp.sin(X), (-1.571, -1.57), (-1, math.sin(-1.57))),
        (sp.cos(X), (6.283, 6.2833), (math.cos(6.283), 1)),
        (sp.cos(X), (6.2832, 6.2833), (math.cos(6.2833), math.cos(6.2832))),
        (sp.tan(X), (-1.57, 1.57), (math.tan(-1.57), math.tan(1.57))),
        (sp.cos(X), (-1, 2), (math.cos(2), 1)),
        (sp.cos(X), (3, 4), (-1, math.cos(4))),
        (sp.cos(X), (-INF, INF), (-1, 1)),
        (sp.tan(X), (1, 2), (-INF, INF)),
        (sp.atan2(X, 1), (-1, 1), (-math.pi / 4, math.pi / 4)),
        (sp.atan2(1, X), (-1, 1), (math.pi / 4, 3 * math.pi / 4)),
        (sp.atan2(-1, X), (-1, 1), (-3 * math.pi / 4, -math.pi / 4)),
        (sp.atan2(X, -1), (-1, 1), (-math.pi, math.pi)),
        (sp.atan2(X, X), (0, 1), (-math.pi, math.pi)),
        (abs(X), (-1, 2), (0, 2)),
        (sp.sign(X), (0, 2), (0, 1)),
        (sp.sqrt(X**2 + (2 * X) ** 2), (0, 0), (0, 0)),
        (X - sp.exp(X), (-INF, INF), (-INF, INF)),
        (X * sp.exp(X), (-INF, 0), (-INF, 0)),
    ],
)
def test_ends_are_as_tight_as_rounding_lets_them_be(expression, box, expected):
    (result,) = interval_function((X,), (expression,))([Interval(*map(float, box))])
    for end, value, outward in zip(result, expected, (-1, 1), strict=True):
        if math.isinf(value):
            assert end == value
        else:
            assert 0 <= outward * (float(end) - value) <= 16 * math.ulp(value) + 1e-300


@pytest.mark.parametrize(
    ("expression", "ulps"),
    [(X + Y, 2), (X - Y, 2), (X * Y, 2), (3.3 * X, 2), (X / 3.0, 3), (sp.sqrt(X), 2), (X**2, 2)],
)
def test_single_operations_are_off_by_two_units_in_the_last_place(expression, ulps):
    x, y = np.random.default_rng(3).uniform(0.1, 10, (2, 1000))
    (result,) = interval_function((X, Y), (expression,))([x, y])
    values = compile_function((X, Y), (expression,), "arrays")(x, y)[0]
    unit = np.spacing(np.abs(values))
    assert np.all(result.low < values)
    assert np.all(values < result.high)
    assert np.all(result.high - values <= ulps * unit)
    assert np.all(values - result.low <= ulps * unit)


def test_crests_of_far_waves_are_not_missed():
    turns = np.random.default_rng(5).integers(10**11, 10**12, 300)
    with mpmath.workdps(50):
        crests = [float((4 * int(k) + 1) * mpmath.pi / 2) for k in turns]
    above = np.nextafter(crests, INF)
    below = np.nextafter(crests, -INF)
    for a, b in ((above - 1, above), (below, below + 1)):
        (result,) = interval_function((X,), (sp.sin(X),))([Interval(a, b)])
        assert np.all(result.high == 1)
        assert np.all(result.low < 0.6)


def test_a_root_of_squares_has_its_domain():
    (result,) = interval_function((X, Y), (sp.sqrt(2 * X**2 + 3 * Y**2),))(
        [Interval(0.0, 1.0), Interval(-1.0, 0.0)]
    )
    assert result.low == 0
    assert result.high == pytest.approx(math.sqrt(5))


def test_a_point_without_a_value_is_the_whole_line():
    for rounded in (True, False):
        (result,) = interval_function((X, Y), (X - Y,), rounded)([INF, np.array([INF, 1.0])])
        assert list(result.low) == [-INF, INF if not rounded else -INF]
        assert list(result.high) == [INF, INF]


def test_products_that_underflow_are_enclosed():
    (result,) = interval_function((X, Y), (X * Y,))([1e-200, np.array([1e-200, -1e-200])])
    assert np.all(result.low <= [0, -5e-324])
    assert np.all(result.high >= [5e-324, 0])


@pytest.mark.parametrize("rounded", [True, False])
@pytest.mark.parametrize(("expression", "box"), CASES)
def test_infinite_intervals_never_give_nan(expression, box, rounded):
    ends = [(-INF, INF), (-INF, -2.0), (-1.0, 0.0), (0.0, 0.0), (0.0, INF), (3.0, INF), (1.0, 1.0)]
    grid = np.array(np.meshgrid(*[range(len(ends))] * 3)).reshape(3, -1)
    boxes = [Interval(*np.array(ends)[index].T) for index in grid]
    (result,) = interval_function((X, Y, Z), (expression,), rounded)(boxes)
    assert np.all(result.low <= result.high)


@pytest.mark.parametrize("rounded", [True, False])
def test_scalars_and_axes_broadcast(rounded):
    expressions = (X * Y + sp.sin(X), X**2, sp.Float(2.5) * Y, sp.Integer(3))
    function = interval_function((X, Y), expressions, rounded)
    x = Interval(np.array([[-1.0], [0.5]]), np.array([[1.0], [0.75]]))
    y = Interval(np.array([-3.0, -2.0, 1.0]), np.array([-2.0, 1.0, 4.0]))
    results = function([x, y])
    assert [np.shape(r.low) for r in results] == [(2, 3), (2, 1), (3,), ()]
    for i, j in np.ndindex(2, 3):
        alone = function([Interval(*(e[i, 0] for e in x)), Interval(*(e[j] for e in y))])
        for one, all_ in zip(alone, results, strict=True):
            assert np.allclose(one.low, np.broadcast_to(all_.low, (2, 3))[i, j], rtol=1e-14)
            assert np.allclose(one.high, np.broadcast_to(all_.high, (2, 3))[i, j], rtol=1e-14)


def test_unrounded_points_are_the_values():
    points = np.random.default_rng(4).uniform(0.2, 0.9, (3, 50))
    for expression, _ in CASES:
        with np.errstate(invalid="ignore"):
            values = compile_function((X, Y, Z), (expression,), "arrays")(*points)[0]
        if np.isfinite(values).all():
            (result,) = interval_function((X, Y, Z), (expression,), rounded=False)(list(points))
            assert np.allclose(result.low, values, rtol=1e-12, atol=1e-12)
            assert np.allclose(result.high, values, rtol=1e-12, atol=1e-12)


def test_arguments_stay_as_they_are():
    x = Interval(np.array([-1.0, 2.0]), np.array([1.0, 3.0]))
    before = [end.copy() for end in x]
    for rounded in (True, False):
        for expression in (X, -X, X**2, 1 / X, X + 1, 2 * X, abs(X), sp.Max(X, 0), sp.sqrt(X)):
            interval_function((X,), (expression,), rounded)([x])
    assert all(np.array_equal(a, b) for a, b in zip(x, before, strict=True))


@pytest.mark.parametrize(
    ("expression", "named"),
    [
        (sp.Piecewise((X, X > 0), (0, True)), "Piecewise"),
        (sp.Function("lift")(X), "lift"),
        (X + sp.Mod(X, 2), "Mod"),
        (X + Y, "y"),
        (X + sp.I, "not real"),
    ],
)
def test_what_has_no_interval_form_is_named(expression, named):
    with pytest.raises(SystemDefinitionError, match=named):
        interval_function((X,), (expression,))


def test_functions_are_pickled_and_copied():
    function = interval_function((X,), [sp.sqrt(X) + sp.sin(X) ** 2, 1 / sp.sqrt(X)])
    at = [Interval(np.array([0.5, 1.0]), np.array([0.6, 3.0]))]
    for other in (pickle.loads(pickle.dumps(function)), copy.deepcopy(function)):
        np.testing.assert_array_equal(other(at), function(at))
