"""Models, policies and data as files: arrays and JSON in an npz, no pickle, under a checksum."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import MOST_BYTES, MOST_BYTES_OF_TEXT, open_archive, open_regular
from safe_envs.errors import ConfigurationError, shortened, shown
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.data.values import LearnedFileError, require_text

DATA = "transitions"
"""Kind of a file that holds data; others hold models or policies."""

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
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


@dataclass(frozen=True)
class Content:
    """The content of a file.

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
    """Return the SHA-256 of everything that is saved, as hexadecimal digits.

    Args:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name.
    """
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
            plain = {name: np.asarray(array) for name, array in arrays.items()}
            np.savez(stream, allow_pickle=False, header=encoded, **plain)

    write_atomically(path, write)


def _plain(value: Any) -> Any:
    """Return a number of NumPy, which settings and seeds may be, as one of Python."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} is no JSON")


def load(path: Path, writer: str = "safe-envs identify") -> Content:
    """Read a file.

    Args:
        path: of the file.
        writer: command that writes such files, for the messages.

    Raises:
        LearnedFileError: it is missing, a folder, no such file, truncated or altered.
    """
    name = shortened(path)
    try:
        with open_regular(path) as stream, open_archive(stream) as archive:
            content = _content(name, archive, writer)
    except FileNotFoundError as error:
        raise LearnedFileError(f"{name} does not exist; `{writer}` writes such files") from error
    except IsADirectoryError as error:
        raise LearnedFileError(
            f"{name} is a folder; name a file in it that `{writer}` wrote"
        ) from error
    except OSError as error:
        raise LearnedFileError(
            f"{name} cannot be read: {error.strerror}; name a file that `{writer}` wrote"
        ) from error
    except _DAMAGED as error:
        if isinstance(error, LearnedFileError):
            raise
        raise LearnedFileError(
            f"{name} is no file of `{writer}`, or it is truncated or altered"
            f" ({type(error).__name__})"
        ) from error
    if content.sha256 != checksum(content.kind, content.signature, content.details, content.arrays):
        raise LearnedFileError(
            f"{name} was altered: its content does not match its checksum. Run `{writer}` again"
        )
    return content


def _content(name: str, archive: zipfile.ZipFile, writer: str) -> Content:
    """Read an archive; of what is no file of this project, nothing but the header."""
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
            f"{name} has the format {shown(header['format'])}; this version reads {_FORMAT}. Run"
            f" `{writer}` again"
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
    """Read an array of numbers, without taking more memory than the part has bytes."""
    with archive.open(part) as stream:
        shape, _, kind = _HEADERS[np.lib.format.read_magic(stream)](stream)
        if (
            kind.kind not in "biuf"
            or math.prod(shape) * kind.itemsize != part.file_size - stream.tell()
        ):
            raise ValueError("it holds no numbers, or others than its header says")
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)
