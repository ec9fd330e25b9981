"""Learned models and data as files: arrays and JSON in an npz, without pickle, refused where they
do not fit or were altered."""

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

from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import MOST_BYTES, MOST_BYTES_OF_TEXT, open_archive, open_regular
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, shortened, shown
from safe_envs.problem.problem import SafetyProblem

DATA = "transitions"
"""Kind of a file that holds data, where others hold what was learned."""

_FORMAT = 2
_HEADER = "header"
_PACKAGES = ("safe-envs", "numpy", "sympy", "torch")


# What zipfile, NumPy, json and Python raise on damaged files, and on JSON of another shape.
_DAMAGED = (
    EOFError,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    NotImplementedError,
    RecursionError,
    RuntimeError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)

_MOST_PARTS = 1000
LARGEST = 1e100
"""Number in a file: a product of a few is a number still."""
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class LearnedFileError(ConfigurationError):
    """A file is no learned model or data set of this project, is damaged, or belongs to something
    else."""


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
        plant: parameters of the plant that was stepped; empty where they are not known, as for a
            log.
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
            raise LearnedFileError(
                f"what was learned is of another problem: {difference}; learn again, by `safe-envs"
                " identify`"
            )

    def difference(self, problem: SafetyProblem, *also: str) -> str:
        """In what this is not of a problem's system, in words; empty if it is. Arguments as for
        `require`."""
        wanted = Signature.of(problem)
        for name in ("system", "states", "state_units", "inputs", "input_units", *also):
            mine, other = getattr(self, name), getattr(wanted, name)
            if mine != other:
                return f"its {name.replace('_', ' ')}: {mine}, that of {problem.name}: {other}"
        return ""

    def differences(self, problem: SafetyProblem) -> tuple[str, ...]:
        """Parameters of the plant that are not those of a problem's, such as "v = 0.8 (here 1)";
        none if they are not known."""
        here = dict(_parameters(problem.plant))
        return tuple(
            f"{name} = {value:.12g} (here {here.get(name, math.nan):.12g})"
            for name, value in self.plant
            if here.get(name) != value
        )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signature:
        """Read what `asdict` and JSON made of one.

        Raises:
            TypeError, ValueError: it is something else.
        """
        found = dict(data)
        if set(found) != {f.name for f in fields(cls)}:
            raise ValueError("the entries of a signature are others")
        found["system"], found["dt"] = require_text(found["system"]), require_finite(found["dt"])
        for name in ("states", "state_units", "inputs", "input_units", "barriers"):
            found[name] = tuple(map(require_text, found[name]))
        for name in ("model", "plant"):
            found[name] = tuple(
                (require_text(parameter), require_finite(value)) for parameter, value in found[name]
            )
        return cls(**found)


def require_text(given: Any) -> str:
    """Return a text of JSON; raise TypeError where it is none."""
    if not isinstance(given, str):
        raise TypeError(f"{shown(given)} is no text")
    return given


def require_finite(given: Any) -> float:
    """Return a number of JSON as a float; raise TypeError where it is none, ValueError where it is
    not finite."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError(f"{shown(given)} is no number")
    if not math.isfinite(given):
        raise ValueError(f"{given} is not finite")
    return float(given)


def array_of(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the array of a name, as floats.

    Raises:
        KeyError: there is none.
        ValueError: its shape is another, or a number is not finite or too large.
    """
    array = arrays[name].astype(float, copy=False)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        raise ValueError(
            f"{name} has the shape {array.shape}, not {shape}, or a number that is not finite or"
            f" above {LARGEST:g}"
        )
    return array


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


def checksum(
    kind: str, signature: Signature, details: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> str:
    """SHA-256 of everything that is saved, as hexadecimal digits."""
    digest = hashlib.sha256(
        json.dumps([kind, asdict(signature), details], sort_keys=True, default=_plain).encode()
    )
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
        digest.update(array.reshape(-1).data)
    return digest.hexdigest()


def save(
    path: Path,
    kind: str,
    signature: Signature,
    details: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: where.
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name; none may be called "header".

    Raises:
        ConfigurationError: it cannot be written there, or would be too large to be read.
    """
    size = sum(np.asarray(array).nbytes for array in arrays.values())
    if size > MOST_BYTES:
        raise ConfigurationError(
            f"{path} would take {size / 1e6:.3g} MB; at most {MOST_BYTES / 1e6:g} MB are read: save"
            " less in a file"
        )
    header = {
        "format": _FORMAT,
        "kind": kind,
        "signature": asdict(signature),
        "details": dict(details),
        "versions": {package: version(package) for package in _PACKAGES},
        "sha256": checksum(kind, signature, details, arrays),
    }
    encoded = np.frombuffer(
        json.dumps(header, allow_nan=False, default=_plain).encode(), dtype=np.uint8
    )

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            _savez(stream, {_HEADER: encoded, **arrays})

    write_atomically(path, write)


def _savez(stream: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(
        stream, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()}
    )  # pyright: ignore[reportArgumentType]


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
    name = shortened(path)
    try:
        with open_regular(path) as stream, open_archive(stream) as archive:
            content = _content(name, archive)
    except FileNotFoundError as error:
        raise LearnedFileError(
            f"{name} does not exist; `safe-envs identify` writes such files"
        ) from error
    except IsADirectoryError as error:
        raise LearnedFileError(
            f"{name} is a folder; name a file in it that `safe-envs identify` wrote"
        ) from error
    except OSError as error:
        raise LearnedFileError(
            f"{name} cannot be read: {error.strerror}; name a file that `safe-envs identify` wrote"
        ) from error
    except _DAMAGED as error:
        if isinstance(error, LearnedFileError):
            raise
        raise LearnedFileError(
            f"{name} is no file of `safe-envs identify`, or it is truncated or altered"
            f" ({type(error).__name__})"
        ) from error
    if content.sha256 != checksum(content.kind, content.signature, content.details, content.arrays):
        raise LearnedFileError(
            f"{name} was altered: its content does not match its checksum. Learn again"
        )
    return content


def _content(name: str, archive: zipfile.ZipFile) -> Content:
    """What an archive holds; of what is no file of this project, nothing but the header is read."""
    parts = {part.filename.removesuffix(".npy"): part for part in archive.infolist()}
    if len(parts) != len(archive.infolist()) or len(parts) > _MOST_PARTS:
        raise ValueError("too many parts, or two of one name")
    # Ours are as large in the file as in memory.
    if any(
        part.compress_type != zipfile.ZIP_STORED or part.file_size != part.compress_size
        for part in parts.values()
    ):
        raise ValueError("a part is compressed")
    if parts[_HEADER].file_size > MOST_BYTES_OF_TEXT:
        raise ValueError("the header is too large")
    header = json.loads(_array(archive, parts.pop(_HEADER)).tobytes())
    if header["format"] != _FORMAT:
        raise LearnedFileError(
            f"{name} has the format {shown(header['format'])}; this version reads {_FORMAT}. Learn"
            " again"
        )
    kind, signature, details = (
        require_text(header["kind"]),
        Signature.from_json(header["signature"]),
        dict(header["details"]),
    )
    return Content(
        kind,
        signature,
        details,
        {key: _array(archive, part) for key, part in parts.items()},
        require_text(header["sha256"]),
    )


def _array(archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> np.ndarray:
    """An array of numbers, for which no more memory is taken than the part has bytes."""
    with archive.open(part) as stream:
        shape, _, kind = _HEADERS[np.lib.format.read_magic(stream)](stream)
        if (
            kind.kind not in "biuf"
            or math.prod(shape) * kind.itemsize != part.file_size - stream.tell()
        ):
            raise ValueError("it holds no numbers, or others than its header says")
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)
