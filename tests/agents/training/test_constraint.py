"""What a constraint measures: whole episodes of every env, so that short ones count no more."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.training.constraint import EpisodeConstraint, costs_of
from safe_envs.agents.training.vec_env import LazyInfo

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


def test_the_excess_is_in_units_and_at_most_one():
    one = constraint(limit=0.01, num_envs=1, unit=0.1)
    observe(one, [1.0], [True])
    one.update()
    assert one.value == pytest.approx(1.5)
    one = constraint(limit=20.0, num_envs=1)
    observe(one, [30.0], [True])
    one.update()
    assert one.value == pytest.approx(1.5 * 10 / 20)


def test_a_reset_forgets_the_episodes_that_go_on():
    one = constraint(num_envs=1)
    observe(one, [1.0], [False])
    one.begin_episodes()
    observe(one, [0.0], [True])
    one.update()
    assert one.episode_cost == 0.0


def test_enough_of_the_last_measurements_are_kept():
    one = constraint(num_envs=40)
    for _ in range(10):
        one.observe(np.ones(40), np.ones(40, dtype=bool))
        one.update()
    assert [each[0] for each in one.recent] == [40.0] * 3


def test_a_restored_one_goes_on_alike():
    rng = np.random.default_rng(3)
    one = constraint(num_envs=3)

    def steps(*some):
        for _ in range(30):
            costs, dones = rng.random(3).round(), rng.random(3) < 0.3
            for each in some:
                each.observe(costs, dones)
                each.update()

    steps(one)
    other = constraint(num_envs=3)
    other.restore(json.loads(json.dumps(one.state())))
    steps(one, other)
    assert other.state() == one.state()
    assert other.figures() == one.figures()


@pytest.mark.parametrize(
    "changes",
    [
        {"running": [0.0]},
        {"ended": [-1.0, 0.0]},
        {"measured": [1.0]},
        {"recent": [[1.0]]},
        {"cost": [float("nan"), 0.0]},
        {"multiplier": None},
        {"more": 1},
    ],
)
def test_another_state_is_refused(changes):
    one = constraint()
    with pytest.raises(ValueError, match=r"constraint|multiplier"):
        one.restore(one.state() | changes)


def test_costs_are_those_of_any_infos():
    batch = {"cost": np.array([0.0, 1.0, 1.0])}
    lazy = [LazyInfo(batch, i) for i in range(3)]
    plain = [{"cost": 0.0}, {"cost": 1}, {"cost": True}]
    for infos in (lazy, plain, [lazy[0], *plain[1:]]):
        np.testing.assert_array_equal(costs_of(infos), [0.0, 1.0, 1.0])


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


@pytest.mark.parametrize(
    ("infos", "message"),
    [
        ([{}], "no entry 'cost'"),
        ([LazyInfo({"h": np.zeros(1)}, 0)], "no entry 'cost'"),
        ([{"cost": 1.0}, {}], "no entry 'cost'"),
        ([{"cost": -1.0}], "from 0"),
        ([{"cost": float("nan")}], "from 0"),
    ],
)
def test_infos_without_costs_are_refused(infos, message):
    with pytest.raises(ConfigurationError, match=message):
        costs_of(infos)


@pytest.mark.parametrize(
    ("arguments", "message"), [({"limit": -1.0}, "limit"), ({"limit": 0.0, "unit": 0.0}, "unit")]
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        constraint(**arguments)


@pytest.mark.parametrize(
    "cost", [[1.0], np.array([1.0, 2.0]), "much", -1.0, float("nan"), float("inf")]
)
@pytest.mark.parametrize("count", [1, 2])
def test_costs_that_are_not_one_number_are_refused(cost, count):
    with pytest.raises(ConfigurationError, match="one finite number"):
        costs_of([{"cost": cost}] * count)


def test_costs_that_a_wrapper_wrote_count():
    batch = {"cost": np.zeros(2)}
    infos = [LazyInfo(batch, i) for i in range(2)]
    infos[1]["cost"] = 3.0
    assert costs_of(infos).tolist() == [0.0, 3.0]
    assert costs_of([info.copy() for info in infos]).tolist() == [0.0, 3.0]
