"""The folder of a training, apart from its checkpoints."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.agents.jobs.store import MOST_BYTES, reading
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.limits import require_judgement
from safe_envs.atomic_io import write_json, writing
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, shortened

CONFIG, EVALUATIONS, PROGRESS, BEST, LOCK = (
    "config.json",
    "evaluations.json",
    "progress.jsonl",
    "best",
    ".lock",
)

SHOWN = ("safety_rate", "ci_low", "ci_high", "return_mean")
"""Statistics of an evaluation that are logged and shown."""

_ADVICE = "start the training again in another folder"


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
