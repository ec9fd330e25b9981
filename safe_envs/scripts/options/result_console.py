"""The consoles of rich that results and progress bars are printed on."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table

_LEAST_WIDTH = 40
_PIPE_WIDTH = 80


class _Tables(Console):
    """A console that leaves out all but tables."""

    def print(self, *objects: Any, **how: Any) -> None:
        tables = [found for found in objects if isinstance(found, Table)]
        if tables:
            super().print(*tables, **how)


class _Trimmed(io.TextIOBase):
    """A stream without the blanks at the ends of the lines of a table."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The encoding, which decides on the characters that draw tables."""
        return self._stream.encoding

    def write(self, text: str, /) -> int:
        """Write whole lines, as a console does."""
        return self._stream.write(re.sub(r" +$", "", text, flags=re.MULTILINE))

    def flush(self) -> None:
        """See `io.TextIOBase`."""
        self._stream.flush()


def result_console(quiet: bool, silent: bool) -> Console:
    """Return the console for results, as wide as the terminal; without one, 80 characters.

    Args:
        quiet: print tables only.
        silent: print nothing.
    """
    kind = _Tables if quiet else Console
    if sys.stdout.isatty():
        return kind(width=max(Console().width, _LEAST_WIDTH), quiet=silent)
    trimmed: Any = _Trimmed(sys.stdout)
    return kind(width=_PIPE_WIDTH, quiet=silent, file=trimmed)


@contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on stderr.

    Args:
        what: its title.

    Yields:
        The function that takes the part that is done.
    """
    # Not imported before it is needed: results need no bar.
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda done: bar.update(task, completed=done)
