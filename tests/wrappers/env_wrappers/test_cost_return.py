"""The interface of safety-gymnasium."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import safe_envs  # noqa: F401  (registers the envs)
from safe_envs import ConfigurationError
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from safe_envs.wrappers.env_wrappers.cost_return import CostReturnWrapper

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
