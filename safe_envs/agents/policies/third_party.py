"""Policies of this project in third-party envs, where they see the state of the model."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.agents.policies.base import Policy
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import FilterSpec


class ModelPolicy(Policy):
    """A policy for the model's problem, from the env's observations to the env's actions.

    Args:
        policy: for the model's problem.
        filter_spec: how a filter sees the env.
        problem: the model as a problem.
        space: of the env's actions.
    """

    def __init__(
        self, policy: Policy, filter_spec: FilterSpec, problem: SafetyProblem, space: Any
    ) -> None:
        self._policy, self._filter_spec, self._space = policy, filter_spec, space
        self.deterministic = policy.deterministic
        self._center, self._half = (np.array(part) for part in center_and_half_width(problem))

    def begin(self, episodes: range, seed: int) -> None:
        """See `Policy.begin`."""
        self._policy.begin(episodes, seed)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions of the env; see `Policy.predict`."""
        x = self._filter_spec.state(observation, np.shape(observation)[:-1])
        actions, state = self._policy.predict(x, state, episode_start, deterministic)
        space = self._space
        return (
            np.clip(
                self._filter_spec.actions(self._center + self._half * actions),
                space.low,
                space.high,
            ).astype(space.dtype),
            state,
        )
