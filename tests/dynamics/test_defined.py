"""Barriers at states where they have no value."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.defined import BarrierFunction, may_lack_value

x, y = sp.symbols("x y", real=True)


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
