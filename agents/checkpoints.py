"""Checkpoints of a training: written whole or not at all, and all that it takes to go on as if nothing had happened.

The last one is a pickle of Stable-Baselines3 in part: restore only your own.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from agents.algorithms import algorithm_class
from agents.policy import DESCRIPTION, TENSORS
from agents.weights import save_policy
from safe_envs.errors import ConfigurationError
from safe_envs.files import write_atomically, write_json
from safe_envs.problem import SafetyProblem

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

_STATE, _MODEL, _BUFFER, _SCALES, _ENVS = "state.json", "model.zip", "replay_buffer.pkl", "normalization.pkl", "envs.npz"
_OF_THE_POLICY = (_MODEL, _SCALES, TENSORS, DESCRIPTION)
_CHECKPOINT = "checkpoint_"

# What zip archives, pickles and those who read them raise on damaged files.
_DAMAGED = (AttributeError, EOFError, ImportError, LookupError, OSError, RuntimeError, TypeError, ValueError, UnpicklingError, BadZipFile)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint in the folder of a training."""
    return max(folder.glob(f"{_CHECKPOINT}*"), default=None)


def keep_checkpoint(folder: Path, model: Any, problem: SafetyProblem, state: Mapping[str, Any]) -> Path:
    """Write a whole checkpoint beside the last one, and only then remove that.

    Args:
        folder: of the training.
        model: as it is between two rollouts.
        problem: of its env.
        state: JSON-able, returned by `read_state`.
    """
    before = list(folder.glob(f"{_CHECKPOINT}*"))
    target = folder / f"{_CHECKPOINT}{model.num_timesteps:012d}"
    part = folder / f".{target.name}"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    model.save(part / _MODEL)
    if hasattr(model, "save_replay_buffer"):
        model.save_replay_buffer(part / _BUFFER)
    scales = model.get_vec_normalize_env()
    if scales is not None:
        scales.save(str(part / _SCALES))
    arrays: Any = _snapshot(model.get_env())
    np.savez(part / _ENVS, **arrays)
    save_policy(model, part, problem, scales)
    write_json(part / _STATE, state)
    part.rename(target)
    for old in before:
        shutil.rmtree(old)
    return target


def restored_model(checkpoint: Path, algorithm: str, envs: VecEnv) -> Any:
    """The model of a checkpoint, over fresh envs; `resume_episodes` puts these where they were.

    Raises:
        ConfigurationError: the checkpoint cannot be read.
    """
    try:
        if (checkpoint / _SCALES).exists():
            from stable_baselines3.common.vec_env import VecNormalize

            envs = VecNormalize.load(str(checkpoint / _SCALES), envs)
        model: Any = algorithm_class(algorithm).load(checkpoint / _MODEL, env=envs, device="cpu", force_reset=False)
        if (checkpoint / _BUFFER).exists():
            model.load_replay_buffer(checkpoint / _BUFFER)
    except _DAMAGED as error:
        raise ConfigurationError(
            f"the checkpoint {checkpoint} cannot be read ({type(error).__name__}: {error}); start the training anew in another folder"
        ) from error
    return model


def read_state(checkpoint: Path) -> dict[str, Any]:
    """What was given to `keep_checkpoint`."""
    return json.loads((checkpoint / _STATE).read_text())


def resume_episodes(checkpoint: Path, model: Any, seed: int) -> None:
    """Put the envs of a model where they were at its checkpoint, with the randomness of a seed from then on.

    A training that goes on does this at each of its checkpoints too, so that one which was interrupted does the same.
    """
    with np.load(checkpoint / _ENVS) as arrays:
        _restore(model.get_env(), dict(arrays), seed)


def copy_policy(checkpoint: Path, target: Path) -> None:
    """Copy what an evaluation reads, and what Stable-Baselines3 does."""
    target.mkdir(exist_ok=True)
    for name in _OF_THE_POLICY:
        if (checkpoint / name).exists():
            write_atomically(target / name, lambda part, name=name: shutil.copyfile(checkpoint / name, part))


def drop_replay_buffer(checkpoint: Path) -> None:
    """Remove the largest part of a checkpoint, which nobody goes on from."""
    (checkpoint / _BUFFER).unlink(missing_ok=True)


def _snapshot(envs: VecEnv) -> dict[str, np.ndarray]:
    """Where the episodes of a `SafeVecEnv` and of the VecMonitor and VecNormalize over it stand, as arrays by name."""
    found = dict(envs.unwrapped.snapshot())  # pyright: ignore[reportAttributeAccessIssue]
    return found | {f"{name}_of_layers": getattr(layer, name) for layer, name in _sums(envs)}


def _restore(envs: VecEnv, arrays: Mapping[str, np.ndarray], seed: int) -> None:
    """Go on from a `_snapshot`, with the randomness of a seed."""
    envs.unwrapped.restore(arrays, seed)  # pyright: ignore[reportAttributeAccessIssue]
    for layer, name in _sums(envs):
        setattr(layer, name, arrays[f"{name}_of_layers"].copy())


def _sums(envs: VecEnv) -> list[tuple[Any, str]]:
    """What the wrappers add up in an episode."""
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize, unwrap_vec_wrapper

    monitor, scales = (unwrap_vec_wrapper(envs, layer) for layer in (VecMonitor, VecNormalize))
    of_monitor = [] if monitor is None else [(monitor, "episode_returns"), (monitor, "episode_lengths")]
    return of_monitor + ([] if scales is None else [(scales, "returns")])
