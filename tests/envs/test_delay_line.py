"""Envs execute what was sent a while ago, at limited rates, and say so."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from safe_envs import ConfigurationError, SafeEnv, SafeVectorEnv
from safe_envs.envs.array_batch import ArrayBatch
from safe_envs.envs.episode import Actuators, DelayLine
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilterWrapper
from tests.conftest import problem_of
from tests.envs.test_vector_env import assert_same, only_where_present, pair

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
    env = SafeEnv(problem_of(PENDULUM, delay=0))
    assert env.problem == problem_of(PENDULUM)
    _, info = env.reset(seed=0)
    assert "sent_action" not in info


def test_the_resting_input_is_within_the_bounds_nearest_to_zero():
    env = SafeEnv(problem_of(PENDULUM, box=(1.0, 4.0), delay=2))
    _, info = env.reset(seed=0)
    assert (info["sent_action"], info["executed_action"]) == ([1.0], [1.0])
    executed = [env.step([1.0])[4]["executed_action"].item() for _ in range(4)]
    assert executed == [1.0, 1.0, 4.0, 4.0]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("env_id", [PENDULUM, "safe_envs/QuadrotorLimits-v0"])
def test_batches_equal_single_envs_and_autoreset_empties_the_line(env_id, mode, filtered):
    dt = problem_of(env_id).dt
    ours, theirs = pair(
        env_id, mode, filtered, 3, delay=3, slew_limit=(-30.0, 20.0), horizon=7 * dt
    )
    mine, other = (env.reset(seed=7) for env in (ours, theirs))
    assert_same(mine[0], other[0], "reset")
    assert_same(only_where_present(mine[1]), only_where_present(other[1]), "reset info")
    rng = np.random.default_rng(0)
    for step in range(18):
        actions = rng.uniform(-1.0, 1.0, ours.action_space.shape).astype(np.float32)
        *mine, my_info = ours.step(actions)
        *other, other_info = theirs.step(actions)
        for a, b in zip(mine, other, strict=True):
            assert_same(a, b, f"step {step}")
        assert_same(
            only_where_present(my_info), only_where_present(other_info), f"step {step}: info"
        )


@pytest.mark.parametrize("num_envs", [None, 2])
def test_inputs_and_rates_stay_within_their_bounds(num_envs):
    problem = problem_of(PENDULUM, delay=2, slew_limit=(-30.0, 70.0))
    actuators = Actuators(problem, num_envs)
    (low, high), rng = problem.box[0], np.random.default_rng(0)
    last = np.array(actuators.executed[0])
    for k in range(10_000):
        u = (rng.uniform(low, high, num_envs),)
        now = np.array(actuators.execute(u)[0])
        if k % 100 == 7:
            # As far as the rate goes, and no further.
            actuators.execute((u[0] * 0.0 + high,))
            actuators.execute((u[0] * 0.0 + high,))
            before = np.array(actuators.executed[0])
            now = np.array(actuators.execute(u)[0])
            np.testing.assert_array_equal(now, np.minimum(high, before + 0.01 * 70.0))
            last = before
        assert (now >= low).all()
        assert (now <= high).all()
        # To the rounding of a difference.
        assert (now - last <= 0.01 * 70.0 + 1e-14).all()
        assert (now - last >= -0.01 * 30.0 - 1e-14).all()
        last = now


def test_a_restored_batch_goes_on_with_the_inputs_under_way():
    problem = problem_of(PENDULUM, delay=3, slew_limit=(-100.0, 100.0))
    first, second = (SafeVectorEnv(problem, 2, max_episode_steps=9) for _ in range(2))
    first.reset(seed=5)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 2, 1))
    for k in range(4):
        first.step(actions[k])
    snapshot = first.snapshot()
    second.reset(seed=99)
    second.restore(snapshot, seed=5)
    for k in range(4, 12):
        mine, other = (env.step(actions[k]) for env in (first, second))
        for a, b in zip(mine[:4], other[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(mine[4]["executed_action"], other[4]["executed_action"])


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_a_line_is_copied_with_what_is_under_way(remake):
    line = DelayLine(2, (0.5,))
    line.exchange((1.0,))
    again = remake(line)
    assert [again.exchange((u,)) for u in (2.0, 3.0, 4.0)] == [(0.5,), (1.0,), (2.0,)]
    other = DelayLine(2, (0.0,))
    other.restore(line.snapshot())
    assert other.under_way == line.under_way


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copied_env_goes_on_with_what_is_under_way(remake):
    env = SafetyFilterWrapper(SafeEnv(problem_of(PENDULUM, delay=2)), "scbf")
    env.reset(seed=0)
    env.step([0.3])
    again = remake(env)
    for action in (0.5, -0.5, 0.1):
        mine, other = again.step([action])[4], env.step([action])[4]
        for key in ("executed_action", "safe_action", "barrier"):
            np.testing.assert_array_equal(mine[key], other[key])


def test_the_compiled_engine_leaves_delays_to_numpy():
    problem = problem_of(PENDULUM, delay=1)
    env = gym.make_vec(PENDULUM, num_envs=2, engine="auto", delay=1)
    assert isinstance(env.unwrapped._batch, ArrayBatch)
    with pytest.raises(NotCompilableError, match=r"delay 1.*engine 'numpy' alone"):
        SafeVectorEnv(problem, 2, engine="compiled")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delay": -1}, "delay = -1; give a whole number"),
        ({"delay": 1.5}, "delay = 1.5; give a whole number"),
        ({"delay": 10**6}, "control periods, 1000 at most"),
        ({"model_delay": True}, "model_delay = True"),
        ({"slew_limit": (1.0, 2.0)}, "low < 0 < high"),
        ({"slew_limit": "fast"}, "slew_limit = 'fast'; give"),
        ({"rate_limit": (-1.0, float("nan"))}, "low < 0 < high"),
        ({"rate_limit": [(-1, 1), (-1, 1)]}, "each of the 1 inputs"),
    ],
)
def test_other_values_are_refused(options, message):
    with pytest.raises(ConfigurationError, match=message):
        problem_of(PENDULUM, **options)
