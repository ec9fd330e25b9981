"""The answer of an evaluation, and of its refinement, as a table and as a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.agents.evaluation.brownian_bridge import bridge_notes
from safe_envs.agents.evaluation.evaluate import TOLERANCE, Evaluation, Refinement
from safe_envs.agents.evaluation.notes import early_end, evaluation_notes
from safe_envs.agents.evaluation.statistics import percent_in, points_in
from safe_envs.agents.evaluation.table import (
    NOTHING_RANDOM,
    best_line,
    compared,
    describe,
    evaluation_table,
    interval_name,
    setting_text,
    unsafe_starts,
)
from safe_envs.agents.rare_events.estimate import RareEvaluation, RareRow
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_columns, print_rows
from safe_envs.text import visible


def engine_notes(rows: Sequence[tuple[str, str, int]]) -> list[str]:
    """Return which rows are of the compiled engine.

    Args:
        rows: filter, engine and threads of each.
    """
    compiled = [(name, jobs) for name, engine, jobs in rows if engine == "compiled"]
    if not compiled:
        return []
    names = "" if len(compiled) == len(rows) else f" of {', '.join(name for name, _ in compiled)}"
    jobs = compiled[0][1]
    threads = f"{jobs} threads" if jobs > 1 else "one thread"
    return [f"the steps/s{names} are those of the compiled engine, in {threads}."]


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


_COLUMNS = (
    "method",
    "particles",
    "levels",
    "simu\u00adlated steps",
    "plain episodes needed",
    "violations in plain episodes",
)


def print_rare(console: Console, answer: RareEvaluation, timing: bool = False) -> None:
    """Print a heading, a row for each filter, and what has to be known to read them.

    Args:
        console: to print on.
        answer: to print.
        timing: whether to print the speed too, which depends on the machine.
    """
    config = answer.config
    interval = f"{100 * config['confidence']:.10g} % interval"
    how = f"{config['repetitions']} repetitions"
    say(console, heading_of(config, answer.problem, f"rare violations, {how}"))
    titles = ("filter", f"P(violation) [{interval}]", *_COLUMNS, *["steps/s"] * timing)
    rows = [
        (row.filter, *_cells(row), *[_speed(row, speed["steps_per_second"])] * timing)
        for row, speed in zip(answer.rows, answer.timing["rows"], strict=True)
    ]
    console.print()
    print_rows(console, "lr", titles, rows)
    console.print()
    reasons = Table.grid()
    for reason in dict.fromkeys(row.reason for row in answer.rows if row.reason):
        names = ", ".join(row.filter for row in answer.rows if row.reason == reason)
        reasons.add_row(Text(f"Splitting cannot work here for {names}: {reason}.", overflow="fold"))
    if reasons.row_count:
        console.print(reasons)
    for note in _rare_notes(answer, timing):
        say(console, note)


def _speed(row: RareRow, speed: float) -> str:
    return _large(speed) if row.steps else "-"


def _cells(row: RareRow) -> list[str]:
    plain, needed = row.plain, row.plain_episodes_needed
    return [
        "none, see below"
        if row.probability is None
        else f"{row.probability:.3g} [{row.ci_low:.3g}, {row.ci_high:.3g}]",
        row.method or "-",
        str(row.particles) if row.steps else "-",
        f"{row.levels:.1f}" if row.steps else "-",
        _large(row.steps) if row.steps else "-",
        _large(needed) if needed else "-",
        f"{plain.violations} of {plain.episodes}" if plain else "-",
    ]


def _rare_notes(answer: RareEvaluation, timing: bool) -> list[str]:
    rows, steps = answer.rows, answer.problem.steps
    notes = [f"doubt the estimate of {row.filter}: {row.doubt}." for row in rows if row.doubt]
    notes += [
        f"the check on {row.filter}, by {row.check.method}, is {row.check}"
        for row in rows
        if row.check
    ]
    plain = [row.plain for row in rows if row.plain]
    if plain:
        notes += unsafe_starts(plain[0].outside / plain[0].episodes)
    if timing:
        speeds = answer.timing["rows"]
        notes += engine_notes([(each["filter"], each["engine"], each["jobs"]) for each in speeds])
    notes += [
        early_end(row.filter, "mean episode without a violation", length, steps)
        for row in rows
        if row.plain and (length := row.plain.kept_length) is not None and length < 0.99 * steps
    ]
    if answer.config["monitoring"] == "continuous":
        notes += bridge_notes(answer.problem)
    return [f"Note: {note}" for note in notes]


def _large(number: float) -> str:
    if number >= 1e12:
        return f"{number:.1e}"
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g} {letter}"
    return f"{number:.0f}"
