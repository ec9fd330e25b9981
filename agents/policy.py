"""What a policy is, and the policies that have a name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.problem import SafetyProblem

POLICIES = ("nominal", "clf", "zero", "random")
"""Names that `make_policy` knows besides the path of a file."""


class Policy(ABC):
    """Base of this project's policies, with the `predict` of Stable-Baselines3.

    Attributes:
        deterministic: whether equal observations get equal actions.
    """

    deterministic: bool = True

    def begin(self, episodes: range, seed: int) -> None:  # noqa: B027  (most policies need not know)
        """Learn which episodes the rows of the coming batches belong to, before each wave of an evaluation.

        What a policy does in an episode may depend on the episode and the seed, never on the other rows: the
        answer of an evaluation must not depend on the size of its waves.

        Args:
            episodes: one for each row, surplus ones of the last wave included.
            seed: of the evaluation.
        """

    @abstractmethod
    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: np.ndarray | None = None, deterministic: bool = False
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


def make_policy(name: str, problem: SafetyProblem) -> Policy:
    """Return a named policy, or load the policy that Stable-Baselines3 saved in a file.

    Args:
        name: one of `POLICIES`, or the path of a .zip. Loading one runs code that it contains: trust its source.
        problem: which the policy is to act in.

    Raises:
        ConfigurationError: there is neither such a name nor such a file, or the file does not fit the problem.
    """
    from agents import nominal
    from agents.clf import CLFController

    named = {
        "nominal": nominal.NominalController,
        "clf": CLFController,
        "zero": nominal.ZeroController,
        "random": nominal.RandomPolicy,
    }
    if name in named:
        return named[name](problem)
    if not Path(name).is_file():
        raise ConfigurationError(
            f"unknown policy {name!r}; {nearest(name, POLICIES)}, or the path of a Stable-Baselines3 .zip: there is no such file"
        )
    from agents.sb3 import SB3Policy

    return SB3Policy(name, problem)
