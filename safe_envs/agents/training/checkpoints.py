"""Checkpoints of a training, from which it goes on exactly as if it had not been interrupted.

A training resumes from data: JSON, and arrays in safetensors. `model.zip` and `normalization.pkl`
are for users of Stable-Baselines3; they hold code, and are never read here.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load_file
from safetensors.numpy import save as serialized

from safe_envs.agents.jobs.store import MOST_BYTES, package_versions, reading
from safe_envs.agents.policies.names import POLICY_FILE
from safe_envs.agents.policies.network import save_policy
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.constraint import require_judgement
from safe_envs.agents.training.learner_state import (
    Arrays,
    begin,
    buffer_arrays,
    counters,
    env_arrays,
    learner_arrays,
    restore_buffer,
    restore_envs,
    restore_learner,
)
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.files import open_regular, read_bytes, write_atomically, write_json, writing
from safe_envs.problem.problem import SafetyProblem

if TYPE_CHECKING:
    from safe_envs.agents.training.callbacks import SafetyFigures


_STATE, _LEARNER, _BUFFER, _ENVS = (
    "state.json",
    "learner.safetensors",
    "replay_buffer.safetensors",
    "envs.safetensors",
)
_MODEL, _SCALES = "model.zip", "normalization.pkl"
_OF_THE_POLICY = (_MODEL, _SCALES, POLICY_FILE)
_CHECKPOINT = "checkpoint_"
_FORMAT = 2
_ADVICE = "start the training again in another folder"

_MOST_TEXT = 1_000_000
"""Bytes of the JSON of a checkpoint, at most: it has a few hundred numbers."""

_HEADER = 1_000_000
"""Bytes, at most, of the names, types and shapes in a file of arrays."""

_PER_PARAMETER = 8
"""Ratio, at most, of the size of a learner with the states of its optimizers to that without."""


def last_checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint in the folder of a training."""
    return max(folder.glob(f"{_CHECKPOINT}*"), default=None)


def remove_unfinished(folder: Path) -> None:
    """Remove what a training left that was killed while writing a checkpoint."""
    for part in folder.glob(f".{_CHECKPOINT}*"):
        shutil.rmtree(part, ignore_errors=True)


def keep_checkpoint(
    folder: Path, model: Any, problem: SafetyProblem, figures: SafetyFigures, seconds: float
) -> Path:
    """Write a complete checkpoint, and only then remove the previous one.

    Args:
        folder: of the training.
        model: between two rollouts.
        problem: of its env.
        figures: of the training so far.
        seconds: that it took.

    Returns:
        The path of the checkpoint.

    Raises:
        ConfigurationError: it cannot be written, as on a full disk; the previous one remains.
    """
    before = list(folder.glob(f"{_CHECKPOINT}*"))
    target = folder / f"{_CHECKPOINT}{model.num_timesteps:012d}"
    part = folder / f".{target.name}"
    try:
        with writing(target):
            part.mkdir()
            _write(part, model, problem, {"counts": figures.counts, "seconds": seconds})
            part.rename(target)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    for old in before:
        with writing(old):
            shutil.rmtree(old)
    return target


def _write(part: Path, model: Any, problem: SafetyProblem, state: dict[str, Any]) -> None:
    # Where a file cannot take what it writes, PyTorch does not say why.
    archive = io.BytesIO()
    # Stable-Baselines3 reads its own classes only.
    (model.plain() if hasattr(model, "plain") else model).save(archive)
    (part / _MODEL).write_bytes(archive.getvalue())
    scales, buffer = model.get_vec_normalize_env(), getattr(model, "replay_buffer", None)
    if scales is not None:
        scales.save(str(part / _SCALES))
    document = {"format": _FORMAT, "counters": counters(model), **state}
    if hasattr(model, "constraint"):
        document["constraint"] = model.constraint.state()
    if buffer is not None:
        (part / _BUFFER).write_bytes(serialized(buffer_arrays(buffer)))
        document["buffer"] = {"pos": buffer.pos, "full": buffer.full}
    (part / _LEARNER).write_bytes(serialized(_contiguous(learner_arrays(model))))
    (part / _ENVS).write_bytes(serialized(_contiguous(env_arrays(model.get_env()))))
    save_policy(model, part, problem, scales)
    write_json(part / _STATE, document)


def restore_model(checkpoint: Path, model: Any, figures: SafetyFigures, n_timesteps: int) -> float:
    """Restore a model from a checkpoint, without running code from it.

    Args:
        checkpoint: of a model with the same hyperparameters.
        model: new, over fresh envs, whose episodes `resume_episodes` restores.
        figures: new, to go on with those of the checkpoint.
        n_timesteps: after which the training is finished.

    Returns:
        Seconds that the training had taken by then.

    Raises:
        ConfigurationError: the checkpoint cannot be read, see `reading`, or is that of another
            model.
    """
    with reading(checkpoint, _ADVICE):
        document = json.loads(read_bytes(checkpoint / _STATE, _MOST_TEXT))
        if not isinstance(document, dict):
            raise ValueError(f"{_STATE} holds no names with values")
        if document.get("format") != _FORMAT:
            raise ConfigurationError(
                f"{checkpoint} was written by another version, whose checkpoints this one does not"
                " read; go on with the version that wrote it, or start the training again in"
                " another folder"
            )
        begin(model)
        restore_learner(
            model,
            _arrays(checkpoint / _LEARNER, _PER_PARAMETER * _size(learner_arrays(model))),
            document["counters"],
        )
        buffer = getattr(model, "replay_buffer", None)
        # A finished training has dropped its buffer.
        if buffer is not None and (
            model.num_timesteps < n_timesteps or (checkpoint / _BUFFER).exists()
        ):
            most = sum(getattr(buffer, name).nbytes for name in buffer_arrays(buffer))
            restore_buffer(
                buffer,
                _arrays(checkpoint / _BUFFER, most),
                document["buffer"]["pos"],
                document["buffer"]["full"],
            )
        if hasattr(model, "constraint"):
            model.constraint.restore(document["constraint"])
        figures.restore(document["counts"])
        if type(document["seconds"]) is not float or not 0.0 <= document["seconds"] < math.inf:
            raise ValueError(f"it took {document['seconds']!r} seconds")
        return document["seconds"]


def resume_episodes(checkpoint: Path, model: Any, seed: int) -> None:
    """Restore the episodes of a checkpoint, with the randomness of a seed from then on.

    A training does this at each of its checkpoints, so that an interrupted one does the same.

    Args:
        checkpoint: of the model.
        model: whose envs to restore.
        seed: of the episodes from then on.
    """
    with reading(checkpoint, _ADVICE):
        envs = model.get_env()
        restore_envs(envs, _arrays(checkpoint / _ENVS, _size(env_arrays(envs))), seed)


def _arrays(path: Path, most: int) -> Arrays:
    """Return the arrays of a file, or raise OSError where it is none, or has more bytes of them."""
    open_regular(path, most + _HEADER).close()
    return load_file(path)


def _size(arrays: Arrays) -> int:
    """Return the total size of arrays in bytes."""
    return sum(array.nbytes for array in arrays.values())


def _contiguous(arrays: Arrays) -> Arrays:
    """Return the arrays in the memory layout that safetensors reads."""
    return {name: np.array(array, order="C") for name, array in arrays.items()}


def copy_policy(checkpoint: Path, target: Path) -> None:
    """Copy the files of the policy, those for Stable-Baselines3 included.

    Args:
        checkpoint: to copy from.
        target: folder to copy to.
    """
    with writing(target):
        target.mkdir(exist_ok=True)
    for name in _OF_THE_POLICY:
        if (checkpoint / name).exists():
            write_atomically(
                target / name, lambda part, name=name: shutil.copyfile(checkpoint / name, part)
            )


def drop_replay_buffer(checkpoint: Path) -> None:
    """Remove the largest part of a finished training's checkpoint."""
    with writing(checkpoint):
        (checkpoint / _BUFFER).unlink(missing_ok=True)


CONFIG, EVALUATIONS, PROGRESS, BEST, LOCK = (
    "config.json",
    "evaluations.json",
    "progress.jsonl",
    "best",
    ".lock",
)

SHOWN = ("safety_rate", "ci_low", "ci_high", "return_mean")
"""Statistics of an evaluation that are logged and shown."""


def require_folder(folder: Path, training: Training, resume: bool) -> None:
    """Check that a folder is new, or with `resume` that of the same training.

    Args:
        folder: of the training.
        training: to do.
        resume: whether to go on with it.

    Raises:
        ConfigurationError: it is not.
    """
    if resume:
        _require_same_training(folder, training)
    # A training that did not reach its first checkpoint leaves nothing that could be lost.
    elif os.path.isdir(folder):
        if not {path.name for path in folder.iterdir()} <= {CONFIG, EVALUATIONS, PROGRESS, LOCK}:
            raise _occupied(folder, "is not empty")
    elif os.path.exists(folder):
        raise _occupied(folder, "is a file")


def _occupied(folder: Path, what: str) -> ConfigurationError:
    return ConfigurationError(
        f"--out {folder} {what}; give a new folder, or go on with the training in one by --resume"
    )


def _require_same_training(folder: Path, training: Training) -> None:
    path = folder / CONFIG
    if not os.path.isfile(path):
        raise ConfigurationError(
            f"--resume: {shortened(folder)} holds no training; start it without --resume"
        )
    with reading(path, _ADVICE):
        known = _flat(_read(path)["training"])
    unknown = sorted(asdict(training).keys() - known)
    if unknown:
        raise ConfigurationError(
            f"--resume: the training in {folder} was started by another version, which had no"
            f" {', '.join(unknown)}; go on with that version, or start it again in another folder"
        )
    wanted = _flat(json.loads(json.dumps(asdict(training))))
    # These may change others too, such as a default.
    first = ("env_id", "system", "algorithm", "n_timesteps")
    for name in (*first, *sorted({*known, *wanted}.difference(first))):
        if known.get(name) != wanted.get(name):
            raise ConfigurationError(
                f"--resume: the training in {folder} has {name} = {known.get(name)!r}, not"
                f" {wanted.get(name)!r}; give the same arguments"
            )


def require_same_versions(folder: Path, versions: Mapping[str, str]) -> None:
    """Check that no agent of other versions of the packages is in a folder.

    Args:
        folder: of a training, begun or not.
        versions: those in use.

    Raises:
        ConfigurationError: the folder has an agent of others, or its file is damaged.
    """
    path = folder / CONFIG
    if not os.path.isfile(path):
        return
    with reading(path, _ADVICE):
        known = dict(_read(path)["versions"])
    changed = sorted(name for name in {*known, *versions} if known.get(name) != versions.get(name))
    if changed:
        others = ", ".join(f"{name} {known.get(name, 'none')}" for name in changed)
        now = ", ".join(f"{name} {versions.get(name, 'none')}" for name in changed)
        raise ConfigurationError(
            f"the agent in {folder} was trained with {others}, and in use is {now}; remove that"
            " folder, and it is trained again, or give another --out"
        )


def _flat(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a training's attributes, with its hyperparameters and a custom system among them."""
    return {
        **document,
        **document["hyperparameters"],
        "hyperparameters": None,
        "system": document["options"].get("system"),
    }


def prepare(folder: Path, training: Training) -> None:
    """Remove the remains of a training without a checkpoint, and write the configuration.

    Args:
        folder: of the training.
        training: to begin.
    """
    with writing(folder):
        for name in (EVALUATIONS, PROGRESS):
            (folder / name).unlink(missing_ok=True)
    write_json(folder / CONFIG, {"training": asdict(training), "versions": package_versions()})


def read_evaluations(folder: Path) -> list[dict[str, Any]]:
    """Return the evaluations so far.

    Raises:
        ConfigurationError: their file is damaged or altered; see `reading`.
    """
    path = folder / EVALUATIONS
    if not path.exists():
        return []
    with reading(path, _ADVICE):
        rows = _read(path)
        for row in rows:
            numbers = [row["timesteps"], *(row[name] for name in SHOWN)]
            numbers += [row["episodes"], row["training"]["violations"]]
            if "constraint" in row:
                require_judgement(row["constraint"])
            if not all(type(n) in (int, float) and math.isfinite(n) for n in numbers):
                raise ValueError(f"its numbers are {numbers}")
        json.dumps(rows, allow_nan=False)  # as it is to be written again
    return rows


def _read(path: Path) -> Any:
    return json.loads(read_bytes(path, MOST_BYTES))
