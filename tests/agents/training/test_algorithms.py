"""Stable-Baselines3's wrappers and algorithms on the native VecEnv."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from safe_envs.agents.training.vec_env import make_sb3_env, speeds

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


def test_monitor_reports_the_last_step_of_an_episode(tmp_path):
    env = VecMonitor(
        make_sb3_env(DUBINS, 2, "scbf", seed=0, max_episode_steps=4),
        str(tmp_path),
        info_keywords=("episode_cost",),
    )
    env.reset()
    total = np.zeros(2)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (4, 2, 1)):
        _, rewards, dones, infos = env.step(action)
        total += rewards
    assert dones.all()
    for info, wanted in zip(infos, total, strict=True):
        assert info["episode"]["r"] == pytest.approx(wanted)
        assert (info["episode"]["l"], info["episode"]["episode_cost"]) == (4, info["episode_cost"])
        assert info.batch is env.batch_info
    env.close()


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_algorithms_learn(algorithm):
    settings = {
        PPO: {"n_steps": 32, "batch_size": 64, "n_epochs": 2},
        SAC: {"learning_starts": 100, "batch_size": 32},
    }[algorithm]
    native = make_sb3_env(DUBINS, 4, "scbf", intervention_penalty=0.1, max_episode_steps=10)
    env = VecNormalize(VecMonitor(native, info_keywords=("episode_cost", "episode_interventions")))
    model = algorithm("MlpPolicy", env, device="cpu", seed=0, **settings)
    model.learn(300)
    assert len(model.ep_info_buffer) >= 28
    assert all(episode["l"] == 10 for episode in model.ep_info_buffer)
    assert native.get_attr("np_random_seed") == [0, 1, 2, 3]


def test_speeds_are_of_both():
    measured = speeds(DUBINS, num_envs=2, filter="scbf", steps=3, rounds=1)
    assert set(measured) == {"SafeVecEnv", "DummyVecEnv"}
    assert min(measured.values()) > 0.0
