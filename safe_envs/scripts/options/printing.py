"""How consoles print: tables only, lines without blanks at their ends, and lines of a width."""

from __future__ import annotations

import io
import re
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.text_lines import break_points

_INDENT = 4
"""Blanks before the further lines of a text that is wrapped."""


class TablesOnly(Console):
    """A console that leaves out all but tables."""

    def print(self, *objects: Any, **how: Any) -> None:
        """Print those of the objects that are tables."""
        tables = [found for found in objects if isinstance(found, Table)]
        if tables:
            super().print(*tables, **how)


class TrimmedStream(io.TextIOBase):
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
