"""`safe-envs benchmark`: the speed of filters, envs and learning."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from safe_envs.bounded_reading import read_json
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import early_checks
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, say, stdout, write_result
from safe_envs.scripts.reports.tables import print_rows

_ADVICE = "give what `safe-envs benchmark --json FILE` wrote"


def benchmark(
    json: Json = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            callback=early_checks.file_that_is_there(_ADVICE),
            help="Of an earlier run with --json: print the ratios to it.",
        ),
    ] = None,
) -> None:
    """Measure the speed of filters and envs."""
    from safe_envs import __version__
    from safe_envs.scripts.reports import benchmark_figures
    from safe_envs.scripts.reports.benchmark_cases import ENV_ID
    from safe_envs.user_cache import own_cache

    require_result(json)
    earlier = {} if compare is None else _read_figures(compare)
    console, figures = stdout(), {}
    cores = f"one of {os.cpu_count()} cores"
    say(console, f"{ENV_ID} with scbf, safe-envs {__version__}, on {cores}; 1 to 3 minutes")
    for part in benchmark_figures.parts():
        say(console, f"\nmeasuring {part.what} ...\n")
        with own_cache():
            found = part.measure()
        figures |= found
        _print(console, found, earlier)
    if sides := benchmark_figures.side_by_side(figures):
        _print_engines(console, sides)
    write_result(json, lambda: figures)


def _print(console: Console, figures: Mapping[str, float], earlier: Mapping[str, float]) -> None:
    """Print the tables of a part of the benchmark; a pipe gets them at once, too."""
    from safe_envs.scripts.reports import latency

    # Tails have a table of their own, and stand in this one only to be compared.
    if any(name in earlier or not latency.is_latency(name) for name in figures):
        _print_figures(console, figures, earlier)
    if tails := latency.rows_of(figures):
        _print_latency(console, tails)
    sys.stdout.flush()


def _read_figures(path: Path) -> dict[str, float]:
    """Read what an earlier run wrote with --json.

    Raises:
        ConfigurationError: there is no such file, or something else is in it.
    """
    from safe_envs.scripts.reports.benchmark_figures import FUSED

    found = read_json(path, f"{_ADVICE} as --compare")
    if (
        not isinstance(found, dict)
        or FUSED not in found
        or not all(isinstance(value, int | float) for value in found.values())
    ):
        raise ConfigurationError(f"--compare {path} holds no figures; {_ADVICE}")
    return found


def _print_figures(
    console: Console, figures: Mapping[str, float], earlier: Mapping[str, float]
) -> None:
    """Print the figures, and where there are earlier ones, those and the ratio to them."""
    from safe_envs.scripts.reports.benchmark_cases import NUM_ENVS
    from safe_envs.scripts.reports.latency import is_latency

    first = (
        "microseconds for each state, seconds where they are named, or a ratio; vector envs of"
        f" {NUM_ENVS}"
    )
    titles = ("figure", *["earlier", "figure / earlier"] * bool(earlier))
    rows = []
    for name, value in figures.items():
        if is_latency(name) and name not in earlier:
            continue
        before = earlier.get(name)
        ratio = ["-", "-"] if not before else [f"{before:.3g}", f"{value / before:.2f}"]
        rows.append((name, f"{value:.3g}", *ratio * bool(earlier)))
    print_rows(console, "pr", (first, *titles), rows)


def _print_latency(console: Console, tails: Mapping[str, Sequence[float]]) -> None:
    """Print the times of single decisions: the middle and the tail of their distribution."""
    from safe_envs.scripts.reports.latency import COLUMNS

    titles = ("one decision, microseconds of processor time", *COLUMNS)
    rows = [(name, *(f"{value:.1f}" for value in values)) for name, values in tails.items()]
    print_rows(console, "pr", titles, rows)


def _print_engines(console: Console, sides: Mapping[str, tuple[float, float]]) -> None:
    """Print the speeds of the engines side by side."""
    rows = [
        (name, f"{numpy_engine:.3g}", f"{compiled:.3g}", f"{compiled / numpy_engine:.3g}")
        for name, (numpy_engine, compiled) in sides.items()
    ]
    print_rows(console, "pr", ("engines side by side", "numpy", "compiled", "ratio"), rows)


if __name__ == "__main__":
    run_alone("benchmark", benchmark)
