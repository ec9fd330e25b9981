"""Policies of this project in third-party envs, where they see the state of the model."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.agents.policies.base import Policy, Spaces
from safe_envs.agents.policies.observations import rows_of
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import FilterSpec


class ModelPolicy(Policy):
    """A policy for the model's problem, from the env's observations to the env's actions.

    Args:
        policy: for the model's problem.
        filter_spec: how a filter sees the env.
        problem: the model as a problem.
        spaces: of the env's observations and actions.
    """

    def __init__(
        self, policy: Policy, filter_spec: FilterSpec, problem: SafetyProblem, spaces: Spaces
    ) -> None:
        self._policy, self._filter_spec = policy, filter_spec
        self._observations, self._actions = spaces
        self.deterministic = policy.deterministic
        self._center, self._half = (np.array(part) for part in center_and_half_width(problem))

    def begin(self, episodes: range, seed: int) -> None:
        """See `Policy.begin`."""
        self._policy.begin(episodes, seed)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions of the env; see `Policy.predict`."""
        rows, size, is_batch = rows_of(observation, self._observations)
        x = self._filter_spec.state(rows, (size,))
        actions, state = self._policy.predict(x, state, episode_start, deterministic)
        space: Any = self._actions
        inputs = self._filter_spec.actions(self._center + self._half * actions)
        found = np.clip(inputs, space.low, space.high).astype(space.dtype)
        return (found if is_batch else found[0]), state
