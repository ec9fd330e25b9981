"""Tables and lines of text that fit a width.

Columns that do not fit become a further table with the same names in front, so that nothing is cut
off. A title or a name may contain soft hyphens, which show only where a line ends at them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Literal

from safe_envs.text_lines import folded, text_width, visible, wrapped

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
    if len(folded_tables) < len(tables) or _widest(tables) > width:
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


def _widest(tables: Sequence[FittedTable]) -> int:
    return max(map(_total, tables), default=0)


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
    pad: dict[str, Callable[[str, int], str]] = {"r": _right}
    return (" " * GAP).join(
        pad.get(c.column.kind, _left)(cell, c.width) for c, cell in zip(table, cells, strict=True)
    )


def _left(text: str, width: int) -> str:
    return text + " " * (width - text_width(text))


def _right(text: str, width: int) -> str:
    return " " * (width - text_width(text)) + text
