"""`safe-envs sweep-report`: the safety rates of a sweep, and its worst cells."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.scripts.options import early_checks, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, say, stdout, write_result

_PICTURE = "report.png"
_SHOWN = 10


def sweep_report(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            callback=early_checks.file_that_is_there(
                "give the folder of `safe-envs sweep ... --out`"
            ),
            help="The folder of `safe-envs sweep ... --out DIR`.",
            show_default=False,
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
    size: evaluation_options.Size = None,
    json: Json = None,
) -> None:
    """Draw the safety rates of a sweep with 95 % bands, and list its worst and its failed cells.

    Every combination of the settings that are neither across nor lines has a panel. Seeds are
    pooled: their episodes are independent. If each seed learned its filter again, the band is
    over what was learned too. Where promise filters at several p are the only numbers that were
    swept, the mean return is drawn over the violations.
    """
    from safe_envs.agents.sweeps.store import read, read_index
    from safe_envs.scripts.figures.sweep import draw
    from safe_envs.scripts.reports.sweep import print_cells, report_document

    path = plot or folder / _PICTURE
    index, rows = read_index(folder), read(folder).to_pylist()
    text_options.require_outputs(json, path)
    size = evaluation_options.size_of(size, path)
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
    print_cells(stdout(), index, rows, worst)
    say(stdout(), f"\n{draw(rows, swept, path, size, x, lines)}")
    write_result(json, lambda: report_document(index, rows, worst))


if __name__ == "__main__":
    run_alone("sweep-report", sweep_report)
