"""Policies that ask a network, for blocks of the same number of observations."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from safe_envs.agents.policies.base import Policy, checked_observation

BLOCK = 128
"""Observations in a block."""


class BlockPolicy(Policy):
    """Base of the policies that are networks.

    A matrix product rounds a row differently in batches of different sizes. So every network call
    gets a block of the same number of rows, with an episode always in the same row of its block.

    Args:
        width: number k of the entries of an observation.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._offset = 0

    @abstractmethod
    def act(self, block: np.ndarray) -> np.ndarray:
        """Return the actions (BLOCK, m) at observations (BLOCK, k) in float32."""

    def begin(self, episodes: range, seed: int) -> None:
        """Remember in which row of its block the first episode belongs; see `Policy.begin`."""
        self._offset = episodes.start % BLOCK

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Ask the network for its deterministic action; see `Policy.predict`.

        Raises:
            InvalidInputError: the observation has another shape than (k,) or (B, k).
        """
        given = checked_observation(observation, self._width)
        rows = np.atleast_2d(given)
        end = self._offset + len(rows)
        padded = np.zeros((-(-end // BLOCK) * BLOCK, self._width), dtype=np.float32)
        padded[self._offset : end] = rows
        actions = np.concatenate(
            [self.act(padded[k : k + BLOCK]) for k in range(0, len(padded), BLOCK)]
        )[self._offset : end]
        return actions.reshape(*given.shape[:-1], -1), state
