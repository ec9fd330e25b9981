"""PPO-Lagrangian: PPO itself without a multiplier, and what the costs add with one."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from safe_envs import ConfigurationError
from safe_envs.agents import make_sb3_env
from safe_envs.agents.training.ppo_lagrangian import PPOLagrangian

SETTINGS: dict[str, Any] = {
    "n_steps": 32,
    "batch_size": 64,
    "n_epochs": 2,
    "gamma": 0.9,
    "policy_kwargs": {"net_arch": [8]},
    "seed": 1,
    "device": "cpu",
}
NO_GAINS = {"multiplier_kp": 0.0, "multiplier_ki": 0.0, "multiplier_kd": 0.0}


class Corridor(gym.Env[np.ndarray, np.ndarray]):
    """Position x goes where the action says; right is rewarded, and costs beyond 0.5."""

    observation_space = spaces.Box(-5.0, 5.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, steps=8, cost=True):
        self.x, self.t, self.steps, self.cost = 0.0, 0, steps, cost

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = 0.0, 0
        return np.array([self.x], np.float32), {}

    def step(self, action):
        self.x = float(np.clip(self.x + 0.3 * float(action[0]), -5, 5))
        self.t += 1
        info = {"cost": float(self.x > 0.5)} if self.cost else {}
        return np.array([self.x], np.float32), self.x, False, self.t == self.steps, info


def corridors(count=4, **arguments):
    return DummyVecEnv([lambda: Corridor(**arguments) for _ in range(count)])


def limited(envs, **changes):
    return PPOLagrangian("MlpPolicy", envs, **SETTINGS | changes)


def parameters(model):
    return {key: value.clone() for key, value in model.policy.state_dict().items()}


def scalars(**options):
    return make_sb3_env("safe_envs/Scalar-v0", 4, horizon=0.5, **options)


@pytest.mark.parametrize(
    ("make", "changes"),
    [
        (lambda: VecMonitor(scalars()), {}),
        (lambda: VecNormalize(scalars()), {"learning_rate": lambda left: 1e-3 * left}),
        (lambda: VecNormalize(scalars(filter="scbf"), norm_reward=False), {"use_sde": True}),
        (lambda: scalars(terminate_on_violation=True), {"clip_range_vf": 0.2, "target_kl": 0.01}),
        (corridors, {"normalize_advantage": False, "ent_coef": 0.01}),
    ],
    ids=["monitor", "normalised", "gsde", "clipped", "dummy"],
)
def test_without_a_multiplier_it_is_ppo_bit_for_bit(make, changes):
    found = []
    for kind, gains in ((PPO, {}), (PPOLagrangian, NO_GAINS)):
        model = kind("MlpPolicy", make(), **SETTINGS | changes | gains).learn(4 * 4 * 32)
        found.append((parameters(model), torch.get_rng_state().tolist(), model._last_obs.tolist()))
    (policy, *others), (same_policy, *same_others) = found
    assert all(torch.equal(policy[key], same_policy[key]) for key in policy)
    assert others == same_others


def test_a_cost_critic_without_a_multiplier_cannot_spoil_it():
    model = limited(corridors(), **NO_GAINS)
    model.cost_critic.value_net[-1].bias.data.fill_(float("nan"))
    model.learn(256)
    assert all(torch.isfinite(value).all() for value in parameters(model).values())


def test_with_one_it_is_not():
    policies = [limited(corridors(), **gains).learn(512) for gains in (NO_GAINS, {})]
    assert policies[1].constraint.value > 0.0
    assert any(
        not torch.equal(a, b)
        for a, b in zip(*(parameters(p).values() for p in policies), strict=True)
    )


def test_two_trainings_with_one_seed_are_one():
    one, other = (limited(corridors()).learn(512) for _ in range(2))
    assert all(
        torch.equal(a, b)
        for a, b in zip(one.cost_critic.parameters(), other.cost_critic.parameters(), strict=True)
    )
    assert one.constraint.state() == other.constraint.state()


def test_the_critic_s_parameters_depend_on_the_seed():
    one, other = (limited(corridors(), seed=seed) for seed in (1, 2))
    assert not torch.equal(*(m.cost_critic.value_net[0].weight for m in (one, other)))


def test_costs_are_continued_where_only_time_ended_an_episode():
    """The returns of the costs by hand, from the critic's values before the update."""
    model = limited(corridors(1, steps=5), n_steps=8, batch_size=8, cost_gae_lambda=1.0)
    seen = {}

    def observed(observations):
        seen["observations"] = observations
        estimate(observations)
        seen.update(rewards=model._costs.rewards.copy(), returns=model._costs.returns.copy())
        seen["values"] = model._costs.values.copy()
        seen["last"] = model.cost_critic.values(model._last_obs)

    estimate, model._estimate_costs = model._estimate_costs, observed
    ends = []
    of_ends = model.cost_critic.values

    def kept(observations):
        ends.append((observations.copy(), of_ends(observations)))
        return ends[-1][1]

    model.cost_critic.values = kept
    model.learn(8)
    (end, value), *_ = ends
    assert end.shape == (1, 1)
    x = seen["observations"][:, 0, 0]
    # The cost of a step is that of the state after it: of the next row, or of the last observation.
    after = np.array([*x[1:5], end[0, 0], *x[6:8], model._last_obs[0, 0]])
    costs = (after > 0.5).astype(float)
    costs[4] += model.cost_gamma * value[0]
    np.testing.assert_allclose(seen["rewards"][:, 0], costs, rtol=1e-6)
    wanted = np.empty(8)
    following = seen["last"][0]
    for t in reversed(range(8)):
        wanted[t] = costs[t] + model.cost_gamma * following * (t != 4)
        following = wanted[t]
    np.testing.assert_allclose(seen["returns"][:, 0], wanted, rtol=1e-5)


def test_the_limit_is_kept_where_the_rewards_pull_beyond_it():
    """Right is where the rewards are, and where each step costs."""
    settings = {"n_steps": 64, "batch_size": 256, "n_epochs": 4, "learning_rate": 3e-3}
    free = limited(corridors(8), **NO_GAINS, **settings).learn(8_000)
    kept = limited(corridors(8), cost_limit=0.5, **settings).learn(8_000)
    assert free.constraint.episode_cost > 4.0
    assert kept.constraint.episode_cost < 1.0


def test_a_limit_of_zero_gives_no_nan():
    model = limited(corridors(), cost_limit=0.0).learn(512)
    assert all(torch.isfinite(value).all() for value in parameters(model).values())
    assert np.isfinite(list(model.constraint.figures().values())).all()


def test_a_file_keeps_the_multiplier_and_the_critic(tmp_path):
    model = limited(corridors()).learn(512)
    model.save(tmp_path / "model.zip")
    loaded = PPOLagrangian.load(tmp_path / "model.zip", env=corridors())
    assert loaded.constraint.value == model.constraint.value > 0.0
    x = np.linspace(-1, 1, 9, dtype=np.float32)[:, None]
    np.testing.assert_array_equal(loaded.cost_critic.values(x), model.cost_critic.values(x))
    assert loaded.cost_critic.optimizer.state_dict()["state"]
    loaded.learn(256)


def test_the_plain_one_is_a_file_of_stable_baselines3(tmp_path):
    model = limited(corridors()).learn(256)
    model.plain().save(tmp_path / "model.zip")
    loaded = PPO.load(tmp_path / "model.zip", env=corridors())
    assert type(loaded) is PPO
    assert b"safe_envs" not in (tmp_path / "model.zip").read_bytes()
    assert all(
        torch.equal(a, b)
        for a, b in zip(parameters(model).values(), parameters(loaded).values(), strict=True)
    )
    loaded.learn(256)
    model.learn(256)


def test_envs_without_costs_are_refused():
    with pytest.raises(ConfigurationError, match="no entry 'cost'"):
        limited(corridors(cost=False)).learn(256)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cost_gamma": 1.5}, "cost_gamma"),
        ({"cost_gae_lambda": -0.1}, "cost_gae_lambda"),
        ({"cost_gamma": None}, "cost_gamma = None"),
        ({"cost_limit": -1.0}, "limit"),
        ({"multiplier_ki": float("nan")}, "multiplier_ki"),
    ],
)
def test_arguments_out_of_range_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        limited(corridors(), **changes)
