"""The interface of a policy, and the name of the file of a saved one."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.errors import InvalidInputError

POLICY_FILE = "policy.npz"
"""Name of the file of a policy that was saved as data; see `safe_envs.agents.policies.network`."""

Spaces = tuple[gym.Space[Any], gym.Space[Any]]
"""The spaces of observations and of actions."""


class Policy(ABC):
    """Base of this project's policies, with the `predict` of Stable-Baselines3.

    Attributes:
        deterministic: whether equal observations get equal actions.
    """

    deterministic: bool = True

    def begin(self, episodes: range, seed: int) -> None:  # noqa: B027  (most policies ignore it)
        """Receive the episodes of the rows of the coming batches, before each batch of episodes.

        The actions in an episode may depend on the episode and the seed, never on the other rows:
        the result of an evaluation must not depend on the size of its batches.

        Args:
            episodes: one for each row, surplus rows of the last batch included.
            seed: of the evaluation.
        """

    @abstractmethod
    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions.

        Args:
            observation: one observation (k,) or a batch (B, k).
            state: hidden state of a recurrent policy, passed through.
            episode_start: whether each episode starts here; for recurrent policies.
            deterministic: ask for the mean action of a random policy that has one.

        Returns:
            Actions in [-1, 1], shape (m,) or (B, m), and the hidden state.
        """


def checked_observation(observation: Any, width: int) -> np.ndarray:
    """Return observations in double precision.

    Args:
        observation: one observation (width,) or a batch (B, width).
        width: number of entries of an observation.

    Raises:
        InvalidInputError: The observation has another shape.
    """
    given = np.asarray(observation, dtype=np.float64)
    if given.ndim not in (1, 2) or given.shape[-1] != width:
        raise InvalidInputError(
            f"the observation has shape {given.shape}; the policy takes ({width},) or (B, {width})"
        )
    return given


def saved_policy_file(path: Path) -> Path | None:
    """Return the file of a policy that was saved as data; None where the path names no such one.

    Args:
        path: of its folder, or of the file itself.
    """
    # Unlike a path, os.path takes any text for the name of a file.
    if os.path.isdir(path):
        return path / POLICY_FILE
    return path if path.suffix == ".npz" else None
