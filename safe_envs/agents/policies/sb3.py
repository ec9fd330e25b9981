"""Policies that Stable-Baselines3 saved."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import BlockPolicy, require_spaces
from safe_envs.bounded_reading import open_archive, open_regular
from safe_envs.errors import ConfigurationError, shortened

_MOST_BYTES = 100_000_000
_STATISTICS = ("normalization.pkl", "vecnormalize.pkl", "*/vecnormalize.pkl")
"""Where the VecNormalize of a .zip lies: that of `safe-envs train`, one of RL Zoo, and the place
where RL Zoo itself puts it."""


class SB3Policy(BlockPolicy):
    """The policy in a .zip of PPO, A2C, SAC, TD3 or DDPG, asked for its deterministic action.

    Only the policy is built, not the algorithm around it, so that there is no need to know which
    one saved it. The file does not say for which inputs its actions stand: that is left to the
    problem's input bounds.

    Args:
        path: of the file. Loading it runs code that it contains: trust its source.
        observation_space: of the env that the policy is to act in.
        action_space: of that env.

    Raises:
        ConfigurationError: the file is no archive of Stable-Baselines3, or its spaces are not those
            of the env; or the VecNormalize of its training lies next to it, whose observations are
            not the env's.
    """

    def __init__(
        self, path: str | Path, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(gym.spaces.flatdim(observation_space))
        self._network = _load(Path(path))
        require_spaces(f"the policy {path}", self._network, observation_space, action_space)

    def act(self, block: np.ndarray) -> np.ndarray:
        """Call the network; see `BlockPolicy.act`."""
        return self._network.predict(block, deterministic=True)[0]


def require_archive(path: Path) -> None:
    """Raise ConfigurationError unless a file looks like a policy of Stable-Baselines3.

    Nothing in it is run.
    """
    if not _is_archive(path):
        raise ConfigurationError(
            f"{path} is not a policy that Stable-Baselines3 saved, or damaged, or larger than"
            f" {_MOST_BYTES / 1e6:g} MB; give a .zip of `model.save(...)`, or a folder of"
            " `safe-envs train`"
        )
    statistics = next(
        (found for name in _STATISTICS for found in sorted(path.parent.glob(name))), None
    )
    if statistics is not None:
        raise ConfigurationError(
            f"{path} is not the whole policy: it was trained on normalised observations, and how"
            f" these are normalised stands in {statistics}, not in the .zip. Give the folder of"
            " `safe-envs train`, or write the policy with its normalisation by"
            " safe_envs.agents.policies.network.save_policy(model, folder, problem, normalization)"
            " and give that folder"
        )


def _is_archive(path: Path) -> bool:
    """Whether a file has the parts of a policy, none of which is large when it is unpacked."""
    try:
        with (
            open_regular(path, _MOST_BYTES) as stream,
            open_archive(stream, _MOST_BYTES) as archive,
        ):
            if not {"data", "policy.pth"} <= set(archive.namelist()):
                return False
            # What torch saves is an archive itself.
            inner = [
                content
                for name in archive.namelist()
                if (content := archive.read(name)).startswith(b"PK")
            ]
            for content in inner:
                open_archive(io.BytesIO(content), _MOST_BYTES).close()
            return True
    except (
        OSError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        ValueError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        return False


def _load(path: Path) -> Any:
    require_archive(path)
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
        network = saved["policy_class"](
            saved["observation_space"], saved["action_space"], _no_learning, **options
        )
        network.load_state_dict(parameters["policy"])
    except Exception as error:  # What a pickle may raise has no limits.
        raise ConfigurationError(
            f"{path} cannot be read as a policy ({type(error).__name__}:"
            f" {shortened(str(error).partition(chr(10))[0])}); it is damaged, or another version of"
            " Stable-Baselines3 saved it"
        ) from error
    network.set_training_mode(False)
    return network.to("cpu")


def _no_learning(_: float) -> float:
    return 0.0
