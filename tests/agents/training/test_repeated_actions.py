"""Constrained algorithms behind a wrapper that repeats actions: no cost is lost."""

from __future__ import annotations

import gymnasium as gym
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from safe_envs.agents.training.ppo_lagrangian import PPOLagrangian
from safe_envs.agents.training.sac_lagrangian import SACLagrangian

PPO_SETTINGS = {"n_steps": 40, "batch_size": 80, "n_epochs": 1}
SAC_SETTINGS = {"learning_starts": 200, "batch_size": 8, "buffer_size": 300}


class Repeated(gym.Wrapper):
    """Holds each action for four control periods."""

    def step(self, action):
        total = 0.0
        for _ in range(4):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


def make():
    # It soon leaves the safe set.
    return Monitor(Repeated(gym.make("safe_envs/Scalar-v0", start=(0.9,), noise=1.0, horizon=0.5)))


class Ends(BaseCallback):
    """Adds up the costs of the episodes that have ended, as the envs count them."""

    episodes, cost = 0, 0.0

    def _on_step(self):
        for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True):
            self.episodes += done
            self.cost += done * info["episode_cost"]
        return True


@pytest.mark.parametrize(
    ("kind", "settings"), [(PPOLagrangian, PPO_SETTINGS), (SACLagrangian, SAC_SETTINGS)]
)
def test_the_measured_cost_is_that_of_the_env(kind, settings):
    torch.set_num_threads(1)
    net = {"net_arch": [8]}
    common = {"policy_kwargs": net, "device": "cpu", "seed": 0}
    model = kind("MlpPolicy", DummyVecEnv([make] * 2), **settings, **common)
    model.learn(80, callback=(ends := Ends()))
    model.constraint.update()
    recent = [sum(column) for column in zip(*model.constraint.recent, strict=True)]
    assert recent[:2] == [ends.episodes, ends.cost]
    assert ends.cost > 2.0 * ends.episodes
    if kind is SACLagrangian:
        last = zip(ends.locals["infos"], ends.locals["dones"], strict=True)
        running = sum(info["episode_cost"] for info, done in last if not done)
        assert model.replay_buffer.costs.sum() == ends.cost + running
