"""Formulas that are zero everywhere are told from those that are zero in places only."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import ControlAffineSDE, RelativeDegreeError, define_problem
from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.lie import relative_degree, vanishes

x, y, u, sigma = sp.symbols("x y u sigma", real=True)

ZERO = {
    "squares": sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1,
    "hyperbolic": sp.cosh(x * y) ** 2 - sp.sinh(x * y) ** 2 - 1,
    "saturated": (1 - sp.tanh(1000 * x)) * (1 + sp.tanh(1000 * x)) - sp.sech(1000 * x) ** 2,
    "maximum and minimum": sp.Max(x, y) + sp.Min(x, y) - x - y,
    "size": sp.Max(x, -x) - sp.Abs(x),
    "size by pieces": sp.Piecewise((x, x > 0), (-x, True)) - sp.Abs(x),
    "step": sp.Heaviside(x - 300) + sp.Heaviside(300 - x) - 1,
    "pieces": sp.Piecewise(
        (0, sp.Or(x < 500, x > 600)), (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, True)
    ),
    "conditions": sp.Piecewise((1, sp.And(x > 1, sp.Not(y > 1))), (0, True))
    - sp.Heaviside(x - 1) * sp.Heaviside(1 - y),
    "a product of roots": (sp.sqrt(x**2 + y**2) - 1) * (sp.sqrt(x**2 + y**2) + 1) - x**2 - y**2 + 1,
    "floats": (0.1 * x + 0.2) ** 2 - 0.01 * x**2 - 0.04 * x - 0.04,
    "with an unknown function": (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1)
    * sp.log(1 + x**2)
    * sp.floor(x),
}  # fmt: skip

NOT_ZERO = {
    "beyond 2": sp.Max(x - 2, 0),
    "beyond a million": sp.Max(x - 10**6, 0) ** 2,
    "below": sp.Min(x + 1000, 0),
    "a piece far away": sp.Piecewise((0, x < 5000), (1, True)),
    "a hidden kink": sp.sqrt(2 - 2 * sp.cos(x)) - 2 * sp.sin(x / 2),
    "a hidden kink far away": sp.sqrt(x**2 - 2 * 10**4 * x + 10**8) + x - 10**4,
    "another branch": sp.atan(1 / x) + sp.atan(x) - sp.pi / 2,
    "sawtooth": sp.asin(sp.sin(x)) - x,
    "a saturated switch far away": 1 + sp.tanh(10**6 * (x - 5)),
    "a saturated integral far away": 1 + sp.erf(10**3 * (x - 5)),
    "a high power": (1 + (x / 5) ** 2000) ** 2 - 1,
    "a rounded corner far away": sp.sqrt((x - 5) ** 2 + sp.Rational(1, 10**300)) + x - 5,
    "a logistic switch": 1 / (1 + sp.exp(10**3 * (x - 5))) - 1,
    "tiny": sp.exp(-1000 * (2 + sp.cos(x))),
    "floor": sp.floor(x / 10**6),
    "impulse": sp.DiracDelta(x - 7),
    "unknown": sp.Function("f")(x).diff(x),
}


@pytest.mark.parametrize(
    ("expression", "zero"),
    [
        *(pytest.param(e, True, id=name) for name, e in ZERO.items()),
        *(pytest.param(e, False, id=name) for name, e in NOT_ZERO.items()),
    ],
)
def test_what_is_zero_in_places_only_is_not_zero(expression, zero):
    assert is_zero(expression) == zero


KINKS = st.lists(
    st.tuples(st.integers(-50, 50), st.integers(-9, 9)),
    min_size=1,
    max_size=4,
    unique_by=lambda kink: kink[0],
)


@given(KINKS, st.booleans())
@settings(max_examples=20)
def test_a_piecewise_linear_function_is_zero_where_its_values_are(kinks, differently):
    """Write sum c max(x - k, 0) again by sizes; values at the kinks and between tell whether both
    are the same."""
    written = sum(c * sp.Max(x - k, 0) for k, c in kinks)
    again = sum(
        sp.Rational(c, 2) * (x - k + sp.Abs(x - k)) for k, c in kinks[1 if differently else 0 :]
    )
    at = [-1000, 1000, *[k + d for k, _ in kinks for d in (-1, 0, 1)]]
    same = all((written - again).subs(x, value) == 0 for value in at)
    assert is_zero(written - again) == same


def noisy(diffusion, gain=1):
    return ControlAffineSDE((x, y), (u,), [0, 0], [gain, 1], [diffusion, 0], {sigma: 0.3})


def test_noise_in_a_part_of_the_workspace_reaches_a_barrier():
    start = {"input_bounds": (-1, 1), "start": [0.0, 0.0], "dt": 0.1, "horizon": 1.0}
    for diffusion in (
        sp.Max(x - 2, 0),
        sp.Piecewise((0, x < 50), (sigma, True)),
        sigma * sp.Heaviside(-x - 1),
    ):
        bridge = BrownianBridge(define_problem(noisy(diffusion), [5 - x, 5 - y], **start))
        assert bridge.reached == (True, False)
    bridge = BrownianBridge(define_problem(noisy(sp.Max(x - 2, 0)), 5 - x, **start))
    states, ends = (np.array([1.0, 3.0]), np.zeros(2)), np.array([[0.2], [0.2]])
    # With h = 0.2 at both ends and E = 1 the smallest h is (0.4 - sqrt(2 s^2 dt))/2, s = max(x - 2,
    # 0).
    expected = [0.2, 0.5 * (0.4 - math.sqrt(2 * 0.1))]
    found = bridge.sample_minimum(states, ends, ends, np.ones((2, 1)))[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_input_that_counts_in_a_part_of_the_workspace_counts():
    for gain in (
        sp.Max(x - 2, 0),
        sp.Piecewise((0, x < 50), (1, True)),
        sp.sqrt(2 - 2 * sp.cos(x)) - 2 * sp.sin(x / 2),
    ):
        assert relative_degree(noisy(0, gain), 5 - x) == 1
    with pytest.raises(RelativeDegreeError):
        relative_degree(noisy(0, sp.Max(x, 0) + sp.Min(x, 0) - x), 5 - x)


def test_parameters_count_with_their_decimal_values():
    assert vanishes(noisy(sigma), sigma * x - sp.Rational(3, 10) * x)
    assert not vanishes(noisy(sigma), sigma * x - sp.Rational(1, 3) * x)
