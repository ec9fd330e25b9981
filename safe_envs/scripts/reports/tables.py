"""The tables that commands print: one look for all of them."""

from __future__ import annotations

from itertools import zip_longest

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

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
    widest = console.options.update(max_width=_WIDEST)
    console.width = max(console.width, console.measure(table, options=widest).maximum)
    console.print()
    console.print(table)
    console.print()
