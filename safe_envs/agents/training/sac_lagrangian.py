"""Soft actor-critic with a limit on the expected cost of an episode.

Stable-Baselines3 updates the actor, the critics and the entropy coefficient in one function, which
is used here as it is. PyTorch's hooks add what a constraint needs, at the three places where that
function calls a network or an optimizer:

- the target critic is called with the next states and the actions that the policy takes there:
  these are kept for the targets of the cost critics, which so need no random numbers;
- the critic is called with the states and the policy's actions: first the cost critics take their
  gradient step, and then l s Q_c is subtracted from each Q_r that the critic returns;
- before the actor's optimizer steps, the gradients are divided by 1 + l.

So the actor descends on (alpha log pi - min Q_r + l s max Q_c) / (1 + l), and with l = 0 all
numbers are those of SAC, bit for bit. A loop of training with one gradient step each, the other way
without a copy, would change SAC with a `target_update_interval` above 1.

The scale s is the mean of |min Q_r| over the batch, or a given number. With the former the same
gains of the multiplier serve rewards of any unit: at l = 1 a cost of 1 weighs as much as the
discounted rewards ahead.

Sources: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2018, arXiv:1812.05905;
    Ha et al., "Learning to Walk in the Real World with Minimal Human Effort", 2020,
    arXiv:2002.08550, section 4, on the constraint; Stooke, Achiam, Abbeel, "Responsive Safety in
    Reinforcement Learning by PID Lagrangian Methods", 2020, arXiv:2007.03964, on the multiplier
    and on the division by 1 + l.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional

from safe_envs.agents.training.constraint import (
    EpisodeConstraint,
    costs_of,
    require_at_least_zero,
    require_one_part,
    require_share,
)
from safe_envs.agents.training.replay_buffer import FilteredReplayBuffer
from safe_envs.agents.training.vec_env import of_envs
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


_OF_THE_CRITICS = 0xC057
"""Key of the random numbers of the first weights of cost critics."""

_OF_THE_CONSTRAINT = (
    "cost_limit",
    "cost_unit",
    "cost_gamma",
    "cost_scale",
    "multiplier_gains",
    "constraint",
    "cost_critic",
    "cost_critic_target",
    "_buffer_class",
)


class SACLagrangian(SAC):
    """SAC under the constraint that the mean cost of an episode is at most a limit.

    Twin critics learn the discounted cost, from `info["cost"]`, with an optimizer and with targets
    of their own. Of both the larger value counts, as for rewards the smaller one does. The
    multiplier l of their value in the actor's loss follows the undiscounted cost of the episodes
    that end in training, see `EpisodeConstraint`: those of the policy with its random actions.

    Attributes:
        constraint: the limit, the multiplier and what was measured.
        cost_critic: the critics of the cost.
        cost_critic_target: their targets.

    Args:
        *args: those of SAC.
        cost_limit: greatest expected cost of an episode.
        cost_unit: unit of the excess that the multiplier sees, see `EpisodeConstraint`.
        cost_gamma: discount of the costs; that of the rewards by default.
        cost_scale: s, positive; by default the mean of |min Q_r| over each batch.
        multiplier_kp: proportional gain of the multiplier, see `PIDMultiplier`.
        multiplier_ki: integral gain.
        multiplier_kd: derivative gain.
        multiplier_smoothing: of the measured costs.
        multiplier_most: greatest multiplier.
        **kwargs: those of SAC. The replay buffer is `replay_buffer_class` with costs.

    Raises:
        ConfigurationError: an argument is out of range, the buffer cannot hold costs, or the env
            has observations of several parts.
    """

    def __init__(  # noqa: PLR0913  (hyperparameters)
        self,
        *args: Any,
        cost_limit: float = 0.0,
        cost_unit: float = 1.0,
        cost_gamma: float | None = None,
        cost_scale: float | None = None,
        multiplier_kp: float = 0.5,
        multiplier_ki: float = 0.5,
        multiplier_kd: float = 0.0,
        multiplier_smoothing: float = 0.0,
        multiplier_most: float = 100.0,
        **kwargs: Any,
    ) -> None:
        if cost_gamma is not None:
            require_share("cost_gamma", cost_gamma)
        if cost_scale is not None:
            require_at_least_zero("cost_scale", cost_scale)
            if cost_scale == 0.0:
                raise ConfigurationError(f"cost_scale = {cost_scale!r}; give a positive number")
        if kwargs.get("n_steps", 1) != 1:
            raise ConfigurationError(
                f"n_steps = {kwargs['n_steps']!r}: costs have targets of one step; set n_steps=1"
            )
        self.cost_limit, self.cost_unit = cost_limit, cost_unit
        self.cost_gamma, self.cost_scale = cost_gamma, cost_scale
        self.multiplier_gains = {
            "kp": multiplier_kp,
            "ki": multiplier_ki,
            "kd": multiplier_kd,
            "smoothing": multiplier_smoothing,
            "most": multiplier_most,
        }
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        require_one_part(self.observation_space)
        given = vars(self).get("_buffer_class") or self.replay_buffer_class or ReplayBuffer
        self._buffer_class, self.replay_buffer_class = given, with_costs(given)
        super()._setup_model()
        known: EpisodeConstraint | None = vars(self).get("constraint")
        self.constraint = EpisodeConstraint(
            self.cost_limit, self.n_envs, unit=self.cost_unit, gains=self.multiplier_gains
        )
        if known is not None:  # of a file that is being loaded
            self.constraint.multiplier.restore(known.multiplier.state())
        # The policy begins, and explores, as it does without a constraint.
        with th.random.fork_rng(devices=[]):
            if self.seed is not None:
                seed = np.random.SeedSequence(self.seed, spawn_key=(_OF_THE_CRITICS,))
                th.manual_seed(int(seed.generate_state(1)[0]))
            self.cost_critic = self.policy.make_critic()
            self.cost_critic_target = self.policy.make_critic()
        # Even where the policy's critic takes the features that its actor learns.
        self.cost_critic.share_features_extractor = False
        self.cost_critic_target.load_state_dict(self.cost_critic.state_dict())
        self.cost_critic_target.set_training_mode(False)
        self.cost_critic.optimizer = self.policy.optimizer_class(
            self.cost_critic.parameters(),
            lr=self.lr_schedule(1),  # pyright: ignore[reportCallIssue]
            **self.policy.optimizer_kwargs,
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
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
        buffer: Any = self.replay_buffer
        buffer.expect(infos, self.constraint.measure(infos, dones))

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update the multiplier, and then everything else at each gradient step.

        Args:
            gradient_steps: number of them.
            batch_size: of each.
        """
        self.constraint.update()
        self.cost_critic.set_training_mode(True)
        self._update_learning_rate(self.cost_critic.optimizer)
        update = _Update(self)
        with (
            self.critic_target.register_forward_hook(update.keep_next_actions),
            self.critic.register_forward_hook(update.price),
            self.actor.optimizer.register_step_pre_hook(update.shrink),
        ):
            super().train(gradient_steps, batch_size)
        self.cost_critic.set_training_mode(False)
        self.logger.record("train/cost_critic_loss", np.mean(update.losses))
        for name, value in self.constraint.figures().items():
            self.logger.record(f"constraint/{name}", value)

    def plain(self) -> SAC:
        """Return the same model as SAC, whose files Stable-Baselines3 reads by itself."""
        twin: Any = copy.copy(self)
        twin.__class__ = SAC
        twin.replay_buffer_class = self._buffer_class
        for name in _OF_THE_CONSTRAINT:
            del vars(twin)[name]
        return twin

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        states, variables = super()._get_torch_save_params()
        added = ["cost_critic", "cost_critic_target", "cost_critic.optimizer"]
        return [*states, *added], variables


class _Update:
    """The part of a constraint in the gradient steps of one call of `SAC.train`.

    Attributes:
        losses: of the cost critics, at each gradient step.

    Args:
        model: that is trained.
    """

    def __init__(self, model: SACLagrangian) -> None:
        self.losses: list[float] = []
        self._model, self._weight = model, model.constraint.value
        self._next_actions = th.empty(0)

    def keep_next_actions(self, _: Any, inputs: tuple[Any, ...], __: Any) -> None:
        """Keep the actions of the policy in the next states, of which the targets are taken.

        Args:
            _: the target critic.
            inputs: that it was called with: next states and actions.
            __: what it returned.
        """
        self._next_actions = inputs[1]

    def price(self, _: Any, inputs: tuple[Any, ...], values: Any) -> Any:
        """Subtract the priced cost from the values of the policy's actions.

        Args:
            _: the critic.
            inputs: that it was called with: states and actions.
            values: of each critic, shape (batch, 1).

        Returns:
            The values less l s Q_c; None for the values as they are.
        """
        # Those of the replay buffer have no gradient.
        if not inputs[1].requires_grad:
            return None
        self._step()
        # 0 times a cost that has diverged is no number.
        if self._weight == 0.0:
            return None
        scale: Any = self._model.cost_scale
        if scale is None:
            scale = th.cat(values, dim=1).detach().min(dim=1).values.abs().mean()
        price = self._weight * scale * _larger(self._model.cost_critic(*inputs))
        return tuple(value - price for value in values)

    def shrink(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        """Divide the gradients of the actor by 1 + l.

        Args:
            optimizer: of the actor.
            *_: what its step was called with.
        """
        if self._weight == 0.0:
            return
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter.grad.div_(1.0 + self._weight)

    def _step(self) -> None:
        """Take a gradient step of the cost critics, and move their targets."""
        model, critic = self._model, self._model.cost_critic
        buffer: Any = model.replay_buffer
        steps, costs = buffer.last_sample()
        gamma = model.gamma if model.cost_gamma is None else model.cost_gamma
        with th.no_grad():
            ahead = _larger(model.cost_critic_target(steps.next_observations, self._next_actions))
            wanted = costs + (1.0 - steps.dones) * gamma * ahead
        found = critic(steps.observations, steps.actions)
        loss = th.stack([functional.mse_loss(values, wanted) for values in found]).sum() / 2.0
        critic.optimizer.zero_grad()
        loss.backward()
        critic.optimizer.step()
        if len(self.losses) % model.target_update_interval == 0:
            polyak_update(critic.parameters(), model.cost_critic_target.parameters(), model.tau)
        self.losses.append(loss.item())


def _larger(values: tuple[th.Tensor, ...]) -> th.Tensor:
    """Return the largest of the critics' values, shape (batch, 1)."""
    return th.cat(values, dim=1).max(dim=1, keepdim=True).values
