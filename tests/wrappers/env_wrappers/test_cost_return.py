"""The interface of safety-gymnasium."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import safe_envs  # noqa: F401  (registers the envs)
from safe_envs import ConfigurationError
from safe_envs.plugins import load_object
from safe_envs.wrappers import (
    CostReturnWrapper,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitorVector,
    make_vec_with_cost,
    make_with_cost,
)
from tests.wrappers.env_wrappers.scalar_oracle import ScalarEnvs

ENV_ID = "safe_envs/StochasticDubins-v0"
NUM_ENVS = 8


def vectors(mode, native):
    """The same envs twice, with few steps and a start that soon is unsafe."""
    settings = {"max_episode_steps": 4, "barrier": {"radius": 1.0}}
    if native:
        return [
            gym.make_vec(ENV_ID, NUM_ENVS, "vector_entry_point", autoreset_mode=mode, **settings)
            for _ in range(2)
        ]
    wanted = {"autoreset_mode": AutoresetMode(mode)}
    return [
        gym.make_vec(ENV_ID, NUM_ENVS, "sync", vector_kwargs=wanted, **settings) for _ in range(2)
    ]


def test_scalar_step_has_six_values():
    plain, env = (
        gym.make(ENV_ID, barrier={"radius": 1.0}),
        CostReturnWrapper(gym.make(ENV_ID, barrier={"radius": 1.0})),
    )
    first, second = plain.reset(seed=3), env.reset(seed=3)
    np.testing.assert_array_equal(first[0], second[0])
    costs = 0.0
    for _ in range(200):
        action = np.array([0.2])
        observation, reward, terminated, truncated, info = plain.step(action)
        six = env.step(action)
        np.testing.assert_array_equal(six[0], observation)
        assert six[1:5] == (reward, info["cost"], terminated, truncated)
        assert type(six[2]) is float
        assert six[5]["cost_sum"] == six[2] == six[5]["cost"]
        assert set(six[5]) == {*info, "cost_sum"}
        costs += six[2]
        if terminated or truncated:
            break
    assert costs == six[5]["episode_cost"] > 0.0


class Repeated(gym.Wrapper):
    """Holds each action for three control periods."""

    def step(self, action):
        for _ in range(3):
            found = self.env.step(action)
            if found[2] or found[3]:
                break
        return found


@pytest.mark.parametrize("mode", [None, "NextStep", "SameStep"])
def test_the_costs_of_repeated_actions_add_up(mode):
    settings = {"max_episode_steps": 20, "barrier": {"radius": 0.5}}
    inner = (
        Repeated(gym.make(ENV_ID, **settings))
        if mode is None
        else gym.make_vec(
            ENV_ID,
            3,
            "sync",
            vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
            wrappers=[Repeated],
            **settings,
        )
    )
    env = CostReturnWrapper(inner)
    env.reset(seed=0)
    total, seen = np.zeros(1 if mode is None else 3), 0
    for _ in range(20):
        _, _, cost, terminated, truncated, info = env.step(np.zeros(inner.action_space.shape))
        total += cost
        done = np.atleast_1d(terminated | truncated)
        last = info["final_info"] if mode == "SameStep" and done.any() else info
        for i in np.flatnonzero(done):
            assert total[i] == np.atleast_1d(last["episode_cost"])[i]
            seen += total[i] > 4.0
        total[done] = 0.0
        if mode is None and done:
            env.reset()
    assert seen > 0


def test_a_cost_that_somebody_else_wrote_is_returned():
    class Priced(gym.Wrapper):
        def step(self, action):
            *found, info = self.env.step(action)
            return *found, {**info, "cost": 0.25}

    env = CostReturnWrapper(Priced(gym.make(ENV_ID, barrier={"radius": 1.0})))
    env.reset(seed=0)
    assert {env.step(np.zeros(1))[2] for _ in range(60)} == {0.25}


def test_attributes_are_those_of_the_env():
    inner = SafetyFilterWrapper(gym.make(ENV_ID), "scbf")
    env = CostReturnWrapper(inner)
    assert env.action_space == inner.action_space
    assert env.observation_space == inner.observation_space
    assert env.metadata is inner.metadata
    assert env.unwrapped is inner.unwrapped
    assert env.spec == inner.spec
    env.reset(seed=0)
    assert "safe_action" in env.step(np.array([0.0]))[5]
    for name in ("nothing", "_private"):
        with pytest.raises(AttributeError, match=name):
            getattr(env, name)
    assert copy.copy(env).env is not inner
    env.close()


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_costs_of_vector_envs_are_those_of_the_steps(mode, native):
    plain, other = vectors(mode, native)
    env = CostReturnWrapper(other)
    plain.reset(seed=6)
    env.reset(seed=6)
    ended, total, seen = np.zeros(NUM_ENVS, dtype=bool), np.zeros(NUM_ENVS), 0
    for _ in range(14):
        actions = np.zeros((NUM_ENVS, 1))
        *_, info = plain.step(actions)
        _, _, cost, terminated, truncated, six = env.step(actions)
        assert cost.shape == (NUM_ENVS,)
        np.testing.assert_array_equal(six["cost_sum"], cost)
        np.testing.assert_array_equal(six["cost"], info["cost"])
        assert six["_cost_sum"].all()
        total += cost
        done = terminated | truncated
        last = six["final_info"] if mode == "SameStep" and done.any() else six
        for i in np.flatnonzero(done):
            assert total[i] == last["episode_cost"][i]
            seen += total[i] > 0.0
        if mode == "NextStep":
            assert not cost[ended].any()
            ended = done
        total[done] = 0.0
    assert seen > 0


def test_masked_resets_of_filtered_vector_envs():
    inner = gym.make_vec(
        ENV_ID, 3, "vector_entry_point", autoreset_mode="Disabled", max_episode_steps=2
    )
    env = CostReturnWrapper(SafetyFilterVectorWrapper(inner, "scbf"))
    env.reset(seed=0)
    for _ in range(2):
        _, _, cost, _, truncated, _ = env.step(np.zeros((3, 1)))
    assert cost.shape == (3,)
    env.reset(options={"reset_mask": truncated})
    assert not env._ended.any()
    assert env.num_envs == 3


def test_envs_without_a_cost_are_refused():
    with pytest.raises(ConfigurationError, match="Gymnasium env"):
        CostReturnWrapper("safe_envs/Quadrotor-v0")  # pyright: ignore[reportArgumentType]
    env = CostReturnWrapper(gym.make("MountainCarContinuous-v0"))
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="no 'cost'"):
        env.step(env.action_space.sample())


def test_made_with_costs():
    env = make_with_cost("StochasticDubins-v0", "scbf", noise=0.2)
    assert isinstance(env, CostReturnWrapper)
    assert isinstance(env.env, SafetyFilterWrapper)
    env.reset(seed=0)
    assert len(env.step(np.array([0.0]))) == 6
    assert make_with_cost(ENV_ID).unwrapped.problem.plant is not None


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("kind", ["vector_entry_point", "sync"])
@pytest.mark.parametrize("text", [None, "scbf"])
def test_costs_are_those_of_scalar_envs(mode, kind, text):
    assert_costs_of_scalar_envs(mode, kind, text)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_costs_from_processes_are_those_of_scalar_envs(mode):
    assert_costs_of_scalar_envs(mode, "async", "scbf", num_envs=2)


def assert_costs_of_scalar_envs(mode, kind, text, num_envs=4):
    settings = {"max_episode_steps": 5, "barrier": {"radius": 0.5}}
    env = make_vec_with_cost(ENV_ID, num_envs, kind, text, mode, **settings)
    oracle = ScalarEnvs(lambda: make_with_cost(ENV_ID, text, **settings), num_envs, mode, seed=5)
    env.reset(seed=5)
    actions, total, ends = np.linspace(-0.5, 0.5, num_envs)[:, None], 0.0, 0
    for k in range(15):
        if k == 2:
            half = np.arange(num_envs) < 1
            env.reset(options={"reset_mask": half})
            oracle.reset(half)
        *_, cost, terminated, truncated, info = env.step(actions)
        steps, ended = oracle.step(actions), terminated | truncated
        assert cost.dtype == np.float64
        np.testing.assert_array_equal(cost, [0.0 if six is None else six[2] for six in steps])
        np.testing.assert_array_equal(
            ended, [six is not None and (six[3] or six[4]) for six in steps]
        )
        last = info["final_info"] if mode == "SameStep" and ended.any() else info
        for i in np.flatnonzero(ended):
            assert last["episode_cost"][i] == steps[i][5]["episode_cost"]
            ends += 1
        if mode == "Disabled" and ended.any():
            env.reset(options={"reset_mask": ended})
            oracle.reset(ended)
        total += cost.sum()
    assert ends >= 2 * num_envs
    assert total > 0.0 or text
    env.close()


def test_costs_of_third_party_envs():
    spec = load_object("examples/pendulum_v1.py:spec")
    env = CostReturnWrapper(SafetyMonitorVector(gym.make_vec("Pendulum-v1", 3, "sync"), spec))
    env.reset(seed=0)
    _, _, cost, _, _, info = env.step(np.full((3, 1), 2.0, dtype=np.float32))
    np.testing.assert_array_equal(cost, info["violation"].astype(float))


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"vectorization_mode": "threads"}, "vectorization_mode"),
        ({"autoreset_mode": "Sometimes"}, "autoreset_mode"),
        ({"num_envs": 0}, "num_envs"),
        ({"filter": "nothing"}, "nothing"),
        ({"env_id": "Nothing-v0"}, "Nothing"),
        ({"env_id": "Pendulum-v1"}, "not one of this project"),
    ],
)
def test_wrong_arguments_are_refused(arguments, word):
    with pytest.raises(ConfigurationError, match=word):
        make_vec_with_cost(**{"env_id": ENV_ID, **arguments})
    silent = gym.make_vec(ENV_ID, 2)
    silent.metadata = {}
    with pytest.raises(ConfigurationError, match="autoreset_mode"):
        CostReturnWrapper(silent)


@pytest.mark.parametrize("kind", ["sync", None])
def test_wrappers_of_gymnasium_are_referred_to_it(kind):
    with pytest.raises(ConfigurationError, match="wrappers: leave it out"):
        make_vec_with_cost(ENV_ID, 2, kind, wrappers=[])
