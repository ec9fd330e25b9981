"""The result of `safe-envs evaluate --rare` as a table."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.agents.evaluation.brownian_bridge import bridge_notes
from safe_envs.agents.evaluation.evaluation_notes import early_end
from safe_envs.agents.evaluation.setting_text import unsafe_starts
from safe_envs.agents.rare_events.estimate import RareEvaluation
from safe_envs.agents.rare_events.rows import RareRow
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.engine_notes import engine_notes
from safe_envs.scripts.reports.evaluation_report import heading_of
from safe_envs.scripts.reports.tables import print_rows

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
    for note in _notes(answer, timing):
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


def _notes(answer: RareEvaluation, timing: bool) -> list[str]:
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
