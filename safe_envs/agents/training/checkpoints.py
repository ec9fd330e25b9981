"""Checkpoints of a training: written whole or not at all, and all that it takes to go on as if
nothing had happened.

What a training goes on from is data: JSON, and arrays in safetensors. `model.zip` and
`normalization.pkl` are for the users of Stable-Baselines3; they hold code, and are never read here.
"""

from __future__ import annotations

import io
import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as serialized

from safe_envs.agents.policies.network import save_policy
from safe_envs.agents.policies.registry import POLICY_FILE
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
from safe_envs.atomic_io import write_atomically, write_json, writing
from safe_envs.bounded_reading import open_regular, read_bytes
from safe_envs.errors import ConfigurationError, SafeEnvsError
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

_MOST_TEXT = 1_000_000
"""Bytes of the JSON of a checkpoint, at most: it has a few hundred numbers."""

_HEADER = 1_000_000
"""Bytes, at most, of what a file of arrays has besides them: their names, types and shapes."""

_PER_PARAMETER = 8
"""Numbers, at most, that the networks and optimizers of a learner have for one of a new learner,
which has no optimizers' state yet."""

# What JSON, safetensors and those who read them raise on damaged files.
_DAMAGED = (
    AttributeError,
    ArithmeticError,
    LookupError,
    OSError,
    RecursionError,
    RuntimeError,
    SafetensorError,
    TypeError,
    ValueError,
)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint in the folder of a training."""
    return max(folder.glob(f"{_CHECKPOINT}*"), default=None)


def remove_unfinished(folder: Path) -> None:
    """Remove what a training left that was killed while it wrote a checkpoint."""
    for part in folder.glob(f".{_CHECKPOINT}*"):
        shutil.rmtree(part, ignore_errors=True)


def keep_checkpoint(
    folder: Path, model: Any, problem: SafetyProblem, figures: SafetyFigures, seconds: float
) -> Path:
    """Write a whole checkpoint beside the last one, and only then remove that.

    Args:
        folder: of the training.
        model: as it is between two rollouts.
        problem: of its env.
        figures: of the training so far.
        seconds: that it took.

    Raises:
        ConfigurationError: it cannot be written, as on a full disk; the last one stays.
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
    model.save(archive)
    (part / _MODEL).write_bytes(archive.getvalue())
    scales, buffer = model.get_vec_normalize_env(), getattr(model, "replay_buffer", None)
    if scales is not None:
        scales.save(str(part / _SCALES))
    document = {"format": _FORMAT, "counters": counters(model), **state}
    if buffer is not None:
        (part / _BUFFER).write_bytes(serialized(buffer_arrays(buffer)))
        document["buffer"] = {"pos": buffer.pos, "full": buffer.full}
    (part / _LEARNER).write_bytes(serialized(_contiguous(learner_arrays(model))))
    (part / _ENVS).write_bytes(serialized(_contiguous(env_arrays(model.get_env()))))
    save_policy(model, part, problem, scales)
    write_json(part / _STATE, document)


def restore_model(checkpoint: Path, model: Any, figures: SafetyFigures, n_timesteps: int) -> float:
    """Give a new model what a checkpoint holds; no code of the checkpoint is run.

    Args:
        checkpoint: of a model with the same hyperparameters.
        model: new, over fresh envs, which `resume_episodes` puts where they were.
        figures: new, to go on with those of the checkpoint.
        n_timesteps: after which the training is finished.

    Returns:
        The seconds that the training took until then.

    Raises:
        ConfigurationError: the checkpoint cannot be read, or is that of another model.
    """
    with _reading(checkpoint):
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
        figures.restore(document["counts"])
        if type(document["seconds"]) is not float or not 0.0 <= document["seconds"] < math.inf:
            raise ValueError(f"it took {document['seconds']!r} seconds")
        return document["seconds"]


def resume_episodes(checkpoint: Path, model: Any, seed: int) -> None:
    """Put the envs of a model where they were at its checkpoint, with the randomness of a seed from
    then on.

    A training that goes on does this at each of its checkpoints too, so that one which was
    interrupted does the same.
    """
    with _reading(checkpoint):
        envs = model.get_env()
        restore_envs(envs, _arrays(checkpoint / _ENVS, _size(env_arrays(envs))), seed)


@contextmanager
def _reading(checkpoint: Path) -> Iterator[None]:
    """Say of what damaged files raise which checkpoint it is."""
    try:
        yield
    except SafeEnvsError:
        raise
    except _DAMAGED as error:
        raise ConfigurationError(
            f"the checkpoint {checkpoint} cannot be read ({type(error).__name__}: {error}); start"
            " the training anew in another folder"
        ) from error


def _arrays(path: Path, most: int) -> Arrays:
    """Return the arrays of a file, which together have at most so many bytes.

    Raises:
        OSError: it is no regular file, or larger.
    """
    open_regular(path, most + _HEADER).close()
    return load_file(path)


def _size(arrays: Arrays) -> int:
    """The bytes of arrays."""
    return sum(array.nbytes for array in arrays.values())


def _contiguous(arrays: Arrays) -> Arrays:
    """The arrays in the order in which safetensors reads them."""
    return {name: np.array(array, order="C") for name, array in arrays.items()}


def copy_policy(checkpoint: Path, target: Path) -> None:
    """Copy what an evaluation reads, and what Stable-Baselines3 does."""
    with writing(target):
        target.mkdir(exist_ok=True)
    for name in _OF_THE_POLICY:
        if (checkpoint / name).exists():
            write_atomically(
                target / name, lambda part, name=name: shutil.copyfile(checkpoint / name, part)
            )


def drop_replay_buffer(checkpoint: Path) -> None:
    """Remove the largest part of a checkpoint, which nobody goes on from."""
    with writing(checkpoint):
        (checkpoint / _BUFFER).unlink(missing_ok=True)
