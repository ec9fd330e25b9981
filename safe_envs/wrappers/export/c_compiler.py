"""The C compiler at hand."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from safe_envs.errors import ConfigurationError, shortened

_KNOWN = ("cc", "gcc", "clang")
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
_SECONDS = 300


def c_compiler() -> list[str] | None:
    """Return the command of $CC, or of cc, gcc or clang on the path; None if there is none."""
    given = shlex.split(os.environ.get("CC", ""))
    if given and shutil.which(given[0]):
        return given
    return next(([name] for name in _KNOWN if shutil.which(name)), None)


def build_library(compiler: Sequence[str], files: Sequence[Path], library: Path) -> None:
    """Compile files to a shared library.

    Args:
        compiler: its command.
        files: sources.
        library: the file that is written.

    Raises:
        ConfigurationError: The compiler fails.
    """
    command = [*compiler, *_FLAGS, "-o", str(library), *map(str, files), "-lm"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigurationError(f"the C compiler {compiler[0]} cannot be run: {error}") from error
    if done.returncode:
        message = shortened(" ".join(done.stderr.split()), 400)
        raise ConfigurationError(
            f"the C compiler {compiler[0]} fails: {message}; choose another one by CC=..."
        )
