"""Policies that Stable-Baselines3 saved."""

from __future__ import annotations

import pickle
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.policy import Policy
from safe_envs.env import action_box, observation_box
from safe_envs.errors import ConfigurationError
from safe_envs.problem import SafetyProblem

_BLOCK = 128


class SB3Policy(Policy):
    """The policy in a .zip of PPO, A2C, SAC, TD3 or DDPG, asked for its deterministic action.

    Only the policy is built, not the algorithm around it, so that there is no need to know which one saved it.

    A matrix product rounds a row differently in batches of different sizes. So every network call gets a block of
    the same number of rows, with an episode always in the same row of its block.

    Args:
        path: of the file. Loading it runs code that it contains: trust its source.
        problem: which the policy is to act in.

    Raises:
        ConfigurationError: the file is no archive of Stable-Baselines3, or its spaces are not those of the problem.
    """

    def __init__(self, path: str | Path, problem: SafetyProblem) -> None:
        self._offset = 0
        self._network = _load(Path(path))
        _require_equal(path, "observation", self._network.observation_space, observation_box(problem))
        _require_equal(path, "action", self._network.action_space, action_box(problem))

    def begin(self, episodes: range, seed: int) -> None:
        """Remember in which row of its block the first episode belongs; see `Policy.begin`."""
        self._offset = episodes.start % _BLOCK

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: np.ndarray | None = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Ask the network for its deterministic action; see `Policy.predict`."""
        given = np.asarray(observation, dtype=np.float32)
        rows = np.atleast_2d(given)
        end = self._offset + len(rows)
        padded = np.zeros((-(-end // _BLOCK) * _BLOCK, rows.shape[1]), dtype=np.float32)
        padded[self._offset : end] = rows
        blocks = [self._network.predict(padded[k : k + _BLOCK], deterministic=True)[0] for k in range(0, len(padded), _BLOCK)]
        actions = np.concatenate(blocks)[self._offset : end]
        return actions.reshape(*given.shape[:-1], -1), state


def _load(path: Path) -> Any:
    if not _is_archive(path):
        raise ConfigurationError(f"{path} is not a policy that Stable-Baselines3 saved; give the .zip that `model.save(...)` writes")
    import torch
    from stable_baselines3.common.save_util import load_from_zip_file

    # Small networks run many times slower on several threads of a busy machine.
    torch.set_num_threads(1)
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu")
        saved: Mapping[str, Any] = data or {}
        options = dict(saved.get("policy_kwargs") or {})
        if saved.get("use_sde"):
            options["use_sde"] = True
        network = saved["policy_class"](saved["observation_space"], saved["action_space"], _no_learning, **options)
        network.load_state_dict(parameters["policy"])
    except (AttributeError, EOFError, LookupError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError, struct.error) as error:
        raise ConfigurationError(
            f"{path} cannot be read as a policy ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else error!r}); "
            "it is damaged, or another version of Stable-Baselines3 saved it"
        ) from error
    network.set_training_mode(False)
    return network.to("cpu")


def _is_archive(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return {"data", "policy.pth"} <= set(archive.namelist())


def _no_learning(_: float) -> float:
    return 0.0


def _require_equal(path: str | Path, what: str, saved: gym.Space[Any], wanted: gym.spaces.Box) -> None:
    if saved == wanted:
        return
    if not isinstance(saved, gym.spaces.Box) or saved.shape != wanted.shape:
        difference = f"{saved}; the env's is {wanted}"
    else:
        theirs, ours = [f"between {space.low.tolist()} and {space.high.tolist()}" for space in (saved, wanted)]
        difference = f"{theirs}; the env's is {ours}"
    raise ConfigurationError(f"the policy {path} was trained for another {what} space, {difference}")
