"""Texts: numbers read and rounded, lines of a width, and tables that fit one.

No text says more than the number that was proved. A float counts as the decimal number that JSON
has for it, so that 0.9 is 90.0 %. Columns that do not fit become a further table with the same
names in front, so that nothing is cut off. A title or a name may contain soft hyphens, which show
only where a line ends at them.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from numbers import Rational
from typing import TYPE_CHECKING, Any, Literal, SupportsFloat

from safe_envs.errors import ConfigurationError, shown

if TYPE_CHECKING:  # Not imported before they are needed: the help of a command does without.
    from decimal import Decimal
    from fractions import Fraction

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
    """Return whether a bracket begins a line: it fits there as a whole, and here it does not."""
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


_WHOLE = re.compile(r"[-+]?[0-9]+")


def real(text: str) -> float:
    """Read a real number, such as 2, -.5, 1e-3 or inf.

    Raises:
        ValueError: the text is none. Digits of other scripts and underscores between digits, which
            Python takes, are refused: they come from slips, and other software reads the same text
            as something else.
    """
    return float(_plain(text))


def whole_or_real(text: str) -> int | float:
    """Read a number; errors as for `real`.

    It is an int where the text has the form of one and a float can hold it, and else a float.
    """
    value = real(text)
    return int(text) if _WHOLE.fullmatch(text.strip()) and math.isfinite(value) else value


def real_or_complex(text: str) -> float | complex:
    """Read a number, which may be complex, such as -1+2j; errors as for `real`."""
    try:
        return real(text)
    except ValueError:
        return complex(_plain(text))


def _plain(text: str) -> str:
    if not text.isascii() or "_" in text:
        raise ValueError("a number has the digits 0 to 9, without underscores")
    return text


def finite_number(name: str, value: Any) -> float:
    """Return a value as a float.

    Args:
        name: of the argument, for errors.
        value: a number, or the text of one.

    Raises:
        ConfigurationError: The value is not a number, or not finite.
    """
    try:
        number = real(value) if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigurationError(f"{name} = {shown(value)} is not a number") from error
    if not math.isfinite(number):
        raise ConfigurationError(f"{name} = {number} is not finite")
    return number


def numbers(name: str, text: str) -> list[float]:
    """Read "1,2.5,-3".

    Args:
        name: of the option, for errors.
        text: numbers with commas between.

    Raises:
        ConfigurationError: An entry is not a number.
    """
    try:
        return [real(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ConfigurationError(
            f"{name} {shown(text)} is no number or list of numbers with commas between"
        ) from error


def named_values(option: str, texts: Sequence[str], words: bool = False) -> dict[str, Any]:
    """Read NAME=VALUE entries.

    Args:
        option: name of the option, for errors.
        texts: the entries.
        words: whether a value may be a word.

    Raises:
        ConfigurationError: An entry has no name, comes twice, or its value is no number where it
            must be one.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not name or not value or name in found:
            problem = "comes twice" if name in found else "is not of this form"
            raise ConfigurationError(
                f"{option} {shown(text)} {problem}; give NAME=VALUE, once for each parameter"
            )
        try:
            found[name] = whole_or_real(value)
        except ValueError as error:
            if not words:
                raise ConfigurationError(
                    f"{option} {shown(text)}: {shown(value)} is not a number"
                ) from error
            found[name] = value
    return found


_MOST_PLACES = 9
"""Of a percentage."""

_FINEST = 18
"""Places of a percentage that tell any two floats apart that are not next to each other."""

Number = SupportsFloat | Rational


def rounded(value: Number, places: int, *, up: bool) -> Decimal:
    """Return a finite number, rounded in one direction.

    Args:
        value: to round; a `Fraction` is exact.
        places: after the decimal point; negative ones are before it.
        up: whether it is an upper bound.
    """
    from decimal import Decimal
    from fractions import Fraction

    scaled = _exact(value) * Fraction(10) ** places
    whole = math.ceil(scaled) if up else math.floor(scaled)
    return Decimal(f"{whole}e{-places}")


def percent_at_least(bound: Number, places: int = 1) -> str:
    """Return a lower bound of a share in per cent, rounded down.

    Args:
        bound: in [0, 1].
        places: after the point, at least: there are as many as tell it from 0.
    """
    share = 100 * _exact(bound)
    choices = (rounded(share, d, up=False) for d in range(places, _MOST_PLACES))
    return f"{next((each for each in choices if each), rounded(0, places, up=False)):f}"


def percent_at_most(bound: Number) -> str:
    """Return an upper bound of a share in per cent, rounded up.

    There is a digit after the point, or as many as tell it from 0 and from 1.

    Args:
        bound: in [0, 1].
    """
    share = 100 * _exact(bound)
    places = next((d for d in range(1, _MOST_PLACES) if _tells(share, d)), _MOST_PLACES)
    return f"{rounded(share, places, up=True):f}"


def percents_between(lower: Number, upper: Number, places: int = 1) -> tuple[str, str]:
    """Return bounds of a share in per cent, the lower one rounded down and the upper one up.

    Args:
        lower: in [0, 1].
        upper: in [0, 1].
        places: after the point, at least: there are as many as tell an upper bound from 1.
    """
    low, high = 100 * _exact(lower), 100 * _exact(upper)
    choices = (d for d in range(places, _MOST_PLACES) if high >= 100 or _below_all(high, d))
    digits = next(choices, _MOST_PLACES)
    return f"{rounded(low, digits, up=False):f}", f"{rounded(high, digits, up=True):f}"


def percents_apart(upper: Number, lower: Number) -> tuple[str, str]:
    """Return an upper bound and a lower one above it in per cent, with digits that tell them apart.

    Args:
        upper: in [0, 1], rounded up.
        lower: in [0, 1], rounded down.
    """
    high, low = 100 * _exact(upper), 100 * _exact(lower)
    pairs = [(rounded(high, d, up=True), rounded(low, d, up=False)) for d in range(1, _FINEST)]
    most, least = next((pair for pair in pairs if pair[0] < pair[1]), pairs[-1])
    return f"{most:f}", f"{least:f}"


def number_at_most(value: Number, digits: int = 4) -> str:
    """Return an upper bound, rounded up; "infinite" for infinity.

    Args:
        value: of any size.
        digits: that it has at most.
    """
    return _significant(value, digits, up=True)


def number_at_least(value: Number, digits: int = 4) -> str:
    """Return a lower bound, rounded down; "infinite" for infinity.

    Args:
        value: of any size.
        digits: that it has at most.
    """
    return _significant(value, digits, up=False)


def _significant(value: Number, digits: int, *, up: bool) -> str:
    from decimal import Decimal

    if not math.isfinite(float(value)):
        return "infinite" if float(value) == math.inf else str(float(value))
    exact = _exact(value)
    if not exact:
        return "0"
    size = (Decimal(abs(exact.numerator)) / Decimal(exact.denominator)).adjusted()
    return f"{float(rounded(exact, digits - 1 - size, up=up)):.{digits}g}"


def _exact(value: Number) -> Fraction:
    from fractions import Fraction

    return Fraction(value) if isinstance(value, Rational) else Fraction(repr(float(value)))


def _below_all(share: Fraction, places: int) -> bool:
    return rounded(share, places, up=True) < 100


def _tells(share: Fraction, places: int) -> bool:
    """Return whether a number in per cent, rounded either way, differs from 0 and 100 if it is."""
    above_none = not share or rounded(share, places, up=False) > 0
    return above_none and (share >= 100 or _below_all(share, places))


SOFT_HYPHEN = "\u00ad"
_FIXED_BLANK = "\u00a0"
GAP = 2
"""Blanks between columns."""

_TITLE_LINES = 2
_LEAST_PROSE = 24


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: of the column; it is broken at blanks, line ends and soft hyphens, and not at
            non-breaking blanks.
        cells: texts, one for each row, in which control characters are made visible; what is not a
            str counts as the text that `str` makes of it.
        kind: "l" for a name, at the left; "r" for a number, at the right; "p" for a text that may
            take several lines.
        part: columns of the same part stay in one table, where they fit in one.
    """

    title: str
    cells: tuple[Any, ...]
    kind: Literal["l", "r", "p"] = "r"
    part: int = 0

    def __post_init__(self) -> None:
        cells = (visible(cell) if isinstance(cell, str) else cell for cell in self.cells)
        object.__setattr__(self, "cells", tuple(cells))

    @property
    def plain_title(self) -> str:
        """The title in one line."""
        return " ".join(self.title.replace(SOFT_HYPHEN, "").split())


@dataclass(frozen=True)
class FittedColumn:
    """A column with its place in a table.

    Attributes:
        column: as given.
        title: its lines.
        cells: texts, in which a long name is folded.
        width: of the column, in characters.
    """

    column: Column
    title: tuple[str, ...]
    cells: tuple[Any, ...]
    width: int


FittedTable = list[FittedColumn]


def columns_of(kinds: str, titles: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[Column]:
    """Return the columns of rows.

    Args:
        kinds: a letter for each column, see `Column`; the last one for all further columns.
        titles: one for each column.
        rows: cells, one for each column.
    """
    of_columns = list(zip(*rows, strict=True)) or [()] * len(titles)
    letters: Any = kinds + kinds[-1] * len(titles)
    return [
        Column(title, tuple(cells), kind)
        for title, cells, kind in zip(titles, of_columns, letters, strict=False)
    ]


def without_empty(columns: Sequence[Column], empty: str = "-") -> tuple[list[Column], list[str]]:
    """Return the columns in which something is, and the titles of the others.

    Args:
        columns: of a table.
        empty: cell in which nothing is.
    """
    kept = [c for c in columns if any(str(cell) != empty for cell in c.cells)]
    return kept, [c.plain_title for c in columns if c not in kept]


def arranged(names: Sequence[Column], columns: Sequence[Column], width: int) -> list[FittedTable]:
    """Distribute columns over as few tables of a width as their parts allow.

    Args:
        names: first columns of every table. Where they take more than half of the width together,
            a number for each row takes their place, and they are in the first table only.
        columns: all others, in their order.
        width: of a line.

    Returns:
        Tables with the names in front. A column that is wider than the rest of a line is not cut.
    """
    others = [_fitted(column) for column in columns]
    whole = [_fitted(name) for name in names]
    limit = max(2 * width // 5, 12)
    short = [_folded(name.column, limit) if name.width > limit else name for name in whole]
    if len(names) > 1 and _total(short) > width // 2:
        count = len(names[0].cells)
        numbers = Column("#", tuple(str(i) for i in range(1, count + 1)))
        first = [replace(name, column=replace(name.column, part=-1)) for name in short]
        return _packed([_fitted(numbers)], [*first, *others], width)
    tables, folded_tables = _packed(whole, others, width), _packed(short, others, width)
    if len(folded_tables) < len(tables) or max(map(_total, tables), default=0) > width:
        return folded_tables
    return tables


def text_of(table: FittedTable) -> str:
    """Return a table as lines of text."""
    height = max(len(c.title) for c in table)
    head = [["", *c.title][-height:] if height > len(c.title) else c.title for c in table]
    padded = [[""] * (height - len(lines)) + list(lines) for lines in head]
    lines = [_line(table, cells) for cells in zip(*padded, strict=True)]
    lines.append("-" * _total(table))
    for cells in zip(*(c.cells for c in table), strict=True):
        parts = [
            wrapped(str(cell), c.width) if c.column.kind == "p" else str(cell).splitlines() or [""]
            for c, cell in zip(table, cells, strict=True)
        ]
        lines += [
            _line(table, [part[i] if i < len(part) else "" for part in parts])
            for i in range(max(map(len, parts)))
        ]
    return "\n".join(line.rstrip() for line in lines)


def markdown_of(table: FittedTable) -> str:
    """Return a table as Markdown."""
    marks = ["---:" if c.column.kind == "r" else ":---" for c in table]
    titles = [plain_markdown(c.column.plain_title) for c in table]
    cells = ([plain_markdown(str(cell)) for cell in c.column.cells] for c in table)
    rows = [titles, marks, *zip(*cells, strict=True)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def plain_markdown(text: str) -> str:
    """Return a text in one line, as Markdown that shows the same characters."""
    return re.sub(r"([\\`*_|<>\[\]&$~])", r"\\\1", " ".join(visible(text).split()))


def _fitted(column: Column) -> FittedColumn:
    """Return a column as narrow as its cells and its title allow."""
    content = max((_cell_width(cell) for cell in column.cells), default=0)
    title, width = _title(column.title, content)
    return FittedColumn(column, title, column.cells, max(width, content))


def _folded(column: Column, limit: int) -> FittedColumn:
    """Return a column of names that are folded."""
    cells = tuple(folded(str(cell), limit) for cell in column.cells)
    return replace(_fitted(replace(column, cells=cells)), column=column)


def _packed(
    names: Sequence[FittedColumn], columns: Sequence[FittedColumn], width: int
) -> list[FittedTable]:
    """Return columns in tables, with the names in front of each."""
    tables: list[FittedTable] = []

    def fits(more: Sequence[FittedColumn]) -> bool:
        return _least([*tables[-1], *more]) <= width if tables else False

    for _, part in groupby(columns, key=lambda c: c.column.part):
        group = list(part)
        if fits(group):
            tables[-1] += group
            continue
        tables.append(list(names))
        for column in group:
            if len(tables[-1]) > len(names) and not fits([column]):
                tables.append(list(names))
            tables[-1].append(column)
    return [_spread(table, width) for table in tables or [list(names)]]


def _spread(table: FittedTable, width: int) -> FittedTable:
    """Return a table in which texts of several lines have the width that is left."""
    prose = [c for c in table if c.column.kind == "p"]
    left = width - _total(c for c in table if c.column.kind != "p") - GAP * len(prose)
    widths: dict[int, int] = {}
    for i, column in enumerate(sorted(prose, key=lambda c: c.width)):
        share = max(left // (len(prose) - i), _prose_width(column))
        widths[id(column)] = min(column.width, share)
        left -= widths[id(column)]
    return [replace(c, width=widths.get(id(c), c.width)) for c in table]


def _prose_width(column: FittedColumn) -> int:
    return min(column.width, max(_LEAST_PROSE, *map(text_width, column.title)))


def _least(table: Sequence[FittedColumn]) -> int:
    """Return the least width of a table."""
    least = [_prose_width(c) if c.column.kind == "p" else c.width for c in table]
    return sum(least) + GAP * (len(table) - 1)


def _total(table: Sequence[FittedColumn] | Iterator[FittedColumn]) -> int:
    widths = [c.width for c in table]
    return sum(widths) + GAP * max(len(widths) - 1, 0)


def _cell_width(cell: Any) -> int:
    return max(map(text_width, str(cell).splitlines()), default=0)


def _title(title: str, content: int) -> tuple[tuple[str, ...], int]:
    """Return a title in lines no wider than the content, or else as narrow as it may be."""
    most = max(_TITLE_LINES, title.count("\n") + 1)
    lines: tuple[str, ...] = ("",)
    for width in range(max(content, 1), max(content, text_width(title)) + 1):
        lines = tuple(line.replace(_FIXED_BLANK, " ") for line in _broken(title, width))
        if len(lines) <= most and max(map(text_width, lines)) <= width:
            break
    return lines, max(map(text_width, lines))


def _broken(title: str, width: int) -> tuple[str, ...]:
    """Return a title in lines of a width, as far as it can be broken."""
    lines: list[str] = []
    for given in title.split("\n"):
        lines.append("")
        for word in given.split(" "):
            parts = word.split(SOFT_HYPHEN)
            whole = "".join(parts)
            blank = " " if lines[-1] else ""
            if text_width(lines[-1] + blank + whole) <= width:
                lines[-1] += blank + whole
                continue
            if lines[-1]:
                lines.append("")
            for i, part in enumerate(parts):
                rest = part + "-" * (i < len(parts) - 1)
                ends = "".join(parts[i:])
                if text_width(lines[-1] + ends) <= width:
                    lines[-1] += ends
                    break
                if lines[-1] and text_width(lines[-1] + rest) > width:
                    lines[-1] += "-" * (not lines[-1].endswith("-"))
                    lines.append("")
                lines[-1] += part
    return tuple(lines)


def _line(table: FittedTable, cells: Sequence[str]) -> str:
    padded = []
    for c, cell in zip(table, cells, strict=True):
        blanks = " " * (c.width - text_width(cell))
        padded.append(blanks + cell if c.column.kind == "r" else cell + blanks)
    return (" " * GAP).join(padded)
