"""What is printed by rich: the console of results, and lines that fit a terminal or a page.

Help and completion do without rich, which takes longer to import than all the rest of them.
"""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.text import break_points, visible

_INDENT = 4
"""Blanks before the further lines of a text that is wrapped."""


class _Page:
    """Whether what is printed goes to a page."""

    shown = False


@contextmanager
def as_on_a_terminal() -> Iterator[None]:
    """Wrap lines within this context as on a terminal, for pages of documentation."""
    before, _Page.shown = _Page.shown, True
    try:
        yield
    finally:
        _Page.shown = before


def visible_text(text: str | Text) -> str | Text:
    """Return a text of several lines in which control characters are made visible.

    Args:
        text: which may have a style.
    """
    if isinstance(text, str):
        return visible(text)
    if visible(text.plain) == text.plain:
        return text
    # Rich has no other way to the parts with one style than to draw them.
    parts = text.render(Console(), end="")
    return Text.assemble(*((visible(part.text), part.style or "") for part in parts))


def wrapped_for(console: Console, text: str | Text) -> str | Text:
    """Return a text in lines that fit a terminal; for other consoles as it is.

    Args:
        console: on which it is to be printed.
        text: of several lines.
    """
    if not (console.is_terminal or _Page.shown):
        return text
    return wrapped_text(Text(text) if isinstance(text, str) else text, console.width)


def wrapped_text(text: Text, width: int) -> Text:
    """Return a text in lines of a width, broken between words, where `break_points` says.

    Args:
        text: of several lines.
        width: of a line.
    """
    lines = text.split(allow_blank=True)
    return Text("\n").join(part for line in lines for part in _wrapped(line, width))


def _wrapped(text: Text, width: int) -> list[Text]:
    """Return a line in lines of a width, all but the first indented more than it."""
    plain = text.plain
    indent = min(_INDENT + len(plain) - len(plain.lstrip(" ")), width // 2)
    first, *others = text.divide(break_points(plain, width, indent))
    lines = [first, *(Text(" " * indent) + other for other in others)]
    for line in lines:
        line.rstrip()
    return lines


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
