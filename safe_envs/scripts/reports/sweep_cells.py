"""The cells of a sweep: what was computed, what was worst, and what failed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.best_text import ends_text, times_text
from safe_envs.agents.evaluation.bound_text import bound_cells
from safe_envs.agents.evaluation.rate_text import percent, rate_of
from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.evaluation.yardstick import times_between
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.agents.jobs.job import JobOutcome
    from safe_envs.agents.sweeps.cell import Sweep

Row = dict[str, Any]

_SHOWN = 10
_SAFE = "safe [95 % interval]"
_CONTINUOUS = "continuous_bound"
_BEST_TITLES = ("best", "times unavoidable")
_TITLES = ("min h 5 %", "violations", "intervened", "infeasible", "return")
_DOCUMENTS = ("row", "config", "versions", "files")


def print_cells(console: Console, index: dict[str, Any], rows: Sequence[Row], worst: int) -> None:
    """Print how many cells are computed, the worst of them, and those that failed.

    Args:
        console: to print on.
        index: of the sweep; see `safe_envs.agents.sweeps.store.read_index`.
        rows: its cells; see `safe_envs.agents.sweeps.store.read`.
        worst: how many of the worst to print.
    """
    names = index["swept"]
    failed, missing = _failed(rows), len(index["cells"]) - len(rows)
    say(
        console,
        f"{len(rows) - len(failed)} of {len(index['cells'])} cells are done, {len(failed)} failed,"
        f" {missing} are missing.",
    )
    shown = _worst(rows, worst)
    best = _BEST_TITLES if any(row["best_lower"] is not None for row in shown) else ()
    bounded = any(row[name] is not None for row in shown for name in ("held_bound", _CONTINUOUS))
    held, continuous = (("held input",), ("continuous",)) if bounded else ((), ())
    titles = (*names, *held, _SAFE, *best, *continuous, *_TITLES)
    table = make_table("l" * len(names) + "r", *titles, tight=False)
    for row in shown:
        filtered = row["filter"] != UNFILTERED
        rates = [
            row[name] if filtered else None for name in ("intervention_rate", "infeasible_rate")
        ]
        bounds = bound_cells(row)
        table.add_row(
            *(Text(_value(row[name])) for name in names),
            *bounds[: len(held)],
            rate_of(row),
            *_best_cells(row)[: len(best)],
            *bounds[1 : 1 + len(continuous)],
            f"{row['min_h_p05']:.3g}",
            str(row["violations"]),
            *map(percent, rates),
            f"{row['return_mean']:.4g}",
        )
    if table.row_count:
        say(console, f"\nThe {table.row_count} worst:")
        console.print(table)
    if failed:
        say(console, "\nFailed:")
    for row in failed:
        told = ", ".join(f"{name} = {_value(row[name])}" for name in names)
        say(console, f"  {told or 'the only cell'}: {row['error']}")


def report_document(index: dict[str, Any], rows: Sequence[Row], worst: int) -> dict[str, Any]:
    """Return the content of `print_cells`, with the same arguments, as JSON-able data.

    Args:
        index: of the sweep.
        rows: its cells.
        worst: how many of the worst to return.
    """
    failed = _failed(rows)
    return {
        "swept": index["swept"],
        "cells": len(index["cells"]),
        "done": len(rows) - len(failed),
        "worst": [_plain(row) for row in _worst(rows, worst)],
        "failed": [_plain(row) for row in failed],
    }


def sweep_document(sweep: Sweep, failures: Sequence[JobOutcome]) -> dict[str, Any]:
    """Return what was swept and which cells failed, as JSON-able data.

    Args:
        sweep: that was computed.
        failures: outcomes of the cells that failed.
    """
    from safe_envs.agents.sweeps.cell import versions

    errors = {outcome.key: outcome.error for outcome in failures}
    failed = [
        {"key": cell.key, "settings": cell.settings, "error": errors[cell.key]}
        for cell in sweep.cells
        if cell.key in errors
    ]
    return {"failed": failed, "swept": sweep.swept, "versions": versions()}


def failures_text(sweep: Sweep, failures: Sequence[JobOutcome]) -> str:
    """Return which cells failed and why, in the order of the file.

    Args:
        sweep: that was computed.
        failures: outcomes of the cells that failed.
    """
    from safe_envs.agents.sweeps.spec import describe

    errors = {outcome.key: outcome.error for outcome in failures}
    lines = [
        f"{describe(cell, sweep.swept) or 'the only cell'}: {errors[cell.key]}"
        for cell in sweep.cells
        if cell.key in errors
    ]
    more = f"and {len(lines) - _SHOWN} more, which `safe-envs sweep-report` lists"
    return "\n  ".join(
        [
            f"{len(lines)} of {len(sweep.cells)} cells failed; the same command tries them again:",
            *lines[:_SHOWN],
            *[more] * (len(lines) > _SHOWN),
        ]
    )


def _worst(rows: Sequence[Row], count: int) -> list[Row]:
    """Return the cells with the smallest rate, and among equals the smallest h."""
    done = [row for row in rows if row["error"] is None]
    return sorted(done, key=lambda row: (row["safety_rate"], row["min_h_p05"]))[:count]


def _best_cells(row: Row) -> tuple[str, str]:
    """Return the best attainable safety, and how many times the unavoidable violations."""
    lower, upper = row["best_lower"], row["best_upper"]
    times = times_between(lower, upper, row["ci_low"], row["ci_high"])
    return ends_text(lower, upper), times_text(times)


def _failed(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["error"] is not None]


def _plain(row: Row) -> Row:
    """Return a row without the documents in it, and without what it leaves to its env."""
    return {k: v for k, v in row.items() if v is not None and k not in _DOCUMENTS}


def _value(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)
