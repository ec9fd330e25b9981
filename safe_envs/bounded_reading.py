"""Bounded reading of files from outside: regular files only, up to a size."""

from __future__ import annotations

import errno
import json
import os
import stat
import struct
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

from safe_envs.errors import ConfigurationError, shortened

MOST_BYTES = 500_000_000
"""Of a file with arrays: it is read in a second or two."""

MOST_BYTES_OF_TEXT = 8_000_000
"""Of a file with JSON or Python: lists of nothing but empty lists take 25 times as much memory."""

_MOST_BYTES_OF_DIRECTORY = 1_000_000
_UNKNOWN = 0xFFFFFFFF
"""Size that only the record for large files tells."""

_END = struct.Struct("<4s4H2LH")
"""The record that ends a zip: signature, disks, entries, size and place of the directory, length of
a comment."""

_LARGE_END = struct.Struct("<4sQ2H2L4Q")
"""That of archives in the format for large files, which torch writes always: the size of the
directory is the last but one."""

_LOCATOR = 20
"""Bytes between the two, which point to the latter."""

# They do not exist on every system.
_FLAGS = (
    os.O_RDONLY
    | getattr(os, "O_BINARY", 0)
    | getattr(os, "O_NONBLOCK", 0)
    | getattr(os, "O_NOCTTY", 0)
)


def open_regular(path: Path | str, most: int = MOST_BYTES) -> BinaryIO:
    """Open a regular file to read it.

    A pipe, which might wait for ever, or a device, which might never end, is refused.

    Args:
        path: of the file.
        most: its largest size in bytes.

    Returns:
        The stream, to be closed by the caller.

    Raises:
        OSError: it cannot be read, is no regular file, or is larger.
    """
    try:
        descriptor = os.open(path, _FLAGS)
    except ValueError as error:
        raise OSError(errno.EINVAL, f"its path is none ({error})") from error
    try:
        state = os.fstat(descriptor)
        if stat.S_ISDIR(state.st_mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, and no regular file")
        if state.st_size > most:
            raise OSError(errno.EFBIG, _too_large(most))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path | str, most: int = MOST_BYTES) -> bytes:
    """Return the content of a regular file.

    Args:
        path: of the file.
        most: its largest size in bytes.

    Raises:
        OSError: see `open_regular`.
    """
    with open_regular(path, most) as stream:
        # A file may grow, and those of the kernel have no size.
        content = stream.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, _too_large(most))
    return content


def read_json(path: Path, advice: str) -> Any:
    """Return what a JSON file holds.

    Args:
        path: of the file.
        advice: what to do where that cannot be read, to end the message with.

    Raises:
        ConfigurationError: it cannot be read, or is no JSON.
    """
    try:
        return json.loads(read_bytes(path, MOST_BYTES_OF_TEXT))
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: {error.strerror}; {advice}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"{shortened(path)} is no JSON ({shortened(error)}); {advice}"
        ) from error


def open_archive(stream: BinaryIO, most: int = MOST_BYTES) -> zipfile.ZipFile:
    """Open a zip archive without unpacking it, with a limit on the size of its parts together.

    Args:
        stream: of the file.
        most: largest size in bytes of all parts, unpacked.

    Returns:
        The archive.

    Raises:
        ValueError: it is damaged, or too large when it is unpacked.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - _LARGE_END.size - _LOCATOR - _END.size, 0))
    tail = stream.read().rjust(_LARGE_END.size + _LOCATOR + _END.size, b"\0")
    end, large_end = _END.unpack(tail[-_END.size :]), _LARGE_END.unpack(tail[: _LARGE_END.size])
    # The archives of NumPy and torch end with the record, without comment.
    if end[0] != b"PK\5\6":
        raise ValueError("it is no zip, or its end is missing")
    # zipfile reads a directory as a whole, which may be of millions of parts.
    directory = large_end[8] if large_end[0] == b"PK\6\6" else end[5]
    if max(directory, end[5] if end[5] != _UNKNOWN else 0) > _MOST_BYTES_OF_DIRECTORY:
        raise ValueError("it has too many parts")
    try:
        archive = zipfile.ZipFile(stream)
    except (zipfile.BadZipFile, NotImplementedError, struct.error) as error:
        raise ValueError(f"it is no zip, or damaged ({error})") from error
    if sum(part.file_size for part in archive.infolist()) > most:
        raise ValueError(f"unpacked {_too_large(most)}")
    return archive


def _too_large(most: int) -> str:
    return f"it is larger than {most / 1e6:g} MB, the largest that is read"
