"""Where compiled programs are kept on disk."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from contextlib import suppress
from pathlib import Path

_KEPT = 64
"""Programs that are kept; each takes some hundred kilobytes."""

DIGITS = 32
"""Hexadecimal digits in the name of a program's folder."""

VARIABLE = "SAFE_ENVS_CACHE"
"""Environment variable with a folder to use in place of the user's cache; empty for none."""


def cache_folder() -> Path | None:
    """Return the folder of compiled programs, made if need be; None where none can be trusted.

    What is found there is executed: it must belong to the user, and nobody else may write to it
    or put another one in its place.
    """
    given = os.environ.get(VARIABLE)
    if given == "":
        return None
    folder = (_user_folder() if given is None else Path(given)) / "compiled"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder if _is_private(folder) else None
    except (OSError, RuntimeError, ValueError):  # No home, no right, no name of a file.
        return None


def forget_old_programs(folder: Path) -> None:
    """Remove programs, but for the 64 that were used last, and nothing else."""
    used = {}
    for program in folder.glob("[0-9a-f]" * DIGITS):
        with suppress(OSError):  # Another process may have removed it.
            used[program] = program.stat().st_mtime
    for program in sorted(used, key=lambda each: -used[each])[_KEPT:]:
        shutil.rmtree(program, ignore_errors=True)


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
