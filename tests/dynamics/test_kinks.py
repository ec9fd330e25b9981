"""Where functions by pieces are not smooth."""

from __future__ import annotations

import pytest
import sympy as sp

from safe_envs.dynamics.kinks import edges
from safe_envs.dynamics.lie import slope

x, y, v = sp.symbols("x y v", real=True)
STEP = sp.Heaviside(x)
HUBER = sp.Piecewise(
    ((x**2 + y**2) / 2, x**2 + y**2 < 1), (sp.sqrt(x**2 + y**2) - sp.Rational(1, 2), True)
)


@pytest.mark.parametrize(
    ("expression", "smooth"),
    [
        (v + STEP / 2, -1),
        (sp.Piecewise((1 - x, x > 0), (2 + x, True)), -1),
        (sp.Piecewise((1 - x, x > 0)), -1),
        (sp.Piecewise((1, sp.Eq(x, 0)), (sp.sin(x) / x, True)), -1),
        (sp.Max(STEP, y), -1),
        (sp.Piecewise((1, sp.Xor(x > 0, y > 0)), (0, True)), -1),
        (sp.floor(x) * y, -1),
        (sp.log(1 + sp.Abs(x)), 0),
        (STEP * x, 0),
        (sp.Max(sp.Max(x, y), v), 0),
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
    found = [not edges(expression, (x, y, v), order) for order in range(4)]
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
