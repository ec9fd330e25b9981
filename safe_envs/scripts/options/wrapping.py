"""Lines that fit a terminal, or a page of the documentation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
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
