"""Envs and filters that are copied in mid-episode go on alone, also in other processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from safe_envs.wrappers import SafetyFilterWrapper
from tests.conftest import problem_of
from tests.wrappers.cases import CASES, DUBINS, FEW, SCALAR, actions, of_env, own

COPIES = {
    "pickle": lambda given: pickle.loads(pickle.dumps(given)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}
copied = pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)


def plain_of(found):
    """Return what was returned, with arrays as bytes and without the time of day."""
    if isinstance(found, dict):
        return {key: plain_of(value) for key, value in found.items() if key != "t"}
    if isinstance(found, tuple):
        return [plain_of(each) for each in found]
    if isinstance(found, np.ndarray) and found.dtype == object:
        return [plain_of(each) for each in found.tolist()]
    return found.tobytes() if isinstance(found, np.ndarray) else found


def played(env, first, count):
    """Play some steps, and another episode when one ends; return all that the env gives."""
    found = []
    for k in range(first, first + count):
        step = env.step(actions(env, np.random.default_rng(k)))
        found.append(plain_of(step))
        if np.ndim(step[-2]) == 0 and (step[-3] or step[-2]):
            found.append(plain_of(env.reset()))
    return found


def assert_goes_on_alone(env, copied, steps=4, count=8):
    """Check that a copy does what its original does, whichever of them is asked first."""
    env.reset(seed=3)
    played(env, 0, steps)
    for order in (1, -1):
        both = [env, copied(env)][::order]
        first = played(both[0], steps, count)
        assert played(both[1], steps, count) == first
        env = both[1]


@pytest.mark.parametrize("copied", [COPIES["pickle"], copy.copy], ids=["pickle", "copy"])
@pytest.mark.parametrize("name", [*FEW, "goal of the filter", "third party", "statistics", "costs"])
def test_every_wrapper(name, copied, plain):
    # Episodes end on the way, so that the next ones are seen to be the same, too.
    assert_goes_on_alone(CASES[name](3, "SameStep"), copied)
    if not name.startswith("compiled"):
        one = CASES[name]()
        # Gymnasium's own wrappers share what they wrap with their shallow copies.
        own = one.unwrapped if isinstance(one, gym.wrappers.OrderEnforcing) else one
        assert_goes_on_alone(own if copied is copy.copy else one, copied)


@pytest.mark.parametrize("copied", [COPIES["pickle"], copy.deepcopy])
def test_every_env(env_id, copied):
    assert_goes_on_alone(of_env(env_id, filtered=False)(), copied)
    assert_goes_on_alone(of_env(env_id)(), copied)
    problem = problem_of(env_id)
    assert copied(problem) == problem


@pytest.mark.parametrize("count", [None, 2])
def test_long_episodes_take_the_noise_from_where_it_was(count):
    """Noise is drawn in chunks of 256 control periods."""
    make = own(SCALAR, start=[0.0], noise=0.01, horizon=1000.0)
    assert_goes_on_alone(make(count), copy.deepcopy, steps=250, count=20)


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


@copied
def test_pictures_are_drawn_again(copied):
    env = gym.make(DUBINS, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    played(env, 0, 5)
    first = env.render()
    other = copied(env)
    np.testing.assert_array_equal(other.render(), first)
    played(other, 5, 5)
    assert not np.array_equal(other.render(), first)
    np.testing.assert_array_equal(env.render(), first)


def filtered_dubins():
    """Return an env for another process."""
    return SafetyFilterWrapper(gym.make(DUBINS, noise=0.2), "scbf")


def decided(safety_filter, rows):
    """Return what a filter decides, in whatever process."""
    return [np.asarray(part).tolist() for part in safety_filter.filter(rows[:, :3], rows[:, 3:])]


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.oracle)])
def test_a_filter_decides_in_other_processes_as_here(method):
    chosen = filtered_dubins().safety_filter
    parts = np.split(np.random.default_rng(0).uniform(-1.5, 1.5, (40, 4)), 4)
    with multiprocessing.get_context(method).Pool(2) as pool:
        theirs = pool.map(partial(decided, chosen), parts)
    assert theirs == [decided(chosen, part) for part in parts]


def stepped(envs):
    """Return the observations and rewards of some steps of envs of Stable-Baselines3."""
    envs.seed(4)
    found = [envs.reset().tolist()]
    for k in range(4):
        given = np.random.default_rng(k).uniform(-1, 1, (2, 1)).astype(np.float32)
        observation, rewards, *_ = envs.step(given)
        # One of its classes rounds rewards, the other does not.
        found += [observation.tolist(), rewards.astype(np.float32).tolist()]
    envs.close()
    return found


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.oracle)])
def test_filtered_envs_step_in_other_processes_as_here(method):
    here = DummyVecEnv([filtered_dubins] * 2)
    there = SubprocVecEnv([filtered_dubins] * 2, start_method=method)
    assert stepped(there) == stepped(here)


@pytest.mark.oracle
def test_gymnasiums_processes_step_pickled_envs():
    env, state = filtered_dubins(), {"state": [0.1, 0.2, 0.3]}
    env.reset(seed=0)
    envs = AsyncVectorEnv([lambda: env] * 2, context="spawn")
    found = envs.reset(seed=[3, 4], options=state)[0]
    np.testing.assert_array_equal(found, [env.reset(options=state)[0]] * 2)
    first = envs.step(np.full((2, 1), 0.5, dtype=np.float32))[0]
    for i, seed in enumerate((3, 4)):
        env.reset(seed=seed, options=state)
        np.testing.assert_array_equal(env.step(np.full(1, 0.5, dtype=np.float32))[0], first[i])
    envs.close()
