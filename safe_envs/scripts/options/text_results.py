"""Results that are texts, such as LaTeX: to a file, or to standard output."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from safe_envs.atomic_io import write_atomically
from safe_envs.scripts.options.console import STDOUT


def write_text_result(path: Path | None, text: Callable[[], str]) -> None:
    """Write a text for which an option is given, to a file or to stdout.

    Args:
        path: of the option.
        text: makes it, without an end of line.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    if path == STDOUT:
        print(text())
    elif path is not None:
        write_atomically(path, lambda part: part.write_text(f"{text()}\n", encoding="utf-8"))
