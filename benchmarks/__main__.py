"""`python -m benchmarks`: the speed of filters, envs, learning and commands."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from safe_envs.errors import ConfigurationError
from safe_envs.files import read_json
from safe_envs.scripts.options.console import (
    STDOUT,
    Json,
    Quiet,
    quietly,
    require_result,
    run,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.tables import print_rows

_ADVICE = "give what `python -m benchmarks --json FILE` wrote"
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def benchmark(
    json: Json = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of an earlier run with --json: print the ratios to it."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the speed of filters and envs, in 1 to 3 minutes."""
    require_result(json)
    earlier = {} if compare is None else _read_figures(compare)
    with quietly(quiet, silent=json == STDOUT):
        figures = _measure(stdout(), earlier)
        write_result(json, lambda: figures)


def _measure(console: Console, earlier: Mapping[str, float]) -> dict[str, float]:
    from benchmarks.figures import parts, side_by_side
    from safe_envs import __version__
    from safe_envs.files import own_cache
    from safe_envs.scripts.reports.installation import ENV_ID

    figures: dict[str, float] = {}
    cores = f"one of {os.cpu_count()} cores"
    say(console, f"{ENV_ID} with scbf, safe-envs {__version__}, on {cores}; 1 to 3 minutes")
    for part in parts():
        say(console, f"\nmeasuring {part.what} ...\n")
        with own_cache():
            found = part.measure()
        figures |= found
        _print(console, found, earlier)
        sys.stdout.flush()  # a pipe gets the tables of a part at once, too
    rows = [
        (name, f"{numpy_engine:.3g}", f"{compiled:.3g}", f"{compiled / numpy_engine:.3g}")
        for name, (numpy_engine, compiled) in side_by_side(figures).items()
    ]
    if rows:
        print_rows(console, "pr", ("engines side by side", "numpy", "compiled", "ratio"), rows)
    return figures


def _read_figures(path: Path) -> dict[str, float]:
    """Read what an earlier run wrote with --json.

    Raises:
        ConfigurationError: there is no such file, or something else is in it.
    """
    from benchmarks.figures import FUSED

    found = read_json(path, f"{_ADVICE} as --compare")
    if (
        not isinstance(found, dict)
        or FUSED not in found
        or not all(isinstance(value, int | float) for value in found.values())
    ):
        raise ConfigurationError(f"--compare {path} holds no figures; {_ADVICE}")
    return found


def _print(console: Console, figures: Mapping[str, float], earlier: Mapping[str, float]) -> None:
    """Print the figures of a part, where there are earlier ones with those and the ratio to them.

    Tails of single decisions have a table of their own, and are in this one only to be compared.
    """
    from benchmarks import latency
    from safe_envs.scripts.reports.installation import NUM_ENVS

    shown = {
        name: value
        for name, value in figures.items()
        if name in earlier or not latency.is_latency(name)
    }
    units = "microseconds for each state, seconds where they are named, or a ratio; vector envs of"
    titles = (f"{units} {NUM_ENVS}", "figure", *["earlier", "figure / earlier"] * bool(earlier))
    rows = []
    for name, value in shown.items():
        before = earlier.get(name)
        ratio = ["-", "-"] if not before else [f"{before:.3g}", f"{value / before:.2f}"]
        rows.append((name, f"{value:.3g}", *ratio * bool(earlier)))
    if rows:
        print_rows(console, "pr", titles, rows)
    tails = [
        (name, *(f"{value:.1f}" for value in values))
        for name, values in latency.rows_of(figures).items()
    ]
    if tails:
        titles = ("one decision, microseconds of processor time", *latency.COLUMNS)
        print_rows(console, "pr", titles, tails)


def main() -> None:
    """Run the command line; an error of the user ends it with the exit status 2."""
    run(lambda: app(prog_name="python -m benchmarks", standalone_mode=False))


if __name__ == "__main__":
    main()
