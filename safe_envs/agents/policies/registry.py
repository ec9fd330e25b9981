"""What a policy is, and the policies that have a name."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.env import action_box, observation_box
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.problem import SafetyProblem

POLICIES = ("nominal", "clf", "zero", "random")
"""Names that `make_policy` knows besides paths."""

POLICY_FILE = "policy.npz"
"""Name of a policy that was saved as data; see `safe_envs.agents.policies.network`."""

Spaces = tuple[gym.Space[Any], gym.Space[Any]]
"""Of observations and of actions."""


class Policy(ABC):
    """Base of this project's policies, with the `predict` of Stable-Baselines3.

    Attributes:
        deterministic: whether equal observations get equal actions.
    """

    deterministic: bool = True

    def begin(self, episodes: range, seed: int) -> None:  # noqa: B027  (most policies need not know)
        """Learn which episodes the rows of the coming batches belong to, before each wave of an
        evaluation.

        What a policy does in an episode may depend on the episode and the seed, never on the other
        rows: the answer of an evaluation must not depend on the size of its waves.

        Args:
            episodes: one for each row, surplus ones of the last wave included.
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


def make_policy(
    name: str, problem: SafetyProblem, trust: bool = False, spaces: Spaces | None = None
) -> Policy:
    """Return a named policy, or load one that was trained.

    Args:
        name: one of `POLICIES`; the folder where `safe-envs train` or
            `safe_envs.agents.policies.network.save_policy` put a policy, or the path of its .npz;
            or the path of a .zip of Stable-Baselines3.
        problem: which the policy is to act in.
        trust: load a .zip too, which runs code that it contains.
        spaces: of observations and actions, which a .zip is to fit; by default those of the
            problem's env.

    Raises:
        ConfigurationError: there is neither such a name nor such a file, the file does not fit the
            problem, or it is a .zip that is not trusted.
    """
    from safe_envs.agents.policies import nominal
    from safe_envs.agents.policies.clf import CLFController

    named = {
        "nominal": nominal.NominalController,
        "clf": CLFController,
        "zero": nominal.ZeroController,
        "random": nominal.RandomPolicy,
    }
    if name in named:
        return named[name](problem)
    file = policy_file(name)
    if is_data(file):
        from safe_envs.agents.policies.network import load_policy

        return load_policy(name, problem)
    if file is None or not os.path.isfile(file):
        raise ConfigurationError(
            f"unknown policy {shown(name)}; {nearest(name, POLICIES)}, a folder of `safe-envs"
            " train`, or the path of a Stable-Baselines3 .zip: there is no such file"
        )
    return _make_of_archive(file, spaces or (observation_box(problem), action_box(problem)), trust)


def _make_of_archive(path: Path, spaces: Spaces, trust: bool) -> Policy:
    from safe_envs.agents.policies.sb3 import SB3Policy, require_archive

    require_archive(path)
    if not trust:
        raise ConfigurationError(
            f"loading {path} runs code that it contains; if you trust its source, pass --trust (in"
            f" Python: trust=True), or give a folder of `safe-envs train`, whose {POLICY_FILE}"
            " holds no code"
        )
    return SB3Policy(path, *spaces)


def policy_file(name: str) -> Path | None:
    """Return the file that `make_policy` reads; None for one of `POLICIES`."""
    if name in POLICIES:
        return None
    path = Path(name)
    # Unlike a path, this takes any text for the name of a file.
    return path / POLICY_FILE if os.path.isdir(path) else path


def is_data(file: Path | None) -> bool:
    """Return whether a policy's file is one of this project, and not a .zip that holds code."""
    return file is not None and file.suffix == ".npz"
