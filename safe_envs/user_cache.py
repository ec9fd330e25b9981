"""The folder of the user's where things that take long to compute are kept, and its size.

Whoever keeps something there gives it a name of hexadecimal digits, marks it with `mark_used` where
it is used again, and calls `make_room` afterwards: what was not used for longest is removed first.
Files of other names are not ours, and remain.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "SAFE_ENVS_CACHE"
"""Environment variable with a folder to use in place of the user's cache; empty for none."""

CONTENTS = {
    "values": "tables of what is attainable, of `best` and of promise filters",
    "attainable": "what is attainable from the starts of envs",
    "closed-loops": "tables of closed loops",
    "compiled": "compiled programs",
}
"""Names of the folders, and what is kept in each."""

MOST_BYTES = 2_000_000_000
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
        folder = (_user_folder() if given is None else Path(given)) / name
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder if _is_private(folder) else None
    except (OSError, RuntimeError, ValueError):  # No home, no right, no name of a file.
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


def _user_folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "safe-envs"


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


def make_room(most: int = MOST_BYTES) -> None:
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
