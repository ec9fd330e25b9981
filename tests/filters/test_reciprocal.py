"""Reciprocal conditions: their closed forms, their box, and what they do outside C."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE
from safe_envs.wrappers import CBF, RCBF, SCBF, SRCBF, SafetyFilter

x, y, u, w = sp.symbols("x y u w", real=True)


def scalar(sigma):
    return ControlAffineSDE((x,), (u,), [x], [1], [sigma])


def upper_limits(condition, sigma, states, most=1e4):
    """Largest input that the filter allows on h = 1 - x, where the thesis has closed forms."""
    safety_filter = SafetyFilter(
        scalar(sigma), [(Barrier(1 - x), condition)], input_bounds=[(-most, most)]
    )
    return safety_filter.filter(states[:, None], np.full((len(states), 1), most)).action[:, 0]


def test_the_motivating_example_of_sec_4_2_2():
    states = np.linspace(-2.0, 0.99, 30)
    h = 1 - states
    np.testing.assert_allclose(upper_limits(RCBF(), 0.0, states), h**3 - states, rtol=1e-12)
    np.testing.assert_allclose(
        upper_limits(SRCBF(), 0.4, states), h**3 - states - 0.16 / h, rtol=1e-12
    )
    np.testing.assert_allclose(
        upper_limits(SRCBF(0.1), 0.4, states), 0.1 * h**3 - states - 0.16 / h, rtol=1e-12
    )
    np.testing.assert_allclose(upper_limits(SCBF(), 0.4, states), -states, rtol=1e-12)
    # The deterministic one needs bounded control at the edge, the stochastic one does not: it knows
    # no noise.
    np.testing.assert_allclose(upper_limits(RCBF(), 0.4, states), h**3 - states, rtol=1e-12)


def test_the_logarithmic_form():
    # B = -log(h/(1+h)), B' = -1/(h(1+h)), B'' = (1+2h)/(h(1+h))^2: A B <= gamma/B.
    states = np.linspace(-2.0, 0.99, 30)
    h = 1 - states
    b = -np.log(h / (1 + h))
    np.testing.assert_allclose(
        upper_limits(RCBF(0.5, "log"), 0.0, states), 0.5 * h * (1 + h) / b - states, rtol=1e-9
    )
    spread = 0.5 * 0.16 * (1 + 2 * h) / (h * (1 + h))
    np.testing.assert_allclose(
        upper_limits(SRCBF(0.5, "log"), 0.4, states),
        0.5 * h * (1 + h) / b - states - spread,
        rtol=1e-9,
    )


def test_control_of_the_stochastic_one_is_unbounded_near_the_edge_and_a_box_breaks_it():
    near = 1 - np.array([1e-3, 1e-4, 1e-6])
    asked = upper_limits(SRCBF(), 0.4, near, most=1e9)
    np.testing.assert_allclose(asked * (1 - near), -0.16, rtol=1e-2)
    safety_filter = SafetyFilter(
        scalar(0.4), [(Barrier(1 - x), SRCBF())], input_bounds=[(-10.0, 10.0)]
    )
    result = safety_filter.filter(near[:, None], np.zeros((3, 1)))
    assert result.feasible.tolist() == [False] * 3
    np.testing.assert_allclose(result.action, -10.0)
    np.testing.assert_allclose(result.slack[:, 0], 0.16 / (1 - near) - 10 + near, rtol=1e-6)


@pytest.mark.parametrize("condition", [RCBF(), SRCBF(), RCBF(form="log"), SRCBF(0.1, "log")])
@pytest.mark.parametrize("state", [1.0, 1.0 + 1e-13, 1.5, 40.0])
def test_outside_the_action_raises_h_most_and_is_flagged(condition, state):
    safety_filter = SafetyFilter(
        scalar(0.4), [(Barrier(1 - x), condition)], input_bounds=[(-3.0, 4.0)]
    )
    for result in (
        safety_filter.filter([state], [2.0]),
        safety_filter.filter([[state], [0.0]], [[2.0], [0.1]]),
    ):
        first = [np.asarray(part).reshape(-1)[0] for part in result]
        action, margin, active, feasible, slack, cause, _, barrier = first
        assert action == -3.0
        assert not feasible
        assert active
        assert cause == 0
        assert barrier == pytest.approx(1 - state, abs=1e-12)
        assert margin == pytest.approx(3.0 - state)  # A h at the action
        assert slack == pytest.approx(max(0.0, state - 3.0))
    assert result.feasible.tolist() == [False, True]


def test_outside_with_several_inputs_and_flat_ones():
    plane = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 0]], [sp.Rational(1, 5), 0])
    safety_filter = SafetyFilter(
        plane, [(Barrier(1 - x), SRCBF())], input_bounds=[(-3.0, 4.0), (-2.0, 2.0)]
    )
    for state, nominal in (([1.2, 0.0], [1.0, 0.7]), ([[1.2, 0.0]], [[1.0, 0.7]])):
        result = safety_filter.filter(np.array(state), np.array(nominal))
        np.testing.assert_allclose(np.ravel(result.action), [-3.0, 0.7])
        assert not np.any(result.feasible)


def test_beside_another_barrier():
    # Outside the first, which asks for all it can get; the second one still has its say, by least
    # squares.
    rows = [(Barrier(1 - x), RCBF()), (Barrier(x + 3), CBF(1.0))]
    safety_filter = SafetyFilter(scalar(0.0), rows, input_bounds=[(-3.0, 3.0)])
    inside = safety_filter.filter([0.5], [3.0])
    np.testing.assert_allclose(inside.action, [0.125 - 0.5], atol=1e-9)
    assert inside.feasible
    outside = safety_filter.filter([1.5], [3.0])
    np.testing.assert_allclose(outside.action, [-3.0], atol=1e-6)
    assert not outside.feasible
    assert outside.cause == 0
