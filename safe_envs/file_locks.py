"""Locks of files, so that two processes do not write to one place at a time."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from safe_envs.atomic_io import writing
from safe_envs.errors import ConfigurationError

_HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
"""What the operating system says of a lock that somebody else holds."""

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
    with writing(path):
        file = _opened(path)
    if file is None:
        if wait is None:
            raise ConfigurationError(taken)
        wait()
    while file is None:
        time.sleep(_PAUSE)
        with writing(path):
            file = _opened(path)
    try:
        yield
    finally:
        # Windows removes no file that is open.
        with suppress(OSError):
            path.unlink()
        file.close()


def _opened(path: Path) -> IO[bytes] | None:
    """Return the locked file, or None if another process holds its lock."""
    while True:
        file = path.open("ab")
        try:
            _lock(file)
            # Whoever held the lock before has removed its file.
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except OSError as error:
            if error.errno not in _HELD:
                return file
            file.close()
            return None
        file.close()


def _lock(file: IO[bytes]) -> None:
    """Lock an open file; raise OSError where another process holds the lock."""
    try:
        import fcntl
    except ImportError:
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
