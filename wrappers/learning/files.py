"""Learned models and data as files: arrays and JSON in an npz, without pickle, refused where they do not fit or were altered."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.files import write_atomically
from safe_envs.problem import SafetyProblem

_FORMAT = 1
_HEADER = "header"
_PACKAGES = ("safe-envs", "numpy", "sympy", "torch")


# What NumPy, zipfile and json are seen to raise on damaged files.
_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    RuntimeError,
    MemoryError,
    zlib.error,
    zipfile.BadZipFile,
)


class LearnedFileError(ConfigurationError):
    """A file is no learned model or data set of this project, is damaged, or belongs to something else."""


@dataclass(frozen=True)
class Signature:
    """Of which system something was learned.

    Attributes:
        system: name of the problem.
        states: their names, in order.
        state_units: their units.
        inputs: their names, in order.
        input_units: their units.
        dt: control period in s.
        barriers: expressions of the barriers.
        model: parameters that the designer believed.
    """

    system: str
    states: tuple[str, ...]
    state_units: tuple[str, ...]
    inputs: tuple[str, ...]
    input_units: tuple[str, ...]
    dt: float
    barriers: tuple[str, ...] = ()
    model: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, problem: SafetyProblem) -> Signature:
        """The signature of a problem."""
        return cls(
            problem.name,
            tuple(s.symbol.name for s in problem.states),
            tuple(s.unit for s in problem.states),
            tuple(i.symbol.name for i in problem.inputs),
            tuple(i.unit for i in problem.inputs),
            problem.dt,
            tuple(str(problem.model.numeric(b.expression)) for b in problem.barriers),
            tuple(sorted((p.name, v) for p, v in problem.model.parameters.items())),
        )

    def require(self, problem: SafetyProblem, *also: str) -> None:
        """Raise LearnedFileError unless this was learned of a problem's system.

        Args:
            problem: for which it is to be used.
            *also: further attributes that must be the same: "barriers", "model", "dt".
        """
        wanted = Signature.of(problem)
        for name in ("system", "states", "state_units", "inputs", "input_units", *also):
            mine, other = getattr(self, name), getattr(wanted, name)
            if mine != other:
                raise LearnedFileError(
                    f"what was learned is of another problem: its {name.replace('_', ' ')}: {mine}, that of {problem.name}: {other}; "
                    "learn again, by `safe-envs identify`"
                )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signature:
        """Read what `asdict` and JSON made of one."""
        found = dict(data)
        for name in ("states", "state_units", "inputs", "input_units", "barriers"):
            found[name] = tuple(found[name])
        found["model"] = tuple((name, float(value)) for name, value in found["model"])
        if set(found) != {f.name for f in fields(cls)}:
            raise KeyError("signature")
        return cls(**found)


@dataclass(frozen=True)
class Content:
    """What a file holds.

    Attributes:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: by name.
        sha256: checksum of it all.
    """

    kind: str
    signature: Signature
    details: dict[str, Any]
    arrays: dict[str, np.ndarray]
    sha256: str


def checksum(kind: str, signature: Signature, details: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of everything that is saved, as hexadecimal digits."""
    digest = hashlib.sha256(json.dumps([kind, asdict(signature), details], sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def save(path: Path, kind: str, signature: Signature, details: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file, whole or not at all.

    Args:
        path: where.
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name; none may be called "header".

    Raises:
        ConfigurationError: it cannot be written there.
    """
    header = {
        "format": _FORMAT,
        "kind": kind,
        "signature": asdict(signature),
        "details": dict(details),
        "versions": {package: version(package) for package in _PACKAGES},
        "sha256": checksum(kind, signature, details, arrays),
    }
    encoded = np.frombuffer(json.dumps(header, allow_nan=False).encode(), dtype=np.uint8)

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            _savez(stream, {_HEADER: encoded, **arrays})

    write_atomically(path, write)


def _savez(stream: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(stream, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})  # pyright: ignore[reportArgumentType]


def load(path: Path) -> Content:
    """Read a file.

    Raises:
        LearnedFileError: it is missing, no such file, truncated or altered.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays.pop(_HEADER).tobytes().decode())
        if header["format"] != _FORMAT:
            raise LearnedFileError(f"{path} has the format {header['format']}; this version reads {_FORMAT}. Learn again")
        signature = Signature.from_json(header["signature"])
        content = Content(header["kind"], signature, header["details"], arrays, header["sha256"])
    except FileNotFoundError as error:
        raise LearnedFileError(f"{path} does not exist; `safe-envs identify` writes such files") from error
    except _DAMAGED as error:
        if isinstance(error, LearnedFileError):
            raise
        raise LearnedFileError(f"{path} is no file of `safe-envs identify`, or it is truncated ({type(error).__name__})") from error
    if content.sha256 != checksum(content.kind, signature, content.details, arrays):
        raise LearnedFileError(f"{path} was altered: its content does not match its checksum. Learn again")
    return content
