"""Arrays: what is given as numbers, and files of arrays by name with a header in JSON."""

from __future__ import annotations

import hashlib
import json
import math
import numbers
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, InvalidInputError, shortened, shown
from safe_envs.files import (
    MOST_BYTES,
    MOST_BYTES_OF_TEXT,
    open_archive,
    open_regular,
    write_atomically,
)


def real_array(what: str, given: Any) -> np.ndarray:
    """Return a state, an action or a batch of them as an array of floats.

    Arrays of float32 and float64 are returned unchanged.

    Args:
        what: name of the argument, for the error.
        given: an array, a number, or nested sequences of numbers.

    Raises:
        InvalidInputError: it is no array of real numbers: text, None, complex, masked, ragged, or
            beyond the range of floats.
    """
    if type(given) is np.ndarray and given.dtype.char in "fd":
        return given
    try:
        if np.ma.is_masked(given):
            raise ValueError("some entries are masked")
        array = np.asarray(given)
        if array.dtype.kind == "O" and all(isinstance(entry, numbers.Real) for entry in array.flat):
            return array.astype(np.float64)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"its entries are of the type {array.dtype}")
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InvalidInputError(
            f"the {what} is {shown(given)}: {error}; give an array of real numbers, such as"
            " np.zeros(2)"
        ) from error


def numbers_in(given: Any) -> np.ndarray:
    """Return numbers as an array of at least one axis; empty if there are none."""
    try:
        found = np.asarray(given)
        # NumPy would read numbers out of texts, times and what is masked, and drop imaginary parts.
        no_numbers = found.dtype.kind in "USMmc" or np.ma.is_masked(given)
        return np.empty(0) if no_numbers else np.atleast_1d(found.astype(float))
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


_HEADER = "header"
_MOST_PARTS = 1000

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

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def checksum(described: Any, arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of all that is saved, as hexadecimal digits.

    Args:
        described: JSON-able.
        arrays: numbers by name.
    """
    digest = hashlib.sha256(json.dumps(described, sort_keys=True, default=_plain).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
        digest.update(array.reshape(-1).data)
    return digest.hexdigest()


def require_size(path: Path, arrays: Mapping[str, np.ndarray], most: int = MOST_BYTES) -> None:
    """Raise ConfigurationError where a file of arrays would be too large to be read.

    Args:
        path: of the file.
        arrays: numbers by name.
        most: bytes that are read of such a file.
    """
    size = sum(np.asarray(array).nbytes for array in arrays.values())
    if size > most:
        raise ConfigurationError(
            f"{path} would take {size / 1e6:.3g} MB; at most {most / 1e6:g} MB are read: save"
            " less in a file"
        )


def write_arrays(
    path: Path,
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    most: int = MOST_BYTES,
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: where.
        header: JSON-able.
        arrays: numbers by name; none may be called "header".
        most: bytes that are read of such a file.

    Raises:
        ConfigurationError: It cannot be written there, or would be too large to be read.
    """
    require_size(path, arrays, most)
    encoded = np.frombuffer(
        json.dumps(header, allow_nan=False, default=_plain).encode(), dtype=np.uint8
    )

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            plain = {name: np.asarray(array) for name, array in arrays.items()}
            np.savez(stream, allow_pickle=False, header=encoded, **plain)

    write_atomically(path, write)


class ArrayFile:
    """An open file, of which nothing but the header has been read.

    Args:
        archive: of the file.

    Attributes:
        header: what its JSON says.

    Raises:
        Exception: One of those that `reading` knows: it is no such file.
    """

    def __init__(self, archive: zipfile.ZipFile) -> None:
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
        self.header: Any = json.loads(_array(archive, parts.pop(_HEADER)).tobytes())
        self._archive, self._parts = archive, parts

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays by name."""
        return {key: _array(self._archive, part) for key, part in self._parts.items()}


@contextmanager
def reading(
    path: Path,
    writer: str,
    error_type: type[ConfigurationError] = ConfigurationError,
    most: int = MOST_BYTES,
) -> Iterator[ArrayFile]:
    """Yield an open file; what goes wrong while it is read is an error that names it.

    Args:
        path: of the file.
        writer: command that writes such files, for the messages.
        error_type: of the errors; the caller's own of this type are passed on.
        most: largest size in bytes of the file, and of its arrays together.

    Raises:
        ConfigurationError: It is missing, a folder, no such file, truncated or altered.
    """
    name = shortened(path)
    try:
        with open_regular(path, most) as stream, open_archive(stream, most) as archive:
            yield ArrayFile(archive)
    except FileNotFoundError as error:
        raise error_type(f"{name} does not exist; `{writer}` writes such files") from error
    except IsADirectoryError as error:
        raise error_type(f"{name} is a folder; name a file in it that `{writer}` wrote") from error
    except OSError as error:
        raise error_type(
            f"{name} cannot be read: {error.strerror}; name a file that `{writer}` wrote"
        ) from error
    except _DAMAGED as error:
        if isinstance(error, error_type):
            raise
        raise error_type(
            f"{name} is no file of `{writer}`, or it is truncated or altered"
            f" ({type(error).__name__})"
        ) from error


def _plain(value: Any) -> Any:
    """Return a number of NumPy, which settings and seeds may be, as one of Python."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} is no JSON")


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
