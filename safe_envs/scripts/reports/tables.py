"""The tables that commands print: one look for all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.text import Column, FittedTable, arranged, columns_of, wrapped

if TYPE_CHECKING:
    import numpy as np

    from safe_envs.problem.problem import SafetyProblem

_WIDEST = 1000


def make_table(kinds: str, *titles: str, tight: bool = True, indent: bool = False) -> Table:
    """Return a table with a line below its titles and no other lines.

    Args:
        kinds: a letter for each column, the last one for all further columns: "l" for a name, at
            the left; "r" for a number, at the right; "p" for a text that may take several lines.
        titles: one for each column; the titles of a column may have several lines.
        tight: two blanks between columns in place of three.
        indent: a blank before the first column.
    """
    table = Table(box=SIMPLE_HEAD, pad_edge=indent, show_edge=False, collapse_padding=tight)
    several_lines = any("\n" in title for title in titles)
    for title, kind in zip_longest(titles, kinds[: len(titles)], fillvalue=kinds[-1]):
        table.add_column(
            title,
            justify="right" if kind == "r" else "left",
            no_wrap=kind != "p",
            overflow="fold" if kind == "p" else "ellipsis",
            vertical="bottom" if several_lines else "top",
        )
    return table


def print_whole(console: Console, table: Table) -> None:
    """Print a table between blank lines, in full width: a number that is cut off would be wrong.

    Args:
        console: to print on; it is widened.
        table: with columns of any width.
    """
    console.print()
    print_full(console, table)
    console.print()


def print_full(console: Console, table: Table) -> None:
    """Print a table in full width.

    Args:
        console: to print on; it is widened while it does.
        table: with columns of any width.
    """
    widest = console.options.update(max_width=_WIDEST)
    before = console.width
    console.width = max(before, console.measure(table, options=widest).maximum)
    console.print(table)
    console.width = before


def print_rows(
    console: Console,
    kinds: str,
    titles: Sequence[str],
    rows: Sequence[Sequence[Any]],
    names: int = 1,
) -> None:
    """Print rows as tables that fit the console.

    Args:
        console: to print on.
        kinds: a letter for each column; see `safe_envs.text.Column`.
        titles: one for each column; soft hyphens in them show where a title is broken.
        rows: cells, str or Text, one for each column; markup is not interpreted.
        names: how many of the columns stand in front of every table.
    """
    columns = columns_of(kinds, titles, rows)
    print_columns(console, columns[:names], columns[names:])


def print_columns(
    console: Console,
    names: Sequence[Column],
    columns: Sequence[Column],
    facts: Sequence[str] = (),
) -> None:
    """Print columns as tables that fit the console, parted by blank lines.

    Args:
        console: to print on.
        names: first columns of each table.
        columns: all others.
        facts: lines that belong to the first table.
    """
    for i, fitted in enumerate(arranged(names, columns, console.width)):
        if i:
            console.print(Table.grid())
        print_full(console, _drawn(fitted))
        if not i:
            # Each is a table too, so that --quiet leaves it.
            for fact in facts:
                line = Table.grid()
                line.add_row(Text("\n".join(wrapped(fact, console.width, indent=4))))
                console.print(line)


def _drawn(fitted: FittedTable) -> Table:
    table = make_table(
        "".join(column.column.kind for column in fitted),
        *("\n".join(column.title) for column in fitted),
    )
    for drawn, column in zip(table.columns, fitted, strict=True):
        drawn.width, drawn.overflow, drawn.vertical = column.width, "fold", "top"
        drawn.no_wrap = False
    for cells in zip(*(column.cells for column in fitted), strict=True):
        table.add_row(*(each if isinstance(each, Text) else Text(str(each)) for each in cells))
    return table


_NOTHING = 1e-6
"""Accuracy of a coordinate of a state found by a search, in parts of the workspace."""

_ROUNDING = 1e-8


def state_text(problem: SafetyProblem, x: np.ndarray) -> str:
    """Return a state as "(x = 1, v = 0.5)".

    Args:
        problem: with the names of the states and the workspace.
        x: shape (n,).

    Returns:
        Coordinates with three digits; those that are 0 up to the accuracy of a search as 0.
    """
    parts = []
    for s, value in zip(problem.states, x.tolist(), strict=True):
        width = s.high - s.low if math.isfinite(s.high - s.low) else 1.0
        parts.append(f"{s.symbol} = {value if abs(value) > _NOTHING * width else 0.0:.3g}")
    return f"({', '.join(parts)})"


def number_text(value: float) -> str:
    """Return a number with five digits, or "infinite"."""
    return "infinite" if math.isinf(value) else f"{value:.5g}"


def size_text(count: int) -> str:
    """Return a number of bytes with its unit."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def share_text(share: float | None) -> str:
    """Return a share in per cent, with two digits below 1 %, so that it does not read as 0."""
    if share is None or share == 0.0 or share >= 0.01:
        from safe_envs.agents.evaluation.statistics import percent

        return percent(share)
    return f"{100 * share:.2g} %"


def relative_text(share: float) -> str:
    """Return a relative error in per cent with two digits; below the rounding error, its bound."""
    if share < _ROUNDING:
        return f"< {100 * _ROUNDING:g} %"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"
