"""Lines of text that fit a width: names folded where they have joints, sentences at blanks."""

from __future__ import annotations

import re
import unicodedata

_PIECES = re.compile(r"[^\s:+,;/=]*[:+,;/=\s]+|[^\s:+,;/=]+")
"""Where a name may be folded: after the signs that part the settings of a filter or a path."""

_TOGETHER = re.compile(
    r"(?<=\d) (?=(?:%|points\b|s\b))"  # a number and its unit
    r"|(?<=[<>=]) (?=\S)|(?<=\S) (?=[<>=]=? )"  # a relation and its sides
    r"|(?<=\[)[^\[\]]{1,40}(?=\])"  # an interval
)


def folded(name: str, width: int) -> str:
    """Return a name in lines of a width, broken after signs that part its settings.

    Args:
        name: of any length.
        width: of a line.
    """
    lines = [""]
    for piece in _PIECES.findall(name):
        if lines[-1] and text_width(lines[-1] + piece.rstrip()) > width:
            lines.append("")
        while text_width(lines[-1] + piece.rstrip()) > width:
            cut = _cut(piece, width - text_width(lines[-1]))
            lines[-1] += piece[:cut]
            piece = piece[cut:]
            lines.append("")
        lines[-1] += piece
    return "\n".join(lines)


def wrapped(text: str, width: int, indent: int = 0) -> list[str]:
    """Return a line of text in lines of a width, all but the first indented.

    Numbers stay with their units and intervals in one line, and so does what is in brackets, where
    it fits; a word that is too long is folded.

    Args:
        text: a line.
        width: of a line.
        indent: blanks before all lines but the first.
    """
    starts = [0, *break_points(text, width, indent)]
    ends = [*starts[1:], len(text)]
    parts = [text[start:end].rstrip() for start, end in zip(starts, ends, strict=True)]
    return [parts[0], *(" " * indent + part for part in parts[1:])]


def break_points(text: str, width: int, indent: int = 0) -> list[int]:
    """Return where the lines of `wrapped` begin in the text, but for the first one.

    Args:
        text: a line.
        width: of a line.
        indent: blanks before all lines but the first.
    """
    text = _TOGETHER.sub(lambda found: found[0].replace(" ", "\u00a0"), text)
    points: list[int] = []
    begin, room = 0, width
    for word in re.finditer(r"[^ ]+", text):
        if word[0].startswith("(") and _goes_down(text, begin, word.start(), room, width - indent):
            points.append(word.start())
            begin, room = word.start(), max(width - indent, 1)
        if text_width(text[begin : word.end()]) <= room:
            continue
        # A name that is to be folded anyway begins in the line in which it is.
        if text[begin : word.start()].strip() and text_width(word[0]) <= width - indent:
            points.append(word.start())
            begin, room = word.start(), max(width - indent, 1)
        for piece in _PIECES.finditer(text, word.start(), word.end()):
            while text_width(text[begin : piece.end()]) > room:
                at = piece.start()
                if at <= begin:
                    at = begin + _cut(text[begin:], room)
                points.append(at)
                begin, room = at, max(width - indent, 1)
    return points


def visible(text: str, keep: str = "\n\u00a0\u00ad") -> str:
    """Return a text with what controls a terminal, or turns a text around, as Python writes it.

    Args:
        text: of any characters, such as the name of a file.
        keep: what is no sign and stays: ends of lines, non-breaking blanks and soft hyphens.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else repr(c)[1:-1] for c in text)


def text_width(text: str) -> int:
    """Return how many characters of a terminal a text takes."""
    return sum(
        0 if unicodedata.combining(c) else 2 if unicodedata.east_asian_width(c) in "WF" else 1
        for c in text
    )


def _goes_down(text: str, begin: int, opened: int, room: int, below: int) -> bool:
    """Return whether a bracket is to begin a line: it fits there as a whole, and here it does not.

    Args:
        text: a line.
        begin: of its part in the present line.
        opened: place of the bracket.
        room: width of the present line.
        below: width of the next line.
    """
    closed = text.find(")", opened) + 1
    return (
        closed > 0
        and text_width(text[begin:closed]) > room
        and text_width(text[opened:closed]) <= below
        and text_width(text[begin:opened]) > room // 2
    )


def _cut(text: str, width: int) -> int:
    """Return how many characters of a text fit, at least one."""
    count = 1
    while count < len(text) and text_width(text[: count + 1]) <= width:
        count += 1
    return count
