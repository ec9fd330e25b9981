"""SAC-Lagrangian: SAC where the multiplier is 0, and elsewhere what the constraint asks for."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from safe_envs import ConfigurationError
from safe_envs.agents.policies.sb3 import actor_of
from safe_envs.agents.training.replay_buffer import replay_options
from safe_envs.agents.training.sac_lagrangian import SACLagrangian
from safe_envs.agents.training.vec_env import make_sb3_env
from tests.agents.training.cmdp import COSTS, IcyRoad

SCALAR = "safe_envs/Scalar-v0"
NO_GAINS = {"multiplier_kp": 0.0, "multiplier_ki": 0.0, "multiplier_kd": 0.0}
SETTINGS = {
    "learning_starts": 40,
    "batch_size": 16,
    "train_freq": 2,
    "gradient_steps": 3,
    "buffer_size": 2000,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


def learned(kind, condition=None, steps=100, seed=3, horizon=0.2, start=(0.95,), **arguments):
    env = make_sb3_env(SCALAR, 2, condition, horizon=horizon, start=start, noise=1.0)
    env = VecMonitor(env)
    options = {} if condition is None else replay_options(env, "both")
    model = kind("MlpPolicy", env, seed=seed, **{**SETTINGS, **options, **arguments})
    return model.learn(steps)


def parameters(model):
    """All that SAC learns."""
    return {**model.policy.state_dict(), "alpha": model.log_ent_coef}


def assert_same(one, other):
    a, b = parameters(one), parameters(other)
    assert a.keys() == b.keys()
    for name in a:
        assert (a[name] is b[name] is None) or torch.equal(a[name], b[name]), name
    for name in ("observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(
            getattr(one.replay_buffer, name), getattr(other.replay_buffer, name)
        )


@pytest.mark.parametrize(
    ("condition", "changes"),
    [
        (None, {}),
        ("scbf", {}),
        (None, {"target_update_interval": 2, "ent_coef": 0.1}),
        (None, {"use_sde": True}),
    ],
    ids=["unfiltered", "filtered", "rare-targets", "gsde"],
)
def test_it_is_sac_bit_for_bit_where_the_multiplier_is_zero(condition, changes):
    plain = learned(SAC, condition, **changes)
    draws = [torch.rand(1).item(), np.random.random()]  # noqa: NPY002
    ours = learned(SACLagrangian, condition, **changes, **NO_GAINS)
    assert [torch.rand(1).item(), np.random.random()] == draws  # noqa: NPY002
    assert_same(plain, ours)
    # There were costs, and the critics learned them.
    assert ours.replay_buffer.costs.any()
    begun = SACLagrangian("MlpPolicy", ours.get_env(), seed=3, **SETTINGS).cost_critic
    if not changes.get("use_sde"):
        assert not torch.equal(
            ours.cost_critic.q_networks[0][0].weight, begun.q_networks[0][0].weight
        )


def test_a_multiplier_changes_the_policy_and_only_after_its_first_update():
    constrained = learned(SACLagrangian, horizon=4.0, steps=60)
    # No episode has ended.
    assert constrained.constraint.value == 0.0
    assert_same(constrained, learned(SAC, horizon=4.0, steps=60))
    constrained = learned(SACLagrangian)
    assert constrained.constraint.value > 0.0
    assert not torch.equal(constrained.policy.actor.mu.weight, learned(SAC).policy.actor.mu.weight)


@pytest.mark.parametrize("scale", [None, 3.0])
def test_the_actor_descends_on_the_weighted_loss(scale, monkeypatch):
    """Against the loss (alpha log pi - min Q_r + l s max Q_c)/(1 + l), written out here."""
    model = learned(SACLagrangian, cost_scale=scale)
    weight, alpha = model.constraint.value, model.log_ent_coef.exp().item()
    assert weight > 0.0
    before = copy.deepcopy(model.actor)
    monkeypatch.setattr(model.constraint, "update", lambda: False)
    gradients = []
    hook = model.actor.optimizer.register_step_post_hook(
        lambda *_: gradients.extend(p.grad.clone() for p in model.actor.parameters())
    )
    torch.manual_seed(5)
    model.train(1, 32)
    hook.remove()
    states = model.replay_buffer.last_sample().steps.observations
    torch.manual_seed(5)
    actions, log_prob = before.action_log_prob(states)
    rewards = torch.minimum(*model.critic(states, actions))
    costs = torch.maximum(*model.cost_critic(states, actions))
    weighted = weight * (rewards.detach().abs().mean() if scale is None else scale) * costs
    loss = (alpha * log_prob[:, None] - rewards + weighted).mean() / (1.0 + weight)
    wanted = torch.autograd.grad(loss, list(before.parameters()))
    for found, gradient in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-7)


def test_cost_critics_learn_the_discounted_cost_of_the_policy():
    """With a discount of 0 they learn the cost of the step itself, which is known."""
    env = DummyVecEnv([IcyRoad] * 4)
    settings = {**SETTINGS, "policy_kwargs": {"net_arch": [32]}, "learning_rate": 5e-3}
    model = SACLagrangian(
        "MlpPolicy", env, seed=0, cost_gamma=0.0, gamma=1.0, **NO_GAINS, **settings
    )
    model.learn(1200)
    actions = torch.tensor([[-0.8], [0.8]])
    for action, costs in zip(actions, COSTS.T, strict=True):
        with torch.no_grad():
            found = model.cost_critic(torch.eye(3), action.expand(3, 1))
        for values in found:
            np.testing.assert_allclose(values.ravel(), costs, atol=0.25)


def test_a_limit_of_zero_and_costs_of_zero_give_finite_numbers():
    model = learned(SACLagrangian, cost_limit=0.0, start=(0.0,), horizon=0.04)
    assert model.constraint.episode_cost == model.constraint.value == 0.0
    for tensor in (*parameters(model).values(), *model.cost_critic.state_dict().values()):
        assert torch.isfinite(tensor).all()


def test_a_saved_model_is_one_of_sac_and_a_policy_that_can_be_kept_as_data(tmp_path):
    model = learned(SACLagrangian, "scbf", start=(0.999,))
    assert actor_of(model.policy)[2] == "relu"
    model.plain().save(tmp_path / "model.zip")
    read = SAC.load(tmp_path / "model.zip", device="cpu")
    assert type(read) is SAC
    rows = np.linspace(-1.0, 1.0, 5)[:, None].astype(np.float32)
    np.testing.assert_array_equal(
        read.predict(rows, deterministic=True)[0], model.predict(rows, deterministic=True)[0]
    )
    assert type(model) is SACLagrangian
    assert model.constraint.value > 0.0
    model.save(tmp_path / "whole.zip")
    again = SACLagrangian.load(tmp_path / "whole.zip", model.get_env(), device="cpu")
    assert again.constraint.value == model.constraint.value
    for name, tensor in model.cost_critic_target.state_dict().items():
        assert torch.equal(tensor, again.cost_critic_target.state_dict()[name])


def test_random_numbers_of_the_cost_critics_follow_from_the_seed():
    first, again, other = (
        SACLagrangian("MlpPolicy", DummyVecEnv([IcyRoad]), seed=seed, **SETTINGS)
        for seed in (1, 1, 2)
    )
    weights = [m.cost_critic.q_networks[0][0].weight for m in (first, again, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])
    assert not torch.equal(weights[0], first.critic.q_networks[0][0].weight)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cost_gamma": 1.5}, "cost_gamma = 1.5"),
        ({"cost_gamma": "0.9"}, "cost_gamma = '0.9'"),
        ({"cost_scale": 0.0}, "cost_scale = 0.0"),
        ({"cost_scale": "1"}, "cost_scale = '1'"),
        ({"cost_limit": -1.0}, "limit of the cost"),
        ({"multiplier_ki": -1.0}, "ki = -1.0"),
        ({"n_steps": 3}, "n_steps=1"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        SACLagrangian("MlpPolicy", DummyVecEnv([IcyRoad]), **{**SETTINGS, **arguments})


def test_observations_of_several_parts_are_refused():
    env = gym.Env()
    env.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    env.observation_space = gym.spaces.Dict({"x": gym.spaces.Box(-1.0, 1.0, (1,))})
    with pytest.raises(ConfigurationError, match="FlattenObservation"):
        SACLagrangian("MultiInputPolicy", DummyVecEnv([lambda: env]), **SETTINGS)


class Features(FlattenExtractor):
    """Features that are learned."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.scale = torch.nn.Parameter(torch.ones(self.features_dim))

    def forward(self, observations):
        return self.scale * super().forward(observations)


def test_cost_critics_learn_features_of_their_own():
    """Where SAC's critic takes the features that its actor learns, they would have fixed ones."""
    kwargs = {
        "net_arch": [8],
        "features_extractor_class": Features,
        "share_features_extractor": True,
    }
    model = learned(SACLagrangian, policy_kwargs=kwargs)
    assert not torch.equal(model.cost_critic.features_extractor.scale, torch.ones(1))
    assert_same(
        learned(SAC, policy_kwargs=kwargs), learned(SACLagrangian, policy_kwargs=kwargs, **NO_GAINS)
    )
