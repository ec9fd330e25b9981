"""The cells of a sweep: what was computed, what was worst, and what failed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from safe_envs.agents.evaluation.attainable import times_between
from safe_envs.agents.evaluation.spec import is_unfiltered
from safe_envs.agents.evaluation.statistics import percent, rate_of
from safe_envs.agents.evaluation.table import bound_cells, ends_text, times_text
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_columns, print_rows
from safe_envs.text import Column, without_empty

if TYPE_CHECKING:
    from safe_envs.agents.jobs.job import JobOutcome
    from safe_envs.agents.sweeps.spec import Sweep


Row = dict[str, Any]

_SHOWN = 10
_SAFE = "safe [95 % interval]"
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
    if shown:
        say(console, f"\nThe {len(shown)} worst:")
        swept = [Column(name, tuple(_value(row[name]) for row in shown), "l") for name in names]
        print_columns(console, swept, _columns(shown))
    if failed:
        say(console, "\nFailed:")
    for row in failed:
        told = ", ".join(f"{name} = {_value(row[name])}" for name in names)
        say(console, f"  {told or 'the only cell'}: {row['error']}")


def _columns(rows: Sequence[Row]) -> list[Column]:
    """Return the columns on safety, those that some cell has something for, and on behavior."""
    bounds = [bound_cells(row) for row in rows]
    bests = [_best_cells(row) for row in rows]
    cells = {
        "held input": [held for held, _ in bounds],
        _SAFE: list(map(rate_of, rows)),
        "best": [best for best, _ in bests],
        "times un\u00adavoidable": [times for _, times in bests],
        "contin\u00aduous": [continuous for _, continuous in bounds],
        "viola\u00adtions": [str(row["violations"]) for row in rows],
    }
    safety, _ = without_empty([Column(title, tuple(each)) for title, each in cells.items()])
    behavior = {
        "min\u00a0h 5\u00a0%": [f"{_lowest(row):.3g}" for row in rows],
        "inter\u00advened": [_share(row, "intervention_rate") for row in rows],
        "infeas\u00adible": [_share(row, "infeasible_rate") for row in rows],
        "return": [f"{row['return_mean']:.4g}" for row in rows],
    }
    return [*safety, *(Column(title, tuple(each), part=1) for title, each in behavior.items())]


def _share(row: Row, name: str) -> str:
    return percent(row[name] if not is_unfiltered(row["filter"]) else None)


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
    from safe_envs.agents.sweeps.spec import versions

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
    return sorted(done, key=lambda row: (row["safety_rate"], _lowest(row)))[:count]


def _lowest(row: Row) -> float:
    """Return the 5 % quantile of the minimum h, which is null where h has no value."""
    return -math.inf if row["min_h_p05"] is None else row["min_h_p05"]


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


def print_evaluations(
    console: Console, filter_name: str, rows: Sequence[Mapping[str, Any]]
) -> None:
    """Print the safety and the return of the agent in each evaluation.

    Args:
        console: to print on.
        filter_name: text of the filter in the loop.
        rows: content of `evaluations.json`.
    """
    titles = ("steps", "safe [95 % interval]", "return", "violations in training")
    cells = [
        (
            f"{row['timesteps']:,}",
            rate_of(row),
            f"{row['return_mean']:.4g}",
            f"{row['training']['violations']:.0f}",
        )
        for row in rows
    ]
    say(console, f"Evaluations with the filter {filter_name}:")
    print_rows(console, "r", titles, cells)
    if rows and "constraint" in rows[-1]:
        _print_constraint(console, rows[-1])


def _print_constraint(console: Console, row: Mapping[str, Any]) -> None:
    """Print whether the agent keeps its limit."""
    judgement = row["constraint"]
    of_violations = judgement["kind"] == "violation_limit"
    what = "P(any violation)" if of_violations else "unsafe steps of an episode"

    def number(value: float) -> str:
        return f"{100.0 * value:.3g} %" if of_violations else f"{value:.3g}"

    limit = f"{what} <= {number(judgement['limit'])}"
    measured = "nothing in the training, as not every env has ended an episode"
    if judgement["episodes"]:
        interval = f"[{number(judgement['low'])}, {number(judgement['high'])}]"
        measured = (
            f"{number(judgement['mean'])} {interval} in the last {judgement['episodes']} episodes"
            " of the training, which explore"
        )
    if of_violations:
        low, high = 1.0 - row["ci_high"], 1.0 - row["ci_low"]
        measured += (
            f"; {number(1.0 - row['safety_rate'])} [{number(low)}, {number(high)}] in the"
            f" {row['episodes']} episodes of the last evaluation, which do not explore"
        )
    multiplier = f"The multiplier is {judgement['multiplier']:.3g}"
    multiplier += ", its greatest value." if judgement["saturated"] else "."
    if judgement["met"] is not False:
        say(console, f"Limit: {limit}. Measured: {measured}. {multiplier}")
        return
    if judgement["evaluation_met"]:
        say(
            console,
            f"NOT MET by the policy as it explores: the limit {limit}. Measured: {measured}."
            f" {multiplier} The evaluation does not exclude the limit.",
        )
        return
    say(
        console,
        f"NOT MET: the limit {limit}. Measured: {measured}. {multiplier} Either the limit cannot be"
        " reached, or the training is too short: give a larger limit, more steps, or a filter.",
    )
