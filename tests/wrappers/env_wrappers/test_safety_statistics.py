"""Gymnasium's episode statistics with cost and minimum h."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import safe_envs  # noqa: F401  (registers the envs)
from safe_envs import ConfigurationError
from safe_envs.plugins import load_object
from safe_envs.wrappers import (
    RecordSafetyStatistics,
    RecordSafetyStatisticsVector,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
    SafetyMonitorVector,
)
from tests.wrappers.env_wrappers.scalar_oracle import ScalarEnvs

ENV_ID = "safe_envs/StochasticDubins-v0"
SHORT = {"max_episode_steps": 5, "barrier": {"radius": 0.5}}
KEYS = {"r", "l", "t", "c", "h_min"}
NUM_ENVS = 4
MODES = ["NextStep", "SameStep", "Disabled"]


def run(env, steps=100):
    """Return what an env says at the ends of episodes, and what its steps add up to."""
    said, added, now = [], [], []
    env.reset(seed=4)
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        now.append((reward, info["cost"], info["barrier"].min()))
        if terminated or truncated:
            said.append(info["episode"])
            rewards, costs, h = zip(*now, strict=True)
            added.append({"r": sum(rewards), "l": len(now), "c": sum(costs), "h": min(h)})
            _, info = env.reset()
            assert "episode" not in info
            now = []
        else:
            assert "episode" not in info
    return said, added


@pytest.mark.parametrize("filtered", [False, True])
def test_episodes_of_scalar_envs(filtered):
    inner = gym.make(ENV_ID, **SHORT)
    env = RecordSafetyStatistics(SafetyFilterWrapper(inner, "scbf") if filtered else inner)
    said, added = run(env)
    assert len(said) == 20
    for one, steps in zip(said, added, strict=True):
        assert set(one) == KEYS
        assert (one["l"], one["c"]) == (steps["l"], steps["c"])
        assert type(one["c"]) is type(one["h_min"]) is float
        assert one["r"] == pytest.approx(steps["r"])
        assert one["h_min"] <= steps["h"]  # the start counts too
    assert any(one["c"] > 0.0 for one in said) or filtered
    assert list(env.cost_queue) == [one["c"] for one in said]
    assert list(env.h_min_queue) == [one["h_min"] for one in said]
    assert list(env.return_queue) == [one["r"] for one in said]


def test_third_party_envs():
    spec = load_object("examples/pendulum_v1.py:spec")
    env = RecordSafetyStatistics(
        SafetyMonitor(gym.make("Pendulum-v1", max_episode_steps=3), spec), stats_key="safety"
    )
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(np.array([2.0], dtype=np.float32))
    assert set(info["safety"]) == KEYS
    assert "episode" not in info
    assert info["safety"]["h_min"] == info["h_min"]
    vector = gym.make_vec("Pendulum-v1", 2, "sync", max_episode_steps=3)
    many = RecordSafetyStatisticsVector(SafetyMonitorVector(vector, spec))
    many.reset(seed=0)
    for _ in range(3):
        *_, info = many.step(np.full((2, 1), 2.0, dtype=np.float32))
    np.testing.assert_array_equal(info["episode"]["h_min"], info["h_min"])


def test_envs_without_cost_or_h_are_refused():
    env = RecordSafetyStatistics(gym.make("Pendulum-v1", max_episode_steps=1))
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="SafetyMonitor"):
        env.step(np.array([0.0], dtype=np.float32))
    vector = gym.make_vec("Pendulum-v1", 2, "sync", max_episode_steps=1)
    vector.metadata = {}
    with pytest.raises(ConfigurationError, match="autoreset_mode"):
        RecordSafetyStatisticsVector(vector)


def test_made_again_from_specs_and_copies():
    env = RecordSafetyStatistics(gym.make(ENV_ID, **SHORT), buffer_length=7, stats_key="mine")
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, RecordSafetyStatistics)
    assert again.cost_queue.maxlen == 7
    again.reset(seed=0)
    for _ in range(5):
        twin = copy.copy(again)
        *_, info = again.step(np.array([0.1]))
    assert set(info["mine"]) == KEYS
    assert not twin.cost_queue
    assert again.cost_queue
    check_env(RecordSafetyStatistics(gym.make(ENV_ID)).unwrapped, skip_render_check=True)


def test_around_and_inside_of_monitors():
    outside = DummyVecEnv([lambda: RecordSafetyStatistics(Monitor(gym.make(ENV_ID, **SHORT)))])
    keywords = ("episode_cost", "h_min")
    inside = DummyVecEnv(
        [lambda: Monitor(RecordSafetyStatistics(gym.make(ENV_ID, **SHORT)), info_keywords=keywords)]
    )
    ends = []
    for envs in (outside, inside):
        envs.seed(2)
        envs.reset()
        for _ in range(5):
            *_, infos = envs.step(np.zeros((1, 1)))
        ends.append(infos[0]["episode"])
    assert set(ends[0]) == KEYS
    assert set(ends[1]) == {"r", "l", "t", "episode_cost", "h_min"}
    assert ends[0]["c"] == ends[1]["episode_cost"]
    assert (ends[0]["r"], ends[0]["h_min"]) == (ends[1]["r"], ends[1]["h_min"])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["native", "filtered", "sync"])
def test_episodes_of_vector_envs(mode, kind):
    """Episodes end at different times; each has what its scalar env says."""
    if kind == "sync":
        wanted = {"autoreset_mode": AutoresetMode(mode)}
        inner = gym.make_vec(ENV_ID, NUM_ENVS, "sync", vector_kwargs=wanted, **SHORT)
    else:
        inner = gym.make_vec(ENV_ID, NUM_ENVS, autoreset_mode=mode, **SHORT)
    if kind == "filtered":
        inner = SafetyFilterVectorWrapper(inner, "scbf")
    env = RecordSafetyStatisticsVector(inner)

    def scalar():
        one = gym.make(ENV_ID, **SHORT)
        return RecordSafetyStatistics(
            SafetyFilterWrapper(one, "scbf") if kind == "filtered" else one
        )

    oracle = ScalarEnvs(scalar, NUM_ENVS, mode, seed=8)
    env.reset(seed=8)
    actions, ends = np.linspace(-0.5, 0.5, NUM_ENVS)[:, None], 0
    for k in range(15):
        if k == 2:  # so that the episodes do not end together
            half = np.arange(NUM_ENVS) < 2
            env.reset(options={"reset_mask": half})
            oracle.reset(half)
        _, _, terminated, truncated, info = env.step(actions)
        steps, ended = oracle.step(actions), terminated | truncated
        assert ("episode" in info) == ended.any()
        if not ended.any():
            continue
        np.testing.assert_array_equal(info["_episode"], ended)
        assert set(info["episode"]) == KEYS
        assert not any(values[~ended].any() for values in info["episode"].values())
        for i in np.flatnonzero(ended):
            theirs = steps[i][4]["episode"]
            one = {key: values[i] for key, values in info["episode"].items()}
            assert (one["l"], one["c"]) == (theirs["l"], theirs["c"])
            for key in ("r", "h_min"):
                assert one[key] == pytest.approx(theirs[key], rel=1e-12)
            ends += 1
        if mode == "Disabled":
            env.reset(options={"reset_mask": ended})
            oracle.reset(ended)
    assert ends == env.episode_count == len(env.cost_queue) >= 8
    assert sum(env.cost_queue) > 0.0 or kind == "filtered"
