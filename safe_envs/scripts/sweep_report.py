"""`safe-envs sweep-report`: the safety rates of a sweep over what was swept, and the cells that did
worst."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.rate_text import percent, percent_in
from safe_envs.scripts.options import text_options
from safe_envs.scripts.options.console import Json, stdout, write_result

_PICTURE = "report.png"
_SHOWN = 10

Row = dict[str, Any]


def sweep_report(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="The folder of `safe-envs sweep ... --out DIR`.", show_default=False
        ),
    ],
    x: Annotated[
        str | None,
        typer.Option(
            metavar="SETTING",
            help="Swept setting across; by default the one with most numbers.",
            show_default=False,
        ),
    ] = None,
    lines: Annotated[
        str | None,
        typer.Option(
            metavar="SETTING",
            help="Swept setting with a line for each value; by default the filter.",
            show_default=False,
        ),
    ] = None,
    worst: Annotated[
        int, typer.Option(min=0, help="How many of the worst cells to list.")
    ] = _SHOWN,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=f"Where the picture goes; by default DIR/{_PICTURE}.",
            show_default=False,
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Draw the safety rates of a sweep with 95 % bands, and list its worst cells, those that failed
    and how many are missing.

    Every combination of the settings that are neither across nor lines has a panel. Seeds are put
    together: their episodes are independent. Where each seed learned its filter anew, the band is
    over what was learned too.
    """
    from safe_envs.agents.sweeps.store import read, read_index
    from safe_envs.scripts.figures.sweep_figure import Layout, draw

    path = plot or folder / _PICTURE
    index, rows = read_index(folder), read(folder).to_pylist()
    text_options.require_outputs(json, path)
    swept = index["swept"]
    for option, name in (("--x", x), ("--lines", lines)):
        if name is not None and name not in swept:
            advice = (
                nearest(name, swept)
                if swept
                else "all settings were fixed, so that there is nothing to draw over"
            )
            raise ConfigurationError(f"{option} {name}: it was not swept; {advice}")
    if x is not None and x == lines:
        raise ConfigurationError(f"--x and --lines are both {x}; name two settings")
    done = [row for row in rows if row["error"] is None]
    _print(index, rows, worst)
    if done:
        layout = Layout.of(done, swept, x, lines)
        hidden = draw(done, layout, path)
        told = f"The picture: {path}" + (
            f" (without {hidden} of its panels, which are too many; sweep less, or choose --x and"
            " --lines)" * bool(hidden)
        )
    else:
        told = "There is no picture, since no cell is done."
    stdout().print(f"\n{told}", highlight=False, markup=False, soft_wrap=True)
    write_result(json, lambda: _document(index, rows, worst))


def _worst(rows: list[Row], count: int) -> list[Row]:
    """The cells that did worst, by their rate, and among equals by their smallest h."""
    done = [row for row in rows if row["error"] is None]
    return sorted(done, key=lambda row: (row["safety_rate"], row["min_h_p05"]))[:count]


def _print(index: dict[str, Any], rows: list[Row], worst: int) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from safe_envs.agents.evaluation.spec import UNFILTERED

    console, names = stdout(), index["swept"]
    failed = [row for row in rows if row["error"] is not None]
    missing = len(index["cells"]) - len(rows)
    counts = (
        f"{len(rows) - len(failed)} of {len(index['cells'])} cells are done, {len(failed)} failed,"
        f" {missing} are missing."
    )
    console.print(counts, highlight=False, markup=False)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for title in (
        *names,
        "safe [95 % interval]",
        "min h 5 %",
        "violations",
        "intervened",
        "infeasible",
        "return",
    ):
        table.add_column(title, no_wrap=True, justify="left" if title in names else "right")
    for row in _worst(rows, worst):
        rates = [
            "-" if row["filter"] == UNFILTERED else percent(row[name])
            for name in ("intervention_rate", "infeasible_rate")
        ]
        cells = [
            f"{row['min_h_p05']:.3g}",
            str(row["violations"]),
            *rates,
            f"{row['return_mean']:.4g}",
        ]
        table.add_row(*[Text(_value(row[name])) for name in names], _rate(row), *cells)
    if table.row_count:
        console.print(f"\nThe {table.row_count} worst:", highlight=False)
        console.print(table)
    for i, row in enumerate(failed):
        if i == 0:
            console.print("\nFailed:", highlight=False)
        told = ", ".join(f"{name} = {_value(row[name])}" for name in names)
        console.print(
            f"  {told or 'the only cell'}: {row['error']}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )


def _document(index: dict[str, Any], rows: list[Row], worst: int) -> dict[str, Any]:
    failed = [row for row in rows if row["error"] is not None]
    return {
        "swept": index["swept"],
        "cells": len(index["cells"]),
        "done": len(rows) - len(failed),
        "worst": [_plain(row) for row in _worst(rows, worst)],
        "failed": [_plain(row) for row in failed],
    }


def _plain(row: Row) -> Row:
    """A row without the documents inside it, and without what it leaves to its env."""
    return {
        name: value
        for name, value in row.items()
        if value is not None and name not in ("row", "config", "versions", "files")
    }


def _value(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _rate(row: Row) -> str:
    return percent_in(row["safety_rate"], row["ci_low"], row["ci_high"])


if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main("sweep-report")
