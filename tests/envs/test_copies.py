"""Envs that are pickled or copied in the middle of an episode go on as if nothing had been."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.engine.program import Program

DUBINS, SCALAR = "safe_envs/StochasticDubins-v0", "safe_envs/Scalar-v0"
COPIES = {"pickle": lambda given: pickle.loads(pickle.dumps(given)), "deepcopy": copy.deepcopy}
copied = pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)


@pytest.fixture
def plain(monkeypatch):
    """Run programs as plain Python."""
    monkeypatch.setattr(Program, "compiled", Program.plain)


def actions_of(env, first, count):
    shape = env.action_space.shape
    return [np.random.default_rng(k).uniform(-1, 1, shape) for k in range(first, first + count)]


def plain_of(found):
    """Return what a step gives, with arrays as bytes."""
    if isinstance(found, dict):
        return {key: plain_of(value) for key, value in found.items()}
    if isinstance(found, tuple):
        return [plain_of(each) for each in found]
    if isinstance(found, np.ndarray) and found.dtype == object:
        return [plain_of(each) for each in found.tolist()]
    return found.tobytes() if isinstance(found, np.ndarray) else found


def played(env, first, count):
    """Play some steps, and another episode when one ends; return all that the env gives."""
    found = []
    for action in actions_of(env, first, count):
        step = env.step(action)
        found.append(plain_of(step))
        if np.ndim(step[2]) == 0 and (step[2] or step[3]):
            found.append(plain_of(env.reset()))
    return found


def assert_goes_on_alone(env, copied, steps=6, count=12):
    """Check that a copy does what its original does, whichever of them is asked first."""
    env.reset(seed=3)
    played(env, 0, steps)
    for order in (1, -1):
        both = [env, copied(env)][::order]
        first = played(both[0], steps, count)
        assert played(both[1], steps, count) == first
        env = both[1]
    return first


@copied
def test_single_envs(env_id, copied):
    # Episodes end on the way, so that the next ones are seen to be the same, too.
    assert_goes_on_alone(
        gym.make(env_id, horizon=10 * gym.make(env_id).unwrapped.problem.dt), copied
    )


@copied
@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("env_id", [DUBINS, SCALAR])
def test_batches(env_id, mode, engine, copied, plain):
    envs = gym.make_vec(
        env_id,
        3,
        engine=engine,
        autoreset_mode=mode,
        horizon=8 * gym.make(env_id).unwrapped.problem.dt,
    )
    assert_goes_on_alone(envs, copied)


@copied
def test_long_episodes_take_the_noise_from_where_it_was(copied):
    """Noise is drawn in chunks of 256 control periods."""
    env = gym.make(SCALAR, start=[0.0], noise=0.01, horizon=1000.0)
    envs = gym.make_vec(SCALAR, 2, start=[0.0], noise=0.01, horizon=1000.0)
    for each in (env, envs):
        assert_goes_on_alone(each, copied, steps=250, count=300)


@copied
def test_an_env_without_an_episode(copied):
    for env in (gym.make(DUBINS), gym.make_vec(DUBINS, 2)):
        other = copied(env)
        assert other.spec == env.spec
        assert plain_of(other.reset(seed=5)) == plain_of(env.reset(seed=5))


@copied
def test_a_generator_that_was_set_goes_along(copied):
    env = gym.make(DUBINS).unwrapped
    env.np_random = np.random.default_rng(8)
    env.reset()
    other = copied(env)
    assert plain_of(other.reset()) == plain_of(env.reset())


def test_problems_are_equal_after_pickling(env_id):
    problem = gym.make(env_id).unwrapped.problem
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert copy.deepcopy(problem) == problem


@copied
def test_pictures_are_drawn_again(copied):
    env = gym.make(DUBINS, render_mode="rgb_array")
    env.reset(seed=0)
    played(env, 0, 5)
    first = env.render()
    other = copied(env)
    np.testing.assert_array_equal(other.render(), first)
    played(other, 5, 5)
    assert not np.array_equal(other.render(), first)
    np.testing.assert_array_equal(env.render(), first)


def test_shallow_copies_share_nothing_either():
    options = {"delay": 2, "horizon": 0.5}
    assert_goes_on_alone(gym.make(DUBINS, **options).unwrapped, copy.copy)
    assert_goes_on_alone(gym.make_vec(DUBINS, 3, autoreset_mode="SameStep", **options), copy.copy)
