"""Functions by pieces: minima and maxima apart, kinks and jumps, and states without a value."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs.dynamics.defined import BarrierFunction, may_lack_value
from safe_envs.dynamics.kinks import edges
from safe_envs.dynamics.lie import slope
from safe_envs.dynamics.min_max import clauses

x, y, z = sp.symbols("x y z", real=True)

LINES = st.sampled_from([x, y, z, 1 - x, x + y - 2, x * y, x**2 - z, sp.Integer(1), sp.Integer(-2)])
NESTED = st.recursive(
    LINES,
    lambda parts: (
        st.builds(sp.Min, parts, parts)
        | st.builds(sp.Max, parts, parts)
        | st.builds(sp.Abs, parts)
        | st.builds(lambda a, b: a - 2 * b, parts, parts)
        | st.builds(lambda a: (1 + x**2) * a, parts)
    ),
    max_leaves=4,
)


@given(NESTED)
@settings(max_examples=60)
def test_clauses_have_the_sign_of_the_function(h):
    found = clauses(sp.sympify(h))
    read = sp.lambdify((x, y, z), [h, found], "math")
    for at in np.random.default_rng(0).normal(scale=2.0, size=(6, 3)).tolist():
        value, values = read(*at)
        assert (min(map(max, values)) >= 0.0) == (value >= 0.0)


WHOLE = (
    1 - x**2,
    x * sp.Abs(y),
    sp.Min(x, y) ** 3,
    sp.Piecewise((1 - x, x > 0), (2 + x, True)),
    sp.Max(x, 2),
    sum(-sp.Abs(s) for s in sp.symbols("a:7", real=True)),
)


@pytest.mark.parametrize(
    ("h", "expected"),
    [
        (1 - sp.Max(x, y), [{1 - x}, {1 - y}]),
        (1 - x - sp.Abs(y), [{1 - x - y}, {1 - x + y}]),
        (sp.Min(sp.Max(x, y), z), [{x, y}, {z}]),
        (sp.Max(sp.Min(x, y), z), [{x, z}, {y, z}]),
        (sp.Min(1 - x**2, 5), [{1 - x**2}]),
        (sp.Min(x, 0), [{x}]),
        (sp.Piecewise((x, x >= 0), (-x, True)), [{x, -x}]),
        (1 - sp.Piecewise((x, x > y), (y, True)), [{1 - x}, {1 - y}]),
        (1 - sp.Max(x, 0) ** 2 - sp.Abs(y), [{1 - sp.Max(x, 0) ** 2 - s * y} for s in (1, -1)]),
        *((h, [{h}]) for h in WHOLE),
    ],
)
def test_minima_and_maxima_are_taken_apart(h, expected):
    found = [set(clause) for clause in clauses(h)]
    assert all(clause in found for clause in expected)
    assert len(found) == len(expected)


STEP = sp.Heaviside(x)
HUBER = sp.Piecewise(
    ((x**2 + y**2) / 2, x**2 + y**2 < 1), (sp.sqrt(x**2 + y**2) - sp.Rational(1, 2), True)
)


@pytest.mark.parametrize(
    ("expression", "smooth"),
    [
        (z + STEP / 2, -1),
        (sp.Piecewise((1 - x, x > 0), (2 + x, True)), -1),
        (sp.Piecewise((1 - x, x > 0)), -1),
        (sp.Piecewise((1, sp.Eq(x, 0)), (sp.sin(x) / x, True)), -1),
        (sp.Max(STEP, y), -1),
        (sp.Piecewise((1, sp.Xor(x > 0, y > 0)), (0, True)), -1),
        (sp.floor(x) * y, -1),
        (sp.log(1 + sp.Abs(x)), 0),
        (STEP * x, 0),
        (sp.Max(sp.Max(x, y), z), 0),
        (sp.Piecewise((-1, x < -1), (1, x > 1), (x, True)), 0),
        (sp.Piecewise((x * y, sp.And(x > 0, y > 0)), (0, True)), 0),
        (sp.Piecewise((x**2 * y**2, sp.And(x > 0, y > 0)), (0, True)), 1),
        (1 - sp.Max(x, 0) ** 2 - sp.Max(y, 0) ** 2, 1),
        (sp.Piecewise((1, x < 2), (1 - (x - 2) ** 4, x < 3), (12 - 4 * x, True)), 1),
        (HUBER, 1),
        ((1 - x**4 - y**2) * sp.Abs(1 - x**4 - y**2), 1),
        (sp.sin(x) * sp.Abs(sp.sin(x)), 1),
        (sp.Piecewise((sp.exp(x), x < 0), (1 + x + x**2 / 2, True)), 2),
        (sp.Abs(x) ** 3, 2),
        (sp.exp(x) * sp.sqrt(x**2 + y**2), 3),
    ],
)
def test_derivatives_are_continuous_up_to_an_order(expression, smooth):
    found = [not edges(expression, (x, y, z), order) for order in range(4)]
    assert found == [order <= smooth for order in range(4)]


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (sp.Mod(x, 2) * y, y),
        (sp.floor(x * y) * x, sp.floor(x * y)),
        (sp.frac(2 * x) + sp.ceiling(x), 2),
        (sp.Mod(3 * y, x), -sp.floor(3 * y / x)),
    ],
)
def test_steps_count_as_constant_between_them(expression, expected):
    assert sp.simplify(slope(expression, x) - expected) == 0


@pytest.mark.parametrize(
    ("barrier", "without"),
    [
        (sp.sqrt(2 * (1 - x)) - y, (1.5, 0.0)),
        (sp.log(1 - x), (1.0, 0.0)),
        (sp.acos(x + y), (1.0, 0.5)),
        (1 / x - y, (0.0, 1.0)),
        ((1 - x) ** sp.Rational(3, 2), (2.0, 0.0)),
        (sp.exp(400 * x) - 1, (2.0, 0.0)),
    ],
)
def test_a_barrier_without_a_value_is_below_any_other(barrier, without):
    expressions = [1 - y, barrier]
    floats, arrays = (BarrierFunction((x, y), expressions, f) for f in ("floats", "arrays"))
    there = (0.25, 0.5)
    columns = [np.array(c) for c in zip(there, without, strict=True)]
    for found in (arrays(*columns), pickle.loads(pickle.dumps(arrays))(*columns)):
        assert found[1][0] == pytest.approx(float(barrier.subs({x: 0.25, y: 0.5})))
        assert found[1][1] == -math.inf
        np.testing.assert_array_equal(found[0], 1 - columns[1])
    assert floats(*there) == pytest.approx([c[0] for c in arrays(*columns)])
    assert floats(*without) == (1 - without[1], -math.inf)


@pytest.mark.parametrize(
    ("barrier", "may"),
    [
        (1 - x**2 - y**2, False),
        (sp.sqrt(x**2 + y**2 + 0.1) - sp.tanh(x) / (1 + y**2), False),
        (sp.Max(x, -y) * sp.exp(-x) + sp.Abs(sp.sin(x)) ** 3, False),
        (sp.sqrt(x**2 + y**2), False),
        (sp.sqrt(x) - y, True),
        (y + sp.log(1 + x**2), True),  # which is conservative
        (1 / (x**2 + y**2), True),
        (x**y, True),
        (sp.sqrt(sp.sqrt(x) ** 2 + 1), True),
        (sp.asin(x) + y, True),
    ],
)
def test_which_barriers_have_a_value_everywhere(barrier, may):
    assert may_lack_value(barrier) == may
