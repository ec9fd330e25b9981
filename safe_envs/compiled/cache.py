"""Where compiled programs are kept on disk."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from pathlib import Path

_KEPT = 64
"""Programs that are kept, the most recently used ones; each takes some hundred kilobytes."""

VARIABLE = "SAFE_ENVS_CACHE"
"""Environment variable with the folder to use in place of the user's cache folder; empty for none."""


def cache_folder() -> Path | None:
    """Return the folder of compiled programs, made if need be; None where none can be trusted.

    What is found there is executed: it must belong to the user, and nobody else may write to it.
    """
    given = os.environ.get(VARIABLE)
    if given == "":
        return None
    folder = (_user_folder() if given is None else Path(given)) / "compiled"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder if _is_private(folder) else None
    except (OSError, ValueError):
        return None


def forget_old_programs(folder: Path) -> None:
    """Remove the programs that were not used for longest, but for the last 64."""
    programs = sorted(
        (each for each in folder.iterdir() if each.is_dir()), key=lambda each: -each.stat().st_mtime
    )
    for program in programs[_KEPT:]:
        shutil.rmtree(program, ignore_errors=True)


def _is_private(folder: Path) -> bool:
    if not hasattr(os, "getuid"):
        return os.access(folder, os.W_OK)
    found = folder.stat()
    others_write = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return found.st_uid == os.getuid() and not others_write and os.access(folder, os.W_OK)


def _user_folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "safe-envs"
