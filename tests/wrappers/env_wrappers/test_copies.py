"""Filters and monitors that are pickled or copied with their envs, also in other processes."""

from __future__ import annotations

import copy
import multiprocessing

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.wrappers import (
    ActionMap,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SpecificationMonitor,
    SpecificationMonitorVector,
)
from safe_envs.wrappers.statistics import CostReturnWrapper
from tests.conftest import problem_of
from tests.envs.test_copies import assert_goes_on_alone, copied, plain  # noqa: F401
from tests.values.guesses import SCALAR, guess
from tests.wrappers.env_wrappers.test_external_env import CAR

DUBINS = "safe_envs/StochasticDubins-v0"
SHORT = {"horizon": 0.5}
FILTERS = [
    ("safe_envs/StochasticDubins-v0", "scbf"),
    ("safe_envs/DubinsDisk-v0", "hocbf:p=2,8"),
    ("safe_envs/DubinsObstacles-v0", "hocbf"),
    ("safe_envs/CubicSDEDisk-v0", "srcbf"),
    ("safe_envs/QuadrotorLimits-v0", "hocbf"),
    ("safe_envs/CubicSDE-v0", "szcbf"),
]


def as_it_is(observation):
    return observation


def filtered_dubins():
    """Return an env for another process."""
    return SafetyFilterWrapper(gym.make(DUBINS, noise=0.2), "scbf")


@copied
@pytest.mark.parametrize(("env_id", "text"), FILTERS)
def test_filters(env_id, text, copied):
    assert_goes_on_alone(SafetyFilterWrapper(gym.make(env_id, **SHORT), text), copied)
    envs = gym.make_vec(env_id, 3, autoreset_mode="SameStep", **SHORT)
    assert_goes_on_alone(SafetyFilterVectorWrapper(envs, text), copied)


@copied
def test_filters_in_compiled_functions(copied, plain):  # noqa: F811
    envs = gym.make_vec(DUBINS, 3, engine="compiled", **SHORT)
    assert_goes_on_alone(SafetyFilterVectorWrapper(envs, "scbf"), copied)


@copied
def test_what_a_promise_filter_remembers(copied):
    env = SafetyFilterWrapper(gym.make(SCALAR), guess(), observe_promise=True)
    assert_goes_on_alone(env, copied)
    assert_goes_on_alone(SafetyFilterVectorWrapper(gym.make_vec(SCALAR, 3), guess()), copied)


@copied
def test_inputs_that_are_under_way(copied):
    options = {"delay": 3, "model_delay": 2, **SHORT}
    assert_goes_on_alone(SafetyFilterWrapper(gym.make(DUBINS, **options), "scbf"), copied)
    envs = gym.make_vec(DUBINS, 3, autoreset_mode="SameStep", **options)
    assert_goes_on_alone(SafetyFilterVectorWrapper(envs, "scbf"), copied)


@copied
def test_the_goal_of_a_filter(copied):
    env = gym.make("safe_envs/ACC-v0", **SHORT)
    assert_goes_on_alone(SafetyFilterWrapper(env, "hocbf", objective="clf"), copied)


@copied
def test_traces_of_specifications(copied):
    problem = problem_of("safe_envs/DubinsReach-v0", horizon=0.4, dt=0.1)
    text = "always safe & eventually[1,3] gate"
    assert_goes_on_alone(SpecificationMonitor(SafeEnv(problem), text), copied)
    assert_goes_on_alone(SpecificationMonitorVector(SafeVectorEnv(problem, 3), text), copied)


@copied
def test_third_party_envs(copied):
    view = {**CAR, "state_fn": as_it_is, "action_map": ActionMap.scaled(0.6)}
    env = SafetyFilterWrapper(gym.make("MountainCarContinuous-v0"), "cbf:alpha=0.05", **view)
    assert_goes_on_alone(env, copied)


@copied
def test_costs(copied):
    env = CostReturnWrapper(gym.make(DUBINS))
    env.reset(seed=0)
    other = copied(env)
    for k in range(5):
        mine, theirs = (each.step(np.full(1, 0.1 * k)) for each in (env, other))
        assert mine[1:5] == theirs[1:5]


def decided(safety_filter, rows):
    """Return what a filter decides, in whatever process."""
    found = safety_filter.filter(rows[:, :3], rows[:, 3:])
    return [np.asarray(part).tolist() for part in found]


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_filter_decides_in_other_processes_as_here(method):
    chosen = filtered_dubins().safety_filter
    rows = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 4))
    parts = np.split(rows, 4)
    with multiprocessing.get_context(method).Pool(2) as pool:
        theirs = pool.starmap(decided, [(chosen, part) for part in parts])
        one = pool.starmap(chosen.filter, [(part[0, :3], part[0, 3:]) for part in parts])
    assert theirs == [decided(chosen, part) for part in parts]
    for part, found in zip(parts, one, strict=True):
        np.testing.assert_array_equal(found.action, chosen.filter(part[0, :3], part[0, 3:]).action)


def stepped(envs, seed):
    """Return the observations and rewards of some steps of envs of Stable-Baselines3."""
    envs.seed(seed)
    found = [envs.reset().tolist()]
    for k in range(4):
        actions = np.random.default_rng(k).uniform(-1, 1, (2, 1)).astype(np.float32)
        observation, rewards, *_ = envs.step(actions)
        # One of its classes rounds rewards, the other does not.
        found += [observation.tolist(), rewards.astype(np.float32).tolist()]
    envs.close()
    return found


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_filtered_envs_step_in_other_processes_as_here(method):
    here = DummyVecEnv([filtered_dubins] * 2)
    there = SubprocVecEnv([filtered_dubins] * 2, start_method=method)
    assert stepped(there, 4) == stepped(here, 4)


@pytest.mark.slow
def test_gymnasiums_processes_step_pickled_envs():
    env = filtered_dubins()
    env.reset(seed=0)
    envs = AsyncVectorEnv([lambda: env] * 2, context="spawn")
    found = envs.reset(seed=[3, 4], options={"state": [0.1, 0.2, 0.3]})[0]
    np.testing.assert_array_equal(found, [env.reset(options={"state": [0.1, 0.2, 0.3]})[0]] * 2)
    first = envs.step(np.full((2, 1), 0.5, dtype=np.float32))[0]
    for i, seed in enumerate((3, 4)):
        env.reset(seed=seed, options={"state": [0.1, 0.2, 0.3]})
        np.testing.assert_array_equal(env.step(np.full(1, 0.5, dtype=np.float32))[0], first[i])
    envs.close()


def test_shallow_copies_share_nothing_either():
    envs = [gym.make(SCALAR), gym.make_vec(SCALAR, 3)]
    view = {**CAR, "state_fn": as_it_is}
    for env in (
        SafetyFilterWrapper(envs[0], guess()),
        SafetyFilterVectorWrapper(envs[1], guess()),
        CostReturnWrapper(envs[0]),
        SpecificationMonitor(envs[0], "always safe"),
        SpecificationMonitorVector(envs[1], "always safe"),
        SafetyFilterWrapper(gym.make("MountainCarContinuous-v0"), "cbf:alpha=0.05", **view),
    ):
        assert_goes_on_alone(env, copy.copy)
