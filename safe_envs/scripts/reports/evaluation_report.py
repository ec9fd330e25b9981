"""The answer of an evaluation, and of its refinement, as a table and as a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.best_text import best_line
from safe_envs.agents.evaluation.evaluation_notes import evaluation_notes
from safe_envs.agents.evaluation.evaluation_table import (
    compared,
    describe,
    evaluation_table,
    interval_name,
)
from safe_envs.agents.evaluation.rate_text import percent_in, points_in
from safe_envs.agents.evaluation.refinement import TOLERANCE, Refinement
from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.agents.evaluation.setting_text import NOTHING_RANDOM, setting_text, unsafe_starts
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.engine_notes import engine_notes
from safe_envs.scripts.reports.tables import print_columns, print_rows
from safe_envs.text_lines import visible

_VERDICTS = {
    "converged": "converged",
    "not resolved": "not resolved: more episodes are needed",
    "still changing": "still changing",
    "integration": "the rate depends on the integration step too: raise substeps",
    "contradicted": "not called converged, since its bound is withheld: {}",
}


def print_evaluation(console: Console, evaluation: Evaluation, timing: bool = False) -> None:
    """Print a heading, a row for each filter, comparisons, and notes.

    Args:
        console: to print on.
        evaluation: to print.
        timing: whether to print the times too, which depend on the machine.
    """
    interval = interval_name(evaluation)
    say(console, heading(evaluation))
    if evaluation.best:
        say(console, best_line(evaluation.best))
    table = evaluation_table(evaluation, timing)
    console.print()
    print_columns(console, [table.names], table.columns, table.facts)
    console.print()
    differences = compared(evaluation)
    if differences:
        say(console, f"Difference of the safety rates on the same episodes [{interval}]:")
    for comparison in differences:
        say(console, f"  {describe(comparison)}")
    notes = _notes(evaluation, timing)
    if differences and notes:
        console.print()
    for note in notes:
        say(console, f"Note: {note}")


def print_refinement(console: Console, refinement: Refinement) -> None:
    """Print the safety rates with each control period, and whether they have converged.

    Args:
        console: to print on.
        refinement: to print.
    """
    interval, given = interval_name(refinement.given), refinement.given
    smallest = refinement.periods[-1] / given.problem.substeps
    noise = f"on the same noise, in integration steps of {smallest:g} s"
    noise = noise if refinement.coupled else "from the same starts, each with noise of its own"
    say(console, f"\nRefinement: safe [{interval}] with smaller control periods, {noise}")
    rows = []
    for row in refinement.rows:
        rates = [*zip(row.safety_rate, row.ci_low, row.ci_high, strict=True)]
        if not given.is_deterministic:
            rates.append((row.limit, row.limit_low, row.limit_high))
        rows.append([row.filter, *(percent_in(*rate) for rate in rates)])
    titles = ("filter", *(f"dt = {dt:g} s" for dt in refinement.periods))
    titles += ("dt -> 0",) * (not given.is_deterministic)
    console.print()
    print_rows(console, "lr", titles, rows)
    console.print()
    if given.is_deterministic:
        say(console, "Nothing is random here: what changes with the period, changes for sure.")
        return
    for row in refinement.rows:
        off = points_in(row.error, row.error_low, row.error_high)
        verdict = _VERDICTS[row.verdict].format(row.withheld)
        say(console, f"  {row.filter}: off its limit by {off}, {verdict}")
    power = "the square root of the period" if refinement.order == 0.5 else "the period"
    say(
        console,
        f"dt -> 0: extrapolated from the two smallest periods, in {power}; the interval has the"
        " terms of higher order too, as the largest period shows them.",
    )
    say(
        console,
        f"Converged: the {interval} of the distance of the rate with dt from this limit reaches no"
        f" further than {100 * TOLERANCE:g} points either way.",
    )


def heading(evaluation: Evaluation) -> Text:
    """Return what was evaluated, in two lines."""
    return heading_of(evaluation.config, evaluation.problem, evaluation.counted)


def heading_of(config: Mapping[str, Any], problem: SafetyProblem, what: str) -> Text:
    """Return what was evaluated, in two lines.

    Args:
        config: of the evaluation.
        problem: that was evaluated.
        what: number of the episodes.
    """
    title = Text(visible(config["title"], keep=""), style="bold")
    title.append(
        f" | policy {config['policy']['name']} | {what} | seed {config['seed']}", style="not bold"
    )
    title.append(f"\n{setting_text(config, problem)}", "not bold")
    return title


def _notes(evaluation: Evaluation, timing: bool) -> list[str]:
    """Return what has to be known to read the table."""
    notes = unsafe_starts(1.0 - evaluation.rows[0].curve.rate[0]) + evaluation_notes(evaluation)
    if timing:
        speeds = evaluation.timing.rows
        notes += engine_notes([(row.filter, row.engine, row.jobs) for row in speeds])
    if evaluation.is_deterministic:
        notes.append(NOTHING_RANDOM)
    return notes
