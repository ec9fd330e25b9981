"""Files: written whole or not at all, read within bounds, locked, and kept in the user's cache.

Whoever keeps something in the cache names it by hexadecimal digits, marks it with `mark_used`
where it is used again, and calls `make_room` afterwards: what was not used for longest is removed
first. Files of other names are not ours, and remain.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from safe_envs.errors import ConfigurationError, shortened

if TYPE_CHECKING:
    import zipfile

_STEM = 40


def require_writable(path: Path) -> None:
    """Raise ConfigurationError unless a file can be created at `path`.

    Call it before a long run, not after it.
    """
    folder, name = path.absolute().parent, shortened(path)
    # The functions of os.path take any text for a path, also one that is too long to be one.
    if os.path.isdir(path):
        raise ConfigurationError(f"cannot write {name}: it is a folder; name a file in it")
    if not os.path.isdir(folder):
        there = next(place for place in (folder, *folder.parents) if os.path.exists(place))
        if not there.is_dir():
            raise ConfigurationError(
                f"cannot write {name}: {there} is a file and no folder; choose another folder"
            )
        raise ConfigurationError(
            f"cannot write {name}: the folder {shortened(folder)} does not exist; create it or"
            " choose another"
        )
    if os.path.exists(path) and not os.path.isfile(path):
        raise ConfigurationError(
            f"cannot write {name}: it is a pipe or a device, which a file would replace; name a"
            " file"
        )
    try:
        path.lstat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"cannot write {name}: {getattr(error, 'strerror', error)}; choose another name"
        ) from error
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"cannot write {name}: no file can be created in {folder} ({error.strerror})"
        ) from error


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file in the same folder, then move it to `path` in one step.

    Args:
        path: where the file is to be.
        write: is given the temporary path, which has the suffix of `path`.

    Raises:
        ConfigurationError: the folder does not exist or is not writable, or the file cannot be
            written, as on a full disk; what was at `path` before is still there.
    """
    with replaced_at_the_end(path) as temporary, writing(path):
        write(temporary)


@contextmanager
def replaced_at_the_end(path: Path) -> Iterator[Path]:
    """Yield a temporary file in the same folder, and move it to `path` in one step at the end.

    For a file that is written bit by bit during a long run; `write_atomically` is for all others.
    After an error what was at `path` before is still there. Errors as for `write_atomically`, but
    those of the writing itself, for which see `writing`.
    """
    require_writable(path)
    with writing(path):
        # With more of its name, the temporary one could be too long.
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem[:_STEM]}.", suffix=path.suffix[-_STEM:], dir=path.absolute().parent
        )
        os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with writing(path):
            temporary.chmod(0o644)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors of the operating system into a ConfigurationError that names `path`."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot write {path}: {error.strerror or error}; see to it that there is room and that"
            " files may be written there"
        ) from error


def write_json(path: Path, data: Any) -> None:
    """Write strict JSON, whole or not at all; errors as for `write_atomically`.

    Args:
        path: where the file is to be.
        data: JSON-able, without NaN or infinities.
    """
    text = json.dumps(data, indent=2, allow_nan=False)
    write_atomically(path, lambda part: part.write_text(text + "\n"))


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
    import zipfile

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


_WITHOUT_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP)
"""What the operating system says of a lock on a file system that has none."""

_PAUSE = 0.2
"""Seconds between two attempts to get a lock."""


@contextmanager
def locked(path: Path, taken: str, wait: Callable[[], object] | None = None) -> Iterator[None]:
    """Hold the lock of a file, which is made for it and removed with it.

    The operating system releases it when the process ends, however that ends. On a file system
    without locks there is none.

    Args:
        path: of the file.
        taken: what to say if another process holds the lock.
        wait: given, it is called once if another process holds the lock, which is then waited for.

    Returns:
        A context manager that releases the lock.

    Raises:
        ConfigurationError: another process holds the lock and `wait` is not given, or the file
            cannot be made.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path)
    with writing(path):
        try:
            lock.acquire(blocking=False)
        except Timeout:
            if wait is None:
                raise ConfigurationError(taken) from None
            wait()
            lock.acquire(poll_interval=_PAUSE)
        except OSError as error:
            if error.errno not in _WITHOUT_LOCKS:
                raise
    try:
        yield
    finally:
        # Windows removes no file that is open. Whoever waits takes none that was removed.
        with suppress(OSError):
            path.unlink()
        lock.release()


VARIABLE = "SAFE_ENVS_CACHE"
"""Environment variable with a folder to use in place of the user's cache; empty for none."""

CONTENTS = {
    "values": "tables of what is attainable, of `best` and of promise filters",
    "attainable": "what is attainable from the starts of envs",
    "closed-loops": "tables of closed loops",
    "compiled": "compiled programs",
}
"""Names of the folders, and what is kept in each."""

MOST_CACHE_BYTES = 2_000_000_000
"""Size of all that is kept."""

_KEPT = re.compile(r"[0-9a-f]{32}|[0-9a-f]{64}\.(npz|json)")
_COMPILED = "compiled"
_LEFT_OVER = re.compile(r"\.[0-9a-f]{8}.*")
_DAY = 86_400.0


@dataclass(frozen=True)
class CacheEntry:
    """Something that is kept.

    Attributes:
        place: its file or folder.
        size: in bytes.
        used: when it was used last, in s since the epoch.
    """

    place: Path
    size: int
    used: float


def cache_folder(name: str) -> Path | None:
    """Return a folder of the cache, made if need be; None where none can be trusted.

    What is found there is executed, or relied on: it must belong to the user, and nobody else may
    write to it or put another one in its place.

    Args:
        name: of the folder in that of the cache.
    """
    given = os.environ.get(VARIABLE)
    if given == "":
        return None
    try:
        if given is None:
            from platformdirs import user_cache_path

            folder = user_cache_path("safe-envs", appauthor=False, opinion=False) / name
            if not folder.is_absolute():  # No home.
                return None
        else:
            folder = Path(given) / name
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder if _is_private(folder) else None
    except (OSError, RuntimeError, ValueError):  # No right, no name of a file.
        return None


def _is_private(folder: Path) -> bool:
    if not hasattr(os, "getuid"):
        return os.access(folder, os.W_OK)
    found = folder.stat()
    others_write = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return (
        found.st_uid == os.getuid()
        and not others_write
        and os.access(folder, os.W_OK)
        and not any(map(_anyone_may_rename_in, folder.resolve().parents))
    )


def _anyone_may_rename_in(folder: Path) -> bool:
    """Return whether anyone can put a folder of theirs in the place of one in it."""
    mode = folder.stat().st_mode
    return bool(mode & stat.S_IWOTH) and not mode & stat.S_ISVTX


def entries(name: str) -> list[CacheEntry]:
    """Return what is kept in a folder of the cache, the last used first.

    Args:
        name: of the folder, one of `CONTENTS`.
    """
    folder, found = cache_folder(name), []
    for place in [] if folder is None else folder.iterdir():
        with suppress(OSError):  # Another process may have removed it.
            if _KEPT.fullmatch(place.name):
                found.append(CacheEntry(place, _size(place), place.stat().st_mtime))
    return sorted(found, key=lambda each: -each.used)


def mark_used(place: Path) -> None:
    """Note that something that is kept was used now."""
    with suppress(OSError):
        os.utime(place)


def make_room(most: int = MOST_CACHE_BYTES) -> None:
    """Remove what was not used for longest, and what killed processes have left.

    What was used last remains, whatever its size.

    Args:
        most: bytes that may remain.
    """
    total = 0
    kept = [entry for name in CONTENTS for entry in entries(name)]
    for i, entry in enumerate(sorted(kept, key=lambda each: -each.used)):
        total += entry.size
        if i and total > most:
            _remove(entry.place)
    for folder in filter(None, map(cache_folder, CONTENTS)):
        for place in folder.iterdir():
            with suppress(OSError):
                old = place.stat().st_mtime < time.time() - _DAY
                if old and _LEFT_OVER.fullmatch(place.name):
                    _remove(place)


def clear() -> int:
    """Remove all that is kept, and return its size in bytes."""
    removed = 0
    for entry in [entry for name in CONTENTS for entry in entries(name)]:
        _remove(entry.place)
        removed += entry.size * (not entry.place.exists())
    return removed


@contextmanager
def own_cache() -> Iterator[None]:
    """Use an empty cache but for compiled programs, on which no number depends."""
    compiled, before = cache_folder(_COMPILED), os.environ.get(VARIABLE)
    with tempfile.TemporaryDirectory() as folder:
        if compiled is not None:
            with suppress(OSError):  # Some systems have no links.
                (Path(folder) / _COMPILED).symlink_to(compiled)
        os.environ[VARIABLE] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ[VARIABLE]
            else:
                os.environ[VARIABLE] = before


def _size(place: Path) -> int:
    files = [place] if place.is_file() else [each for each in place.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place, ignore_errors=True)
    with suppress(OSError):
        place.unlink()
