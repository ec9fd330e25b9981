"""Envs execute what was sent a while ago, at limited rates, and say so."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import ConfigurationError, SafeEnv, SafeVectorEnv
from safe_envs.envs.episode import DelayLine
from tests.conftest import problem_of

PENDULUM = "safe_envs/Pendulum-v0"


def trajectory(problem, actions, seed=3):
    env = SafeEnv(problem)
    env.reset(seed=seed)
    found = [env.state]
    for action in actions:
        env.step(action)
        found.append(env.state)
    return np.array(found)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("delay", [1, 4])
def test_a_delayed_env_is_one_under_shifted_inputs_to_the_last_bit(noise, delay):
    problem = problem_of(PENDULUM, noise=noise)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 1))
    shifted = np.concatenate([np.zeros((delay, 1)), actions[:-delay]])
    late = trajectory(problem.configured(delay=delay), actions)
    np.testing.assert_array_equal(late, trajectory(problem, shifted))
    assert not np.array_equal(late, trajectory(problem, actions))


def test_no_delay_is_the_env_without_the_option():
    assert SafeEnv(problem_of(PENDULUM, delay=0)).problem == problem_of(PENDULUM)


def test_the_resting_input_is_within_the_bounds_nearest_to_zero():
    env = SafeEnv(problem_of(PENDULUM, input_bounds=(1.0, 4.0), delay=2))
    _, info = env.reset(seed=0)
    assert (info["sent_action"], info["executed_action"]) == ([1.0], [1.0])
    executed = [env.step([1.0])[4]["executed_action"].item() for _ in range(4)]
    assert executed == [1.0, 1.0, 4.0, 4.0]


@pytest.mark.parametrize("num_envs", [None, 2])
def test_inputs_and_rates_stay_within_their_bounds(num_envs):
    """And go as far as the rate allows."""
    problem = problem_of(PENDULUM, delay=2, slew_limit=(-30.0, 70.0))
    env = SafeEnv(problem) if num_envs is None else SafeVectorEnv(problem, num_envs)
    (low, high), rng = problem.input_bounds[0], np.random.default_rng(0)
    down, up = -30.0 * problem.dt, 70.0 * problem.dt
    for seed in range(5):
        env.reset(seed=seed)
        sent, last = [np.zeros(env.action_space.shape)] * 2, np.zeros(env.action_space.shape)
        for k in range(100):
            given = rng.uniform(-1.0, 1.0, last.shape) if k % 20 < 10 else np.sign(last)
            *_, terminated, truncated, info = env.step(given)
            wanted, now = sent.pop(0), info["executed_action"]
            sent.append(info["sent_action"])
            expected = np.clip(wanted, np.maximum(low, last + down), np.minimum(high, last + up))
            np.testing.assert_allclose(now, expected, rtol=0, atol=1e-13)
            assert ((low <= now) & (now <= high)).all()
            if np.any(terminated | truncated):
                break
            last = now
        assert k > 20


def test_what_is_under_way_is_nobody_elses_array():
    line, given = DelayLine(2, (0.0,), num_envs=3), np.ones(3)
    line.exchange((given,))
    given[:] = 9.0
    np.testing.assert_array_equal(line.under_way[-1], [np.ones(3)])


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        ({"delay": -1}, "delay = -1"),
        ({"delay": 1.5}, "delay = 1.5"),
        ({"delay": 10**6}, "1000"),
        ({"model_delay": True}, "model_delay = True"),
        ({"slew_limit": (1.0, 2.0)}, "slew_limit"),
        ({"slew_limit": "fast"}, "'fast'"),
        ({"rate_limit": (-1.0, float("nan"))}, "rate_limit"),
        ({"rate_limit": [(-1, 1), (-1, 1)]}, "1 inputs"),
    ],
)
def test_other_values_are_refused(options, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        problem_of(PENDULUM, **options)
