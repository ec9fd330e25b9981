"""The critic of the costs of a constrained on-policy algorithm."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.utils import explained_variance
from torch import nn
from torch.nn import functional

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
