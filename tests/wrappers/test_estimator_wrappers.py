"""State estimators over envs, and filters at their estimates."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers import (
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    StateEstimatorVectorWrapper,
    StateEstimatorWrapper,
)
from tests.wrappers.cases import CASES, DUBINS, PENDULUM

SENSOR = {"measurement": ["default:dropout=0.2", "delay=1"], "horizon": 1.0}


def measured(env_id=PENDULUM):
    return gym.make(env_id, **SENSOR)


def test_the_truth_is_what_it_is_without_an_estimator():
    bare = gym.make(DUBINS, horizon=1.0)
    estimated = StateEstimatorWrapper(measured(DUBINS))
    _, expected = bare.reset(seed=2)
    _, info = estimated.reset(seed=2)
    for _ in range(20):
        for key in expected:
            np.testing.assert_array_equal(info[key], expected[key])
        _, reward, *ends, expected = bare.step([0.7])
        _, other, *others, info = estimated.step([0.7])
        assert (reward, ends) == (other, others)


def test_observed_estimates_have_the_space_of_the_env_without_a_sensor():
    env, raw = CASES["estimates"](), CASES["measurements"]()
    bare = gym.make(PENDULUM)
    assert env.observation_space == bare.observation_space
    seen, info = env.reset(seed=0)
    expected, _ = bare.reset(options={"state": info["estimate"]})
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
    assert raw.observation_space == raw.unwrapped.observation_space


def test_an_estimator_of_a_filter_is_one_below_it():
    above, below = (
        SafetyFilterWrapper(measured(), "scbf:belief=0.1", estimator="ukf:alpha=.5"),
        SafetyFilterWrapper(
            StateEstimatorWrapper(measured(), "ukf:alpha=.5", "measurement"),
            "scbf:belief=0.1",
        ),
    )
    for env in (above, below):
        env.reset(seed=3)
    for _ in range(5):
        (seen, *_, a), (other, *_, b) = above.step([0.5]), below.step([0.5])
        np.testing.assert_array_equal(seen, other)
        for key in ("safe_action", "estimate", "belief_barrier"):
            np.testing.assert_array_equal(a[key], b[key])


def test_the_estimator_does_not_know_of_states_that_are_set():
    env = StateEstimatorWrapper(gym.make(DUBINS, measurement="default"))
    _, info = env.reset(seed=0, options={"state": [1.0, 0.5, 0.3]})
    assert not np.allclose(info["estimate"], [1.0, 0.5, 0.3], atol=1e-6)
    env.unwrapped.state = [0.0, -1.0, 0.3]
    *_, info = env.step([0.0])
    assert info["nees"] > 20.0


def test_filters_by_themselves_act_at_estimates():
    inner = gym.make("safe_envs/DubinsDisk-v0", measurement="default", model={"v": 0.8})
    env = SafetyFilterWrapper(inner, "backup", estimator="ekf")
    env.reset(seed=0)
    *_, info = env.step([0.3])
    assert {"estimate", "feasible"} <= set(info)


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: SafetyFilterWrapper(measured(), "scbf"), "estimator="),
        (
            lambda: SafetyFilterVectorWrapper(gym.make_vec(DUBINS, 2, **SENSOR), "scbf"),
            "estimator=",
        ),
        (lambda: SafetyFilterWrapper(gym.make(DUBINS), "scbf", estimator="ekf"), "estimate"),
        (lambda: SafetyFilterWrapper(gym.make(PENDULUM), "scbf:belief=.1"), "belief"),
        (lambda: StateEstimatorWrapper(measured(), "ekf", "all"), "observe"),
        (lambda: StateEstimatorWrapper(measured(), knowledge="god"), "knowledge"),
        (lambda: StateEstimatorWrapper(gym.make(PENDULUM, delay=2, **SENSOR)), "delay"),
        (lambda: StateEstimatorVectorWrapper(measured()), "StateEstimatorWrapper"),
        (lambda: StateEstimatorWrapper(gym.make("Pendulum-v1")), "measurement"),
    ],
)
def test_what_cannot_be_is_refused(make, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make()
