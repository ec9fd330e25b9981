"""The folder of the user's where things that take long to compute are kept."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

VARIABLE = "SAFE_ENVS_CACHE"
"""Environment variable with a folder to use in place of the user's cache; empty for none."""


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
