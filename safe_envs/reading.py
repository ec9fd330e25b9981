"""Files of others, read without hanging and without taking all memory: only regular files, up to a size."""

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

MOST_BYTES = 200_000_000
"""Of a file with arrays: it is read within two seconds."""

MOST_BYTES_OF_TEXT = 8_000_000
"""Of a file with JSON or Python: lists of nothing but empty lists take 25 times as much memory."""

_MOST_BYTES_OF_DIRECTORY = 1_000_000
_END = struct.Struct("<4s4H2LH")
"""The record that ends a zip: signature, disks, entries, size and place of the directory, length of a comment."""

_LOCATOR = 20
"""Bytes before it where the directory of a larger archive is told."""

# They do not exist on every system.
_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)


def open_regular(path: Path | str, most: int = MOST_BYTES) -> BinaryIO:
    """Open a regular file to read it. A pipe, which might wait for ever, or a device, which might never end, is refused.

    Args:
        path: of the file.
        most: its largest size in bytes.

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
    """The content of a regular file; arguments and errors as for `open_regular`."""
    with open_regular(path, most) as stream:
        # A file may grow, and those of the kernel have no size.
        content = stream.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, _too_large(most))
    return content


def read_json(path: Path, advice: str) -> Any:
    """What a JSON file holds.

    Args:
        path: of the file.
        advice: what to do where that cannot be read, to end the message with.

    Raises:
        ConfigurationError: it cannot be read, or is no JSON.
    """
    try:
        return json.loads(read_bytes(path, MOST_BYTES_OF_TEXT))
    except OSError as error:
        raise ConfigurationError(f"{shortened(path)} cannot be read: {error.strerror}; {advice}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{shortened(path)} is no JSON ({shortened(error)}); {advice}") from error


def open_archive(stream: BinaryIO, most: int = MOST_BYTES) -> zipfile.ZipFile:
    """Open a zip without unpacking anything, of which all parts together have at most so many bytes.

    Args:
        stream: of the file.
        most: largest size in bytes of all parts, unpacked.

    Raises:
        ValueError: it is damaged, or too large when it is unpacked.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - _END.size - _LOCATOR, 0))
    tail = stream.read()
    # A directory of millions of parts would be read as a whole. The archives of NumPy and torch end with the record, without comment.
    if len(tail) < _END.size or tail[-_END.size :][:4] != b"PK\5\6":
        raise ValueError("it is no zip, or its end is missing")
    directory = _END.unpack(tail[-_END.size :])[5]
    if directory > _MOST_BYTES_OF_DIRECTORY or tail.startswith(b"PK\6\7"):
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
