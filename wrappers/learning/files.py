"""Learned models and data as files: arrays and JSON in an npz, without pickle, refused where they do not fit or were altered."""

from __future__ import annotations

import hashlib
import json
import math
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
from safe_envs.sde import ControlAffineSDE

DATA = "transitions"
"""Kind of a file that holds data, where others hold what was learned."""

_FORMAT = 2
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
        plant: parameters of the plant that was stepped; empty where they are not known, as for a log.
    """

    system: str
    states: tuple[str, ...]
    state_units: tuple[str, ...]
    inputs: tuple[str, ...]
    input_units: tuple[str, ...]
    dt: float
    barriers: tuple[str, ...] = ()
    model: tuple[tuple[str, float], ...] = ()
    plant: tuple[tuple[str, float], ...] = ()

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
            _parameters(problem.model),
            _parameters(problem.plant),
        )

    def require(self, problem: SafetyProblem, *also: str) -> None:
        """Raise LearnedFileError unless this was learned of a problem's system.

        Args:
            problem: for which it is to be used.
            *also: further attributes that must be the same: "barriers", "model", "dt".
        """
        difference = self.difference(problem, *also)
        if difference:
            raise LearnedFileError(f"what was learned is of another problem: {difference}; learn again, by `safe-envs identify`")

    def difference(self, problem: SafetyProblem, *also: str) -> str:
        """In what this is not of a problem's system, in words; empty if it is. Arguments as for `require`."""
        wanted = Signature.of(problem)
        for name in ("system", "states", "state_units", "inputs", "input_units", *also):
            mine, other = getattr(self, name), getattr(wanted, name)
            if mine != other:
                return f"its {name.replace('_', ' ')}: {mine}, that of {problem.name}: {other}"
        return ""

    def differences(self, problem: SafetyProblem) -> tuple[str, ...]:
        """Parameters of the plant that are not those of a problem's, such as "v = 0.8 (here 1)"; none if they are not known."""
        here = dict(_parameters(problem.plant))
        return tuple(
            f"{name} = {value:.12g} (here {here.get(name, math.nan):.12g})" for name, value in self.plant if here.get(name) != value
        )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signature:
        """Read what `asdict` and JSON made of one."""
        found = dict(data)
        for name in ("states", "state_units", "inputs", "input_units", "barriers"):
            found[name] = tuple(found[name])
        for name in ("model", "plant"):
            found[name] = tuple((parameter, float(value)) for parameter, value in found[name])
        if set(found) != {f.name for f in fields(cls)}:
            raise KeyError("signature")
        return cls(**found)


def _parameters(system: ControlAffineSDE) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((p.name, value) for p, value in system.parameters.items()))


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
    digest = hashlib.sha256(json.dumps([kind, asdict(signature), details], sort_keys=True, default=_plain).encode())
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
    encoded = np.frombuffer(json.dumps(header, allow_nan=False, default=_plain).encode(), dtype=np.uint8)

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            _savez(stream, {_HEADER: encoded, **arrays})

    write_atomically(path, write)


def _savez(stream: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(stream, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})  # pyright: ignore[reportArgumentType]


def _plain(value: Any) -> Any:
    """A number of NumPy, which settings and seeds may be, as one of Python."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} is no JSON")


def load(path: Path) -> Content:
    """Read a file.

    Raises:
        LearnedFileError: it is missing, a folder, no such file, truncated or altered.
    """
    if path.is_dir():
        raise LearnedFileError(f"{path} is a folder; name a file in it that `safe-envs identify` wrote")
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
        raise LearnedFileError(
            f"{path} is no file of `safe-envs identify`, or it is truncated or altered ({type(error).__name__})"
        ) from error
    if content.sha256 != checksum(content.kind, signature, content.details, arrays):
        raise LearnedFileError(f"{path} was altered: its content does not match its checksum. Learn again")
    return content
