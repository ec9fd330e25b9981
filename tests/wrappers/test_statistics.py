"""Episode statistics with cost and minimum h, and the six values of safety-gymnasium."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from safe_envs import ConfigurationError
from safe_envs.plugins import load_object
from safe_envs.wrappers import (
    CostReturnWrapper,
    RecordSafetyStatistics,
    RecordSafetyStatisticsVector,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
    SafetyMonitorVector,
    make_vec_with_cost,
    make_with_cost,
)
from tests.wrappers.cases import DUBINS, MODES, SMALL, assert_plays_as_alone

KEYS = {"r", "l", "t", "c", "h_min"}


@pytest.fixture(scope="module")
def pendulum():
    return load_object("examples/pendulum_v1.py:spec")


@pytest.mark.parametrize("filtered", [False, True])
def test_an_episode_has_the_sums_of_its_steps(filtered):
    inner = gym.make(DUBINS, **SMALL)
    env = RecordSafetyStatistics(SafetyFilterWrapper(inner, "scbf") if filtered else inner)
    ended, now, costs = [], [], 0.0
    env.reset(seed=4)
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(np.zeros(1))
        now.append((reward, info["cost"], info["barrier"].min()))
        assert ("episode" in info) == (terminated or truncated)
        if "episode" in info:
            said = info["episode"]
            rewards, costs, h = zip(*now, strict=True)
            assert set(said) == KEYS
            assert (said["l"], said["c"]) == (len(now), sum(costs))
            assert type(said["c"]) is type(said["h_min"]) is float
            assert said["r"] == pytest.approx(sum(rewards))
            assert said["h_min"] <= min(h)  # the start counts too
            assert said["h_min"] == info["h_min"]
            ended.append(said)
            now = []
            assert "episode" not in env.reset()[1]
    assert any(said["c"] > 0.0 for said in ended) or filtered
    for name, key in (("cost", "c"), ("h_min", "h_min"), ("return", "r")):
        assert list(getattr(env, f"{name}_queue")) == [said[key] for said in ended]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "around",
    [(RecordSafetyStatistics, RecordSafetyStatisticsVector), (CostReturnWrapper,) * 2],
    ids=["statistics", "costs"],
)
def test_a_batch_of_gymnasium_has_what_its_envs_have(around, mode):
    def make(count=None, mode=mode):
        if count is None:
            return around[0](gym.make(DUBINS, **SMALL))
        resets = {"autoreset_mode": AutoresetMode(mode)}
        return around[1](gym.make_vec(DUBINS, count, "sync", vector_kwargs=resets, **SMALL))

    assert assert_plays_as_alone(make, mode) >= 2


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("vector_entry_point", "SameStep"), ("sync", "Disabled"), ("async", "NextStep")],
)
def test_costs_of_made_batches_are_those_of_single_envs(mode, kind):
    def make(count=None, mode=mode):
        if count is None:
            return make_with_cost("StochasticDubins-v0", "scbf", **SMALL)
        return make_vec_with_cost(DUBINS, count, kind, "scbf", mode, **SMALL)

    assert assert_plays_as_alone(make, mode, count=2, steps=12) >= 2


def test_queues_of_a_batch_hold_what_episodes_had():
    env = RecordSafetyStatisticsVector(gym.make_vec(DUBINS, 4, **SMALL))
    env.reset(seed=8)
    ends, costs = 0, 0.0
    for k in range(16):
        if k == 2:  # so that the episodes do not end together
            env.reset(options={"reset_mask": np.arange(4) < 2})
        _, _, terminated, truncated, info = env.step(np.zeros((4, 1)))
        ended = terminated | truncated
        assert ("episode" in info) == ended.any()
        if ended.any():
            np.testing.assert_array_equal(info["_episode"], ended)
            assert set(info["episode"]) == KEYS
            assert not any(values[~ended].any() for values in info["episode"].values())
            ends, costs = ends + ended.sum(), costs + info["episode"]["c"].sum()
    assert ends == env.episode_count == len(env.cost_queue) >= 8
    assert sum(env.cost_queue) == costs > 0.0


def test_statistics_and_costs_of_third_party_envs(pendulum):
    inner = SafetyMonitor(gym.make("Pendulum-v1", max_episode_steps=3), pendulum)
    env = RecordSafetyStatistics(inner, stats_key="safety")
    vector = gym.make_vec("Pendulum-v1", 2, "sync", max_episode_steps=3)
    many = CostReturnWrapper(RecordSafetyStatisticsVector(SafetyMonitorVector(vector, pendulum)))
    env.reset(seed=0)
    many.reset(seed=0)
    for _ in range(3):
        info = env.step(np.array([2.0], dtype=np.float32))[-1]
        _, _, cost, _, _, infos = many.step(np.full((2, 1), 2.0, dtype=np.float32))
        np.testing.assert_array_equal(cost, infos["violation"].astype(float))
    assert set(info["safety"]) == KEYS
    assert "episode" not in info
    assert info["safety"]["h_min"] == info["h_min"] == infos["episode"]["h_min"][0]


def test_statistics_are_made_again_from_specs_and_copied():
    env = RecordSafetyStatistics(gym.make(DUBINS, **SMALL), buffer_length=7, stats_key="mine")
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


def test_around_and_inside_of_monitors():
    keywords = ("episode_cost", "h_min")
    ends = []
    for made in (
        lambda: RecordSafetyStatistics(Monitor(gym.make(DUBINS, **SMALL))),
        lambda: Monitor(RecordSafetyStatistics(gym.make(DUBINS, **SMALL)), info_keywords=keywords),
    ):
        envs = DummyVecEnv([made])
        envs.seed(2)
        envs.reset()
        for _ in range(5):
            *_, infos = envs.step(np.zeros((1, 1)))
        ends.append(infos[0]["episode"])
    outside, inside = ends
    assert set(outside) == KEYS
    assert set(inside) == {"r", "l", "t", *keywords}
    assert outside["c"] == inside["episode_cost"]
    assert (outside["r"], outside["h_min"]) == (inside["r"], inside["h_min"])


class Repeated(gym.Wrapper):
    """Holds each action for three control periods."""

    def step(self, action):
        for _ in range(3):
            found = self.env.step(action)
            if found[2] or found[3]:
                break
        return found


class Priced(gym.Wrapper):
    """Has prices of its own."""

    def step(self, action):
        *found, info = self.env.step(action)
        return *found, {**info, "cost": 0.25}


@pytest.mark.parametrize("mode", [None, "NextStep", "SameStep"])
def test_the_costs_of_repeated_actions_add_up(mode):
    settings = {"max_episode_steps": 20, "barrier": {"radius": 0.5}}
    if mode is None:
        inner = Repeated(gym.make(DUBINS, **settings))
    else:
        resets = {"autoreset_mode": AutoresetMode(mode)}
        inner = gym.make_vec(
            DUBINS, 3, "sync", vector_kwargs=resets, wrappers=[Repeated], **settings
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
    env = CostReturnWrapper(Priced(gym.make(DUBINS, **SMALL)))
    env.reset(seed=0)
    assert {env.step(np.zeros(1))[2] for _ in range(4)} == {0.25}


def silent():
    """A batch that does not say when it resets."""
    env = gym.make_vec(DUBINS, 2)
    env.metadata = {}
    return env


def stepped(env):
    env.reset(seed=0)
    return env.step(np.zeros(1, dtype=np.float32))


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: CostReturnWrapper("safe_envs/Quadrotor-v0"), "Gymnasium env"),
        (lambda: CostReturnWrapper(silent()), "autoreset_mode"),
        (lambda: RecordSafetyStatisticsVector(silent()), "autoreset_mode"),
        (lambda: stepped(CostReturnWrapper(gym.make("Pendulum-v1"))), "'cost'"),
        (
            lambda: stepped(RecordSafetyStatistics(gym.make("Pendulum-v1", max_episode_steps=1))),
            "SafetyMonitor",
        ),
        *(
            (lambda given=given: make_vec_with_cost(**{"env_id": DUBINS, **given}), fragment)
            for given, fragment in (
                ({"vectorization_mode": "threads"}, "vectorization_mode"),
                ({"autoreset_mode": "Sometimes"}, "autoreset_mode"),
                ({"num_envs": 0}, "num_envs"),
                ({"filter": "nothing"}, "nothing"),
                ({"env_id": "Nothing-v0"}, "Nothing"),
                ({"env_id": "Pendulum-v1"}, "not one of this project"),
                ({"vectorization_mode": "sync", "wrappers": []}, "wrappers"),
                ({"wrappers": []}, "wrappers"),
            )
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


def test_a_made_env_has_the_filter_inside():
    env = make_with_cost("StochasticDubins-v0", "scbf", noise=0.2)
    assert isinstance(env.env, SafetyFilterWrapper)
    assert isinstance(make_vec_with_cost(DUBINS, 2, filter="scbf").env, SafetyFilterVectorWrapper)
    assert len(stepped(env)) == 6
