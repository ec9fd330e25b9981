"""The multiplier against closed forms: a constant excess, and loops with linear plants."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.training.constraint import PIDMultiplier
from safe_envs.errors import NumericalError


def test_a_constant_excess_raises_the_multiplier_linearly():
    multiplier = PIDMultiplier(0.2, kp=3.0, ki=0.5, kd=7.0)
    found = [multiplier.update(0.6) for _ in range(20)]
    # k_p e + k_i e t, and nothing of k_d: the cost does not rise.
    np.testing.assert_allclose(found, 3.0 * 0.4 + 0.5 * 0.4 * np.arange(1, 21), rtol=1e-12)


def test_gradient_ascent_is_the_case_without_p_and_d():
    rng = np.random.default_rng(0)
    multiplier, wanted = PIDMultiplier(0.3, 0.0, 0.1, 0.0), 0.0
    for cost in rng.random(200):
        wanted = max(wanted + 0.1 * (cost - 0.3), 0.0)
        assert multiplier.update(cost) == pytest.approx(wanted, abs=1e-12)


def test_the_derivative_acts_on_rises_alone_and_only_on_them():
    multiplier = PIDMultiplier(0.0, 0.0, 0.0, kd=2.0)
    assert [multiplier.update(cost) for cost in (5.0, 6.0, 4.0, 4.5)] == [0.0, 2.0, 0.0, 1.0]


def test_smoothing_is_an_exponential_mean_from_the_first_cost():
    multiplier = PIDMultiplier(0.0, kp=1.0, ki=0.0, kd=0.0, smoothing=0.8)
    multiplier.update(1.0)
    found = [multiplier.update(0.0) for _ in range(10)]
    np.testing.assert_allclose(found, 0.8 ** np.arange(1, 11), rtol=1e-12)


def test_a_static_plant_approaches_the_limit_geometrically():
    """J = c - g lambda under integral control: the excess shrinks by 1 - g k_i at each update."""
    multiplier, c, g = PIDMultiplier(0.5, 0.0, 0.3, 0.0), 4.0, 0.7
    costs = []
    for _ in range(60):
        costs.append(c - g * multiplier.value)
        multiplier.update(costs[-1])
    np.testing.assert_allclose(
        np.array(costs) - 0.5, 3.5 * (1.0 - 0.3 * 0.7) ** np.arange(60), atol=1e-12
    )


@pytest.mark.parametrize(("kp", "ki"), [(0.0, 0.05), (0.6, 0.05), (1.0, 0.3)])
def test_an_integrating_plant_answers_as_the_second_order_system_does(kp, ki):
    """J' = J - g lambda + w: the excess obeys a recurrence of order two with known roots.

    With a disturbance w that holds the multiplier above zero, the excess e and the integral I
    follow e' = e - g (k_p e + k_i I) + w, I' = I + e'. So the second difference of e obeys
    z^2 - (2 - g k_p - g k_i) z + (1 - g k_p) = 0, and I ends at w/(g k_i).
    """
    g, w, limit = 0.4, 1.0, 10.0
    multiplier = PIDMultiplier(limit, kp, ki, 0.0)
    cost, excess = limit + 0.5, []
    for _ in range(40):
        excess.append(cost - limit)
        cost += w - g * multiplier.update(cost)
    roots = np.roots([1.0, -(2.0 - g * kp - g * ki), 1.0 - g * kp])
    # e_t = sum of a_i z_i^t, with the coefficients from the first two values.
    first = 0.5 + w - g * (kp + ki) * 0.5
    a = np.linalg.solve(np.array([[1.0, 1.0], roots]), np.array([0.5, first]))
    wanted = (a[:, None] * roots[:, None] ** np.arange(40)).sum(axis=0).real
    np.testing.assert_allclose(excess, wanted, atol=1e-9)


def test_a_limit_of_zero_gives_numbers():
    multiplier = PIDMultiplier(0.0, 1.0, 1.0, 1.0)
    assert [multiplier.update(0.0) for _ in range(5)] == [0.0] * 5
    assert multiplier.update(1.0) > 0.0


def test_it_is_never_negative_and_never_above_its_most():
    multiplier = PIDMultiplier(0.5, 2.0, 1.0, 1.0, most=7.0)
    rng = np.random.default_rng(1)
    for cost in [*rng.normal(0.0, 1e3, 500), *[1e300] * 3, *[0.0] * 40]:
        assert 0.0 <= multiplier.update(cost) <= 7.0


def test_the_integral_stops_at_the_most_so_that_it_falls_at_once():
    multiplier = PIDMultiplier(1.0, 0.0, 1.0, 0.0, most=5.0)
    for _ in range(1000):
        multiplier.update(2.0)
    assert multiplier.saturated
    assert multiplier.update(0.0) == 4.0
    assert not multiplier.saturated


def test_gains_of_zero_keep_it_at_zero():
    multiplier = PIDMultiplier(0.0, 0.0, 0.0, 0.0)
    assert {multiplier.update(cost) for cost in (1.0, 1e9, 3.0)} == {0.0}


def test_a_restored_one_goes_on_alike():
    rng = np.random.default_rng(2)
    one, other = (PIDMultiplier(0.3, 0.7, 0.2, 0.5, smoothing=0.9) for _ in range(2))
    other.restore(json.loads(json.dumps(one.state())))
    for cost in rng.random(20):
        one.update(cost)
    other.restore(json.loads(json.dumps(one.state())))
    assert other.value == one.value
    assert [one.update(c) for c in (0.1, 0.9)] == [other.update(c) for c in (0.1, 0.9)]


@pytest.mark.parametrize(
    "changes",
    [
        {"integral": -1.0},
        {"integral": "much"},
        {"value": math.nan},
        {"value": 1e9},
        {"smoothed": True},
        {"extra": 0.0},
    ],
)
def test_another_state_is_refused(changes):
    multiplier = PIDMultiplier(0.3, 1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="multiplier"):
        multiplier.restore(multiplier.state() | changes)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("limit", -0.1),
        ("limit", math.nan),
        ("kp", math.inf),
        ("ki", "0.1"),
        ("kd", True),
        ("smoothing", 1.0),
        ("most", 0.0),
    ],
)
def test_arguments_out_of_range_are_refused(name, number):
    given = {"limit": 0.1, "kp": 1.0, "ki": 1.0, "kd": 1.0} | {name: number}
    with pytest.raises(ConfigurationError, match=name):
        PIDMultiplier(**given)


def test_a_cost_that_is_no_number_is_an_error():
    with pytest.raises(NumericalError, match="nan"):
        PIDMultiplier(0.1, 1.0, 1.0, 1.0).update(math.nan)
