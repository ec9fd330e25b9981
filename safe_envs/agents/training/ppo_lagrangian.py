"""PPO under a limit on the expected cost of an episode."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.utils import explained_variance
from torch import nn
from torch.nn import functional

from safe_envs.agents.training.constraint import EpisodeConstraint, require_one_part, require_share

_OF_THE_CRITIC = 0xC057
"""Key of the random numbers of critics, apart from those of the policies with the same seed."""


class CostCritic(nn.Module):
    """The expected discounted cost from a state on: a network with an optimizer of its own.

    It shares no parameter, gradient or random number with the policy, and so does not change what
    the policy learns from the rewards.

    Attributes:
        optimizer: of its parameters.

    Args:
        policy: whose observations, features extractor, hidden layers and optimizer it takes after.
        learning_rate: at the beginning.
        seed: of its parameters, and of the order of the minibatches.
    """

    def __init__(self, policy: ActorCriticPolicy, learning_rate: float, seed: int) -> None:
        super().__init__()
        self._seed = seed
        self._space, self._normalize_images = policy.observation_space, policy.normalize_images
        layers = policy.net_arch["vf"] if isinstance(policy.net_arch, dict) else policy.net_arch
        with th.random.fork_rng(devices=[]):
            th.manual_seed(_generator(seed, 0).integers(2**63))
            self.features_extractor = policy.features_extractor_class(
                policy.observation_space, **policy.features_extractor_kwargs
            )
            width = self.features_extractor.features_dim
            self.value_net = nn.Sequential(
                *create_mlp(width, 1, list(layers), policy.activation_fn)
            )
        # The first estimates are small, as those of an untrained policy's value function are not.
        with th.no_grad():
            self.value_net[-1].weight.mul_(0.01)  # pyright: ignore[reportCallIssue, reportArgumentType]
            self.value_net[-1].bias.zero_()  # pyright: ignore[reportCallIssue]
        self.to(policy.device)
        self.optimizer: th.optim.Optimizer = policy.optimizer_class(
            self.parameters(),
            lr=learning_rate,  # pyright: ignore[reportCallIssue]
            **policy.optimizer_kwargs,
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the expected discounted costs, shape (batch,)."""
        inputs = preprocess_obs(observations, self._space, normalize_images=self._normalize_images)
        return self.value_net(self.features_extractor(inputs)).flatten()

    def values(self, observations: np.ndarray) -> np.ndarray:
        """Return the expected discounted costs without gradients, float32 of shape (batch,)."""
        with th.no_grad():
            return self(self._tensor(observations)).cpu().numpy()

    def fit(
        self,
        observations: np.ndarray,
        costs: RolloutBuffer,
        *,
        steps: int,
        epochs: int,
        batch_size: int,
        clip_range: float | None,
        max_grad_norm: float,
    ) -> dict[str, float]:
        """Fit the critic to the returns of a rollout, as PPO does its value function.

        Args:
            observations: of the rollout, shape (n_steps, n_envs, ...).
            costs: of the rollout, with values and returns.
            steps: of the training so far, which the order of the minibatches depends on, so that a
                resumed training has the same.
            epochs: passes over the rollout.
            batch_size: of the minibatches.
            clip_range: by how much a value may change; None for any.
            max_grad_norm: greatest norm of a gradient.

        Returns:
            The mean loss, and the share of the variance of the returns that the values explained
            before.
        """
        rows = self._tensor(observations.reshape(-1, *observations.shape[2:]))
        old, wanted = (
            th.as_tensor(array.reshape(-1), device=rows.device)
            for array in (costs.values, costs.returns)
        )
        generator, losses = _generator(self._seed, steps), []
        for _ in range(epochs):
            order = th.as_tensor(generator.permutation(len(rows)), device=rows.device)
            for batch in order.split(batch_size):
                values = self(rows[batch])
                if clip_range is not None:
                    change = th.clamp(values - old[batch], -clip_range, clip_range)
                    values = old[batch] + change
                loss = functional.mse_loss(values, wanted[batch])
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.parameters(), max_grad_norm)
                self.optimizer.step()
                losses.append(loss.item())
        explained = explained_variance(costs.values.flatten(), costs.returns.flatten())
        return {"cost_value_loss": float(np.mean(losses)), "cost_explained_variance": explained}

    def _tensor(self, observations: np.ndarray) -> th.Tensor:
        return th.as_tensor(observations, device=next(self.parameters()).device)


def _generator(seed: int, *key: Any) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_OF_THE_CRITIC, *key)))


_LEAST_SPREAD = 1e-6
_OF_THE_CONSTRAINT = (
    "cost_limit",
    "cost_unit",
    "cost_gamma",
    "cost_gae_lambda",
    "multiplier_gains",
    "constraint",
    "cost_critic",
    "_costs",
)


class PPOLagrangian(PPO):
    """PPO with a critic of the costs, and a Lagrange multiplier l that a PID controller moves.

    The policy learns on the advantage (A_r - l s A_c)/(1 + l), where s is the ratio of the standard
    deviations of the advantages A_r of rewards and A_c of costs in the rollout: so the same gains
    serve rewards and costs of any unit. With l = 0 it is PPO, bit for bit.

    The costs are `info["cost"]`, of any env; a `SB3VecEnv` gives those of a step at once. Behind a
    wrapper that repeats actions they are those of all repetitions, see `StepCosts`. Like the
    rewards, the costs of an episode that only time ended are continued by the critic's value. The
    constraint is on the undiscounted cost of whole episodes, see `EpisodeConstraint`; its discount
    is for the advantages alone.

    Sources: Ray, Achiam, Amodei, "Benchmarking Safe Exploration in Deep Reinforcement Learning",
        2019, on PPO-Lagrangian; Stooke, Achiam, Abbeel, "Responsive Safety in Reinforcement
        Learning by PID Lagrangian Methods", 2020, arXiv:2007.03964, on the multiplier and the
        factor 1/(1 + l), which keeps the size of the steps.

    Attributes:
        constraint: the limit, the multiplier and what was measured.
        cost_critic: see `CostCritic`.

    Args:
        *args: those of PPO.
        cost_limit: greatest expected cost of an episode.
        cost_unit: unit of the excess that the multiplier sees, see `EpisodeConstraint`.
        cost_gamma: discount of the costs.
        cost_gae_lambda: trade-off of bias and variance of their advantages.
        multiplier_kp: proportional gain of the multiplier, see `PIDMultiplier`.
        multiplier_ki: integral gain.
        multiplier_kd: derivative gain.
        multiplier_smoothing: of the measured costs.
        multiplier_most: greatest multiplier.
        **kwargs: those of PPO.

    Raises:
        ConfigurationError: an argument is out of range, or the env has observations of several
            parts.
    """

    def __init__(  # noqa: PLR0913  (hyperparameters)
        self,
        *args: Any,
        cost_limit: float = 0.0,
        cost_unit: float = 1.0,
        cost_gamma: float = 0.99,
        cost_gae_lambda: float = 0.95,
        multiplier_kp: float = 1.0,
        multiplier_ki: float = 0.5,
        multiplier_kd: float = 1.0,
        multiplier_smoothing: float = 0.0,
        multiplier_most: float = 100.0,
        **kwargs: Any,
    ) -> None:
        for name, number in {"cost_gamma": cost_gamma, "cost_gae_lambda": cost_gae_lambda}.items():
            require_share(name, number)
        self.cost_limit, self.cost_unit = cost_limit, cost_unit
        self.cost_gamma, self.cost_gae_lambda = cost_gamma, cost_gae_lambda
        self.multiplier_gains = {
            "kp": multiplier_kp,
            "ki": multiplier_ki,
            "kd": multiplier_kd,
            "smoothing": multiplier_smoothing,
            "most": multiplier_most,
        }
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        require_one_part(self.observation_space)
        known: EpisodeConstraint | None = vars(self).get("constraint")
        self.constraint = EpisodeConstraint(
            self.cost_limit, self.n_envs, unit=self.cost_unit, gains=self.multiplier_gains
        )
        if known is not None:  # of a file that is being loaded
            self.constraint.multiplier.restore(known.multiplier.state())
        seed: Any = np.random.SeedSequence().entropy if self.seed is None else self.seed
        self.cost_critic = CostCritic(self.policy, self.lr_schedule(1.0), seed)
        self._costs = RolloutBuffer(
            self.n_steps,
            self.observation_space,
            self.action_space,
            gamma=self.cost_gamma,
            gae_lambda=self.cost_gae_lambda,
            n_envs=self.n_envs,
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "PPOLagrangian",
        progress_bar: bool = False,
    ) -> Any:
        if reset_num_timesteps or self._last_obs is None:
            self.constraint.begin_episodes()
        return super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        """Take the costs of a step, for whose place Stable-Baselines3 has no other method."""
        super()._update_info_buffer(infos, dones)
        costs = self.constraint.measure(infos, dones)
        cut = [
            i
            for i in np.flatnonzero(dones)
            if infos[i].get("TimeLimit.truncated", False)
            and infos[i].get("terminal_observation") is not None
        ]
        if cut:
            ends = np.stack([infos[i]["terminal_observation"] for i in cut])
            costs[cut] += self.cost_gamma * self.cost_critic.values(ends)
        self._costs.rewards[self.rollout_buffer.pos] = costs

    def train(self) -> None:
        """Update the multiplier, the policy on the weighted advantages, and the critics."""
        rollout, costs = self.rollout_buffer, self._costs
        # `get` flattens the rollout's arrays in another order.
        observations, costs.episode_starts = rollout.observations, rollout.episode_starts
        self._estimate_costs(observations)
        self.constraint.update()
        rollout.advantages = self._weighted(rollout.advantages, costs.advantages)
        super().train()
        self._update_learning_rate(self.cost_critic.optimizer)
        clip_range: Any = self.clip_range_vf
        found = self.cost_critic.fit(
            observations,
            costs,
            steps=self.num_timesteps,
            epochs=self.n_epochs,
            batch_size=self.batch_size,
            clip_range=clip_range and clip_range(self._current_progress_remaining),
            max_grad_norm=self.max_grad_norm,
        )
        for name, value in found.items():
            self.logger.record(f"train/{name}", value)
        for name, value in self.constraint.figures().items():
            self.logger.record(f"constraint/{name}", value)

    def _estimate_costs(self, observations: np.ndarray) -> None:
        """Fill in the values, returns and advantages of the costs of the rollout."""
        critic, costs = self.cost_critic, self._costs
        rows = observations.reshape(-1, *observations.shape[2:])
        costs.values = critic.values(rows).reshape(costs.rewards.shape)
        last: Any = self._last_obs
        dones: Any = self._last_episode_starts
        costs.compute_returns_and_advantage(critic(critic._tensor(last)).detach(), dones)

    def _weighted(self, rewards: np.ndarray, costs: np.ndarray) -> np.ndarray:
        """Return the advantages that the policy learns on, float32 of the arguments' shape."""
        weight = self.constraint.value
        # 0 times a cost that has diverged is no number.
        if weight == 0.0:
            return rewards
        scale = rewards.std() / max(costs.std(), _LEAST_SPREAD)
        return ((rewards - weight * scale * costs) / (1.0 + weight)).astype(np.float32)

    def plain(self) -> PPO:
        """Return the same model as PPO, whose files Stable-Baselines3 reads by itself."""
        twin: Any = copy.copy(self)
        twin.__class__ = PPO
        for name in _OF_THE_CONSTRAINT:
            del vars(twin)[name]
        return twin

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_costs"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        states, variables = super()._get_torch_save_params()
        return [*states, "cost_critic", "cost_critic.optimizer"], variables
