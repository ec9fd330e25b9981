"""Constraints: what they measure, the multiplier against closed forms, and what meets a limit."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import make_sb3_env
from safe_envs.agents.training.constraint import (
    COST,
    VIOLATION,
    EpisodeConstraint,
    PIDMultiplier,
    costs_of,
    judged,
    rank,
)
from safe_envs.errors import NumericalError

GAINS = {"kp": 1.0, "ki": 0.5, "kd": 0.0}


def constraint(limit=0.5, num_envs=2, **changes):
    return EpisodeConstraint(limit, num_envs, gains=GAINS, **changes)


def observe(one, costs, dones):
    one.observe(np.array(costs, dtype=float), np.array(dones, dtype=bool))


def test_the_cost_is_that_of_whole_episodes_of_all_envs():
    one = constraint()
    observe(one, [1.0, 0.0], [False, False])
    observe(one, [1.0, 0.0], [True, False])
    # One env has ended no episode.
    assert not one.update()
    assert (one.episode_cost, one.value) == (None, 0.0)
    observe(one, [0.0, 1.0], [True, False])
    observe(one, [0.0, 0.0], [False, True])
    assert one.update()
    # Episodes of costs 2, 0 and 1.
    assert one.episode_cost == pytest.approx(1.0)
    assert one.violation_rate == pytest.approx(2 / 3)
    assert one.recent == [[3.0, 3.0, 5.0, 2.0]]
    assert one.value == pytest.approx(1.5 * 0.5)
    # The next measurement needs new episodes.
    assert not one.update()


def test_episodes_that_a_violation_cuts_short_do_not_bias_it():
    """A third of the episodes violate, at once; the others take ten steps."""
    rng = np.random.default_rng(0)
    one, found = constraint(num_envs=64), []
    ages, bad = np.zeros(64), rng.random(64) < 1 / 3
    for _ in range(4000):
        ages += 1
        dones = bad | (ages == 10)
        one.observe(bad.astype(float), dones)
        if one.update():
            found.append(one.episode_cost)
        ages[dones] = 0
        bad[dones] = rng.random(dones.sum()) < 1 / 3
    assert np.mean(found) == pytest.approx(1 / 3, abs=0.02)


@pytest.mark.parametrize(
    ("limit", "unit", "cost", "value"), [(0.01, 0.1, 1.0, 1.5), (20.0, 1.0, 30.0, 1.5 * 10 / 20)]
)
def test_the_excess_is_in_units_and_at_most_one(limit, unit, cost, value):
    one = constraint(limit=limit, num_envs=1, unit=unit)
    observe(one, [cost], [True])
    one.update()
    assert one.value == pytest.approx(value)


def test_a_reset_forgets_the_episodes_that_go_on_and_enough_of_the_last_are_kept():
    one = constraint(num_envs=1)
    observe(one, [1.0], [False])
    one.begin_episodes()
    observe(one, [0.0], [True])
    one.update()
    assert one.episode_cost == 0.0
    one = constraint(num_envs=40)
    for _ in range(10):
        one.observe(np.ones(40), np.ones(40, dtype=bool))
        one.update()
    assert [each[0] for each in one.recent] == [40.0] * 3


def test_restored_ones_go_on_alike():
    rng = np.random.default_rng(3)
    one, other = constraint(num_envs=3), constraint(num_envs=3)

    def steps(*some):
        for _ in range(30):
            costs, dones = rng.random(3).round(), rng.random(3) < 0.3
            for each in some:
                each.observe(costs, dones)
                each.update()

    steps(one)
    other.restore(json.loads(json.dumps(one.state())))
    steps(one, other)
    assert (other.state(), other.figures()) == (one.state(), one.figures())
    one, other = (PIDMultiplier(0.3, 0.7, 0.2, 0.5, smoothing=0.9) for _ in range(2))
    for cost in rng.random(20):
        one.update(cost)
    other.restore(json.loads(json.dumps(one.state())))
    assert [one.update(c) for c in (0.1, 0.9)] == [other.update(c) for c in (0.1, 0.9)]


@pytest.mark.parametrize(
    ("one", "changes"),
    [
        *(
            (constraint(), changes)
            for changes in (
                {"running": [0.0]},
                {"recent": [[1.0]]},
                {"cost": [float("nan"), 0.0]},
                {"multiplier": None},
                {"more": 1},
            )
        ),
        *(
            (PIDMultiplier(0.3, 1.0, 1.0, 1.0), changes)
            for changes in (
                {"integral": -1.0},
                {"value": math.nan},
                {"value": 1e9},
                {"extra": 0.0},
            )
        ),
    ],
)
def test_another_state_is_refused(one, changes):
    with pytest.raises(ValueError, match=r"constraint|multiplier"):
        one.restore(one.state() | changes)


def test_costs_are_those_of_any_infos_and_that_a_wrapper_wrote():
    env = make_sb3_env("Scalar-v0", 3, start=(2.0,), horizon=0.2)
    env.reset()
    lazy = env.step(np.zeros((3, 1)))[3]
    for infos in (lazy, [info.copy() for info in lazy], [lazy[0], {"cost": 1}, {"cost": True}]):
        np.testing.assert_array_equal(costs_of(infos), [1.0, 1.0, 1.0])
    lazy[1]["cost"] = 3.0
    assert costs_of(lazy).tolist() == [1.0, 3.0, 1.0]


def test_the_costs_of_a_step_are_those_of_all_its_control_periods():
    """As where actions are repeated: the info is that of the last period."""

    def info(cost, total):
        return {"cost": cost, "violation": cost == 1.0, "episode_cost": total}

    one, costs = constraint(num_envs=2), []
    for infos, dones in (
        ([info(0.0, 2.0), info(0.0, 0.0)], [False, False]),
        ([info(1.0, 5.0), info(1.0, 1.0)], [True, False]),
        ([info(0.0, 3.0), {**info(0.0, 4.0), "cost": 0.5}], [False, False]),
        ([info(0.0, 3.0), info(1.0, 7.0)], [False, False]),
    ):
        costs.append(one.measure(infos, np.array(dones)).tolist())
    # Another one's cost counts as it is.
    assert costs == [[2.0, 0.0], [3.0, 1.0], [3.0, 0.5], [0.0, 3.0]]
    again = constraint(num_envs=2)
    again.restore(one.state())
    infos = [info(1.0, 9.0), info(0.0, 8.0)]
    # In the midst of episodes, whose costs so far are not known.
    assert again.measure(infos, np.array([False, False])).tolist() == [1.0, 0.0]
    one.begin_episodes()
    assert one.measure(infos, np.array([False, False])).tolist() == [9.0, 8.0]


NO_COSTS = ([1.0], np.array([1.0, 2.0]), "much", -1.0, float("nan"), float("inf"))


@pytest.mark.parametrize(
    "infos", [[{}], [{"cost": 1.0}, {}], *([{"cost": c}] * n for c in NO_COSTS for n in (1, 2))]
)
def test_infos_without_one_finite_cost_are_refused(infos):
    with pytest.raises(ConfigurationError, match="cost"):
        costs_of(infos)


PID = {"limit": 0.1, "kp": 1.0, "ki": 1.0, "kd": 1.0}


@pytest.mark.parametrize(
    ("name", "number", "make"),
    [
        ("limit", -1.0, constraint),
        ("unit", 0.0, lambda unit: constraint(0.0, unit=unit)),
        *(
            (name, number, lambda **changes: PIDMultiplier(**PID | changes))
            for name, number in (
                ("limit", -0.1),
                ("kp", math.inf),
                ("kd", True),
                ("smoothing", 1.0),
                ("most", 0.0),
            )
        ),
    ],
)
def test_arguments_out_of_range_are_refused(name, number, make):
    with pytest.raises(ConfigurationError, match=name):
        make(**{name: number})


def updated(multiplier, costs):
    return [multiplier.update(cost) for cost in costs]


def test_a_constant_excess_raises_the_multiplier_linearly():
    # k_p e + k_i e t, and nothing of k_d: the cost does not rise.
    found = updated(PIDMultiplier(0.2, kp=3.0, ki=0.5, kd=7.0), [0.6] * 20)
    np.testing.assert_allclose(found, 3.0 * 0.4 + 0.5 * 0.4 * np.arange(1, 21), rtol=1e-12)


def test_the_derivative_acts_on_rises_alone_and_smoothing_is_an_exponential_mean():
    multiplier = PIDMultiplier(0.0, 0.0, 0.0, kd=2.0)
    assert updated(multiplier, (5.0, 6.0, 4.0, 4.5)) == [0.0, 2.0, 0.0, 1.0]
    found = updated(PIDMultiplier(0.0, kp=1.0, ki=0.0, kd=0.0, smoothing=0.8), [1.0] + [0.0] * 10)
    np.testing.assert_allclose(found[1:], 0.8 ** np.arange(1, 11), rtol=1e-12)


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


def test_the_multiplier_is_never_negative_and_never_above_its_most():
    multiplier = PIDMultiplier(0.5, 2.0, 1.0, 1.0, most=7.0)
    rng = np.random.default_rng(1)
    found = updated(multiplier, [*rng.normal(0.0, 1e3, 500), *[1e300] * 3, *[0.0] * 40])
    assert min(found) == 0.0
    assert max(found) == 7.0
    assert set(updated(PIDMultiplier(0.0, 0.0, 0.0, 0.0), (1.0, 1e9, 3.0))) == {0.0}
    # The integral stops at the most, so that it falls at once.
    multiplier = PIDMultiplier(1.0, 0.0, 1.0, 0.0, most=5.0)
    updated(multiplier, [2.0] * 1000)
    assert multiplier.saturated
    assert multiplier.update(0.0) == 4.0
    assert not multiplier.saturated


def test_a_limit_of_zero_gives_numbers_and_a_cost_that_is_none_is_an_error():
    multiplier = PIDMultiplier(0.0, 1.0, 1.0, 1.0)
    assert updated(multiplier, [0.0] * 5) == [0.0] * 5
    assert multiplier.update(1.0) > 0.0
    with pytest.raises(NumericalError, match="nan"):
        multiplier.update(math.nan)


def measured(limit, costs, unit=1.0):
    """A constraint that measured these costs of one episode each."""
    one = EpisodeConstraint(limit, 1, unit=unit, gains={"kp": 1.0, "ki": 1.0, "kd": 0.0})
    for cost in costs:
        observe(one, [cost], [True])
        one.update()
    return one


def row(ci_low=0.9, ci_high=1.0, return_mean=1.0, **more):
    return {"ci_low": ci_low, "ci_high": ci_high, "return_mean": return_mean, **more}


MANY = [0, 1] * 50


@pytest.mark.parametrize(
    ("limit", "costs", "kind", "rates", "met", "evaluation_met"),
    [
        (0.1, [0] * 99 + [1], VIOLATION, (0.9, 1.0), True, True),
        # In training too many, with certainty; the evaluation is judged for itself.
        (0.1, MANY, VIOLATION, (0.9, 1.0), False, True),
        (0.1, MANY, VIOLATION, (0.6, 0.8), False, False),
        # Only in the evaluation: 1 - 0.8 is above 0.1.
        (0.1, [0] * 100, VIOLATION, (0.6, 0.8), False, False),
        (0.1, MANY, COST, (0.9, 1.0), False, None),
        (0.0, [0] * 100, COST, (0.9, 1.0), True, None),
        # Nothing measured is no judgement, unless the evaluation says enough.
        (0.1, [], VIOLATION, (0.9, 1.0), None, True),
        (0.1, [], VIOLATION, (0.0, 0.1), False, False),
        (0.1, [], COST, (0.0, 0.1), None, None),
    ],
)
def test_limits_are_judged_in_training_and_after_it(limit, costs, kind, rates, met, evaluation_met):
    found = judged(measured(limit, costs), kind, row(*rates))
    assert (found["met"], found["evaluation_met"]) == (met, evaluation_met)
    assert found["episodes"] == len(costs)
    assert found["mean"] == (pytest.approx(np.mean(costs)) if costs else None)
    if costs == MANY:
        assert found["low"] < 0.5 < found["high"]
    json.dumps(found, allow_nan=False)


def test_costs_are_judged_by_the_interval_of_their_mean():
    costs = np.random.default_rng(0).poisson(3.0, 100)
    found = judged(measured(3.5, costs), COST, row(0.0, 0.0))
    assert found["mean"] == pytest.approx(costs.mean())
    assert found["high"] - found["mean"] == pytest.approx(1.96 * costs.std(ddof=1) / 10)
    assert found["met"] is True
    assert judged(measured(2.0, costs), COST, row())["met"] is False


def test_the_best_keeps_its_limit_first():
    kept = row(return_mean=1.0, constraint={"met": True})
    exceeded = row(return_mean=9.0, constraint={"met": False})
    assert rank(kept) > rank(exceeded)
    assert rank(row(return_mean=2.0)) > rank(kept)
    without_exploration = {"met": False, "evaluation_met": True}
    assert rank(row(constraint=without_exploration, return_mean=0.5)) > rank(exceeded)
