"""A cell of a sweep: one evaluation of one policy under one filter, what identifies it, and its
result wherever it is computed."""

from __future__ import annotations

import hashlib
import json
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.evaluate import evaluate, package_versions
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, SafeEnvsError, shortened
from safe_envs.problem.options import OPTION_NAMES, PARAMETER_GROUPS
from safe_envs.registry import which_env

ENV_OPTIONS = ("system", *(name for name in OPTION_NAMES if name not in PARAMETER_GROUPS))
"""Settings that are arguments of `gym.make`."""

_FRAMES = 3
"""How many lines of code an unexpected error is told with."""

_ONE_AT_A_TIME = threading.Lock()
"""A Dask worker may have several threads, but neither SymPy nor the limits of threadpoolctl are
made for that."""


@dataclass(frozen=True)
class Cell:
    """One evaluation of a sweep.

    Attributes:
        settings: value of every setting that is not the env's own, by name; paths are absolute.
        files: SHA-256 of each file that it reads, by path.
        versions: those by which it is to be computed; see `versions`.
        trust: load a policy's .zip, which runs code that it contains.
    """

    settings: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False

    @property
    def key(self) -> str:
        """Identifies the cell by all that its result hangs on: 32 hexadecimal digits."""
        parts = [dict(self.settings), dict(self.files), dict(self.versions)]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]

    @property
    def env_id(self) -> str:
        """Id of the env that it simulates; for a system of one's own, the id behind which such
        systems are.

        Raises:
            ConfigurationError: there is no such id, or neither or both of env and system are given.
        """
        return which_env(self.settings.get("env"), self.settings.get("system"))

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `gym.make`."""
        options = {name: self.settings[name] for name in ENV_OPTIONS if name in self.settings}
        for group in PARAMETER_GROUPS:
            of_group = {
                name.partition(".")[2]: value
                for name, value in self.settings.items()
                if name.startswith(f"{group}.")
            }
            if of_group:
                options[group] = of_group
        return options


@dataclass(frozen=True)
class Outcome:
    """What became of a cell.

    Attributes:
        key: of the cell.
        row: of the evaluation; None if it failed.
        config: of the evaluation; None if it failed.
        error: why it failed, if it did.
        seconds: how long it took, the only part that depends on where it was computed.
    """

    key: str
    row: dict[str, Any] | None
    config: dict[str, Any] | None
    error: str | None
    seconds: float


def compute(cell: Cell) -> Outcome:
    """Compute a cell, in any process that has this project in the same versions. What goes wrong is
    in the outcome."""
    from threadpoolctl import threadpool_limits

    began = time.perf_counter()
    try:
        # Cells run side by side already.
        with _ONE_AT_A_TIME, threadpool_limits(1):
            row, config = _evaluated(cell)
    except SafeEnvsError as error:
        return Outcome(cell.key, None, None, str(error), time.perf_counter() - began)
    except Exception as error:
        return Outcome(
            cell.key,
            None,
            None,
            f"{type(error).__name__}: {error}{_where(error)}",
            time.perf_counter() - began,
        )
    return Outcome(cell.key, row, config, None, time.perf_counter() - began)


def _where(error: Exception) -> str:
    """The last lines of code that led to an error, with as much of their files' paths as is the
    same on all machines."""
    frames = traceback.extract_tb(error.__traceback__)[-_FRAMES:]
    places = [
        f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno} in {frame.name}"
        for frame in frames
    ]
    return f" (at {', from '.join(reversed(places))})"


def _evaluated(cell: Cell) -> tuple[dict[str, Any], dict[str, Any]]:
    _require_alike(cell)
    settings = cell.settings
    answer = evaluate(
        cell.env_id,
        settings["policy"],
        [settings["filter"]],
        trust=cell.trust,
        options=cell.options,
        episodes=settings["episodes"],
        seed=settings["seed"],
        knowledge=settings["knowledge"],
        objective=settings["objective"],
        bounds=settings["bounds"],
    )
    return answer.rows[0], answer.config


def _require_alike(cell: Cell) -> None:
    """Check that this process has the versions and the files of the one that wrote the cell.

    Raises:
        ConfigurationError: it has not.
    """
    here = versions()
    differing = [
        f"{name} {here.get(name, 'missing')} in place of {value}"
        for name, value in cell.versions.items()
        if here.get(name) != value
    ]
    if differing:
        raise ConfigurationError(
            f"the worker has {', '.join(differing)}; install the same versions on all machines"
        )
    for path, digest in cell.files.items():
        if checksum(Path(path)) != digest:
            raise ConfigurationError(
                f"the worker finds another content in {path}; put all files of a sweep on a disk"
                " that workers share"
            )


def checksum(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        ConfigurationError: it cannot be read.
    """
    try:
        return hashlib.sha256(read_bytes(path)).hexdigest()
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read ({error.strerror}); check the path, and that it is"
            " on a disk that all workers of the sweep share"
        ) from error


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages on which results depend, and a checksum of this
    project's own code."""
    digest = hashlib.sha256()
    root = Path(str(files("safe_envs")))
    for path in sorted(root.rglob("*.py")):
        if not path.is_relative_to(root / "scripts"):
            digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return {**package_versions(), "source": digest.hexdigest()[:16]}
