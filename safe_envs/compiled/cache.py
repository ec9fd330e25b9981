"""Which compiled programs are kept on disk."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

_KEPT = 64
"""Programs that are kept; each takes some hundred kilobytes."""

DIGITS = 32
"""Hexadecimal digits in the name of a program's folder."""

FOLDER = "compiled"
"""Name of their folder in the user's cache."""


def forget_old_programs(folder: Path) -> None:
    """Remove programs, but for the 64 that were used last, and nothing else."""
    used = {}
    for program in folder.glob("[0-9a-f]" * DIGITS):
        with suppress(OSError):  # Another process may have removed it.
            used[program] = program.stat().st_mtime
    for program in sorted(used, key=lambda each: -used[each])[_KEPT:]:
        shutil.rmtree(program, ignore_errors=True)
