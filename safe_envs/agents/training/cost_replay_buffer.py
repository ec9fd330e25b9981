"""Replay buffers that hold the cost of each step in addition to its reward."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from safe_envs.agents.training.constraint import costs_of
from safe_envs.agents.training.lazy_info import of_envs
from safe_envs.agents.training.replay_buffer import FilteredReplayBuffer
from safe_envs.errors import ConfigurationError


class CostSamples(NamedTuple):
    """A batch of steps with their costs.

    Attributes:
        steps: what `ReplayBuffer.sample` returned.
        costs: of these steps, tensor of shape (batch, 1).
    """

    steps: Any
    costs: Any


class CostReplayBuffer(ReplayBuffer):
    """A replay buffer with the costs of the steps, from `info["cost"]`.

    `sample` returns what that of Stable-Baselines3 does, after the same random numbers; the costs
    of the same steps are in `last_sample()`.

    Attributes:
        costs: float32 (rows, n_envs).

    Args:
        args: those of `ReplayBuffer`.
        kwargs: likewise.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.costs = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self._sampled: CostSamples | None = None
        self._expected: tuple[Any, Any] = (None, None)

    def expect(self, infos: list[dict[str, Any]], costs: np.ndarray) -> None:
        """Take the costs of a step that somebody has found out, in place of `info["cost"]`.

        Args:
            infos: that the step will be added with.
            costs: shape (n_envs,).
        """
        self._expected = infos, costs

    def last_sample(self) -> CostSamples:
        """Return the steps that `sample` returned last, with their costs.

        Raises:
            ConfigurationError: it was not called yet.
        """
        if self._sampled is None:
            raise ConfigurationError("there is no batch yet: call sample() first")
        return self._sampled

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of every env.

        Args:
            obs: shape (n_envs, features).
            next_obs: likewise, the terminal one where an episode ended.
            action: shape (n_envs, m).
            reward: shape (n_envs,).
            done: whether the episode ended, shape (n_envs,).
            infos: of the step just taken, with its cost.

        Raises:
            ConfigurationError: an info has no cost.
        """
        each: Any = of_envs(infos, self.n_envs)
        known, costs = self._expected
        self.costs[self.pos] = costs if known is each else costs_of(each)
        super().add(obs, next_obs, action, reward, done, each)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        # Stable-Baselines3 draws the env of each row where nobody sees it: draw the same envs here,
        # and then let it draw them.
        state = np.random.get_state()  # noqa: NPY002
        envs = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))  # noqa: NPY002
        np.random.set_state(state)  # noqa: NPY002
        steps = super()._get_samples(batch_inds, env=env)
        costs = self.to_torch(self.costs[batch_inds, envs].reshape(-1, 1))
        self._sampled = CostSamples(steps, costs)
        return steps


class FilteredCostReplayBuffer(FilteredReplayBuffer, CostReplayBuffer):
    """A `FilteredReplayBuffer` with the costs of the steps.

    The cost is that of the state which the executed action led to. With "both" the row of the
    proposal has the same one: it is what the filtered env costs if this action is proposed.
    """


def with_costs(kind: type[ReplayBuffer]) -> type[CostReplayBuffer]:
    """Return the replay buffer with costs that stores steps as another one does.

    Args:
        kind: of the other one.

    Raises:
        ConfigurationError: there is none, as for n-step returns.
    """
    if kind is ReplayBuffer:
        return CostReplayBuffer
    if kind is FilteredReplayBuffer:
        return FilteredCostReplayBuffer
    if issubclass(kind, CostReplayBuffer):
        return kind
    raise ConfigurationError(
        f"replay_buffer_class = {kind.__name__} holds no costs, or sums rewards over several steps"
        " (n_steps > 1); give ReplayBuffer or FilteredReplayBuffer, with n_steps = 1"
    )
