"""A study of agents, as tables and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.agents.training.seed_statistics import SeedEstimate
    from safe_envs.agents.training.study import StudyResult
    from safe_envs.agents.training.study_summary import AgentSummary

_TITLES = {
    "safety": "safe %",
    "returns": "return",
    "interventions": "inter-\nvened %",
    "safety_alone": "safe %,\nno filter",
    "returns_alone": "return,\nno filter",
    "violations": "unsafe\nsteps in\ntraining",
    "seconds": "s",
}
_PERCENT = ("safety", "interventions", "safety_alone")
_WITHOUT_INTERVAL = ("violations", "seconds")


def study_table(rows: Sequence[AgentSummary], differences: bool = False) -> Table:
    """Return a table with a row for each agent and filter.

    Args:
        rows: of an env.
        differences: whether they are differences, which have a sign.
    """
    table = make_table("lr", "agent", "filter", *_TITLES.values())
    for row in rows:
        table.add_row(row.name, row.filter, *_cells(row, differences))
    return table


def study_markdown(rows: Sequence[AgentSummary], differences: bool = False) -> str:
    """Return the table as Markdown; see `study_table`."""
    titles = ["agent", "filter", *(_one_line(title) for title in _TITLES.values())]
    lines = [[row.name, f"`{row.filter}`", *_cells(row, differences)] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in (titles, ["---"] * len(titles), *lines))


def study_notes(found: StudyResult) -> list[str]:
    """Return what has to be known to read the tables, and what is missing in them."""
    study = found.study
    notes = [
        f"interquartile means over {study.seeds} seeds with the 95 % bootstrap interval over them,"
        f" {study.episodes} episodes each; s is the processor time of a training."
    ]
    for (env_id, variant, k), reason in found.missing.items():
        which = variant if k is None else f"{variant}, training {k}"
        notes.append(f"{env_id}, {which}: {reason}.")
    return notes


def _one_line(title: str) -> str:
    return title.replace("-\n", "").replace("\n", " ")


def _cells(row: AgentSummary, differences: bool) -> list[str]:
    return [_text(name, row.estimates[name], differences) for name in _TITLES]


def _text(name: str, estimate: SeedEstimate | None, differences: bool) -> str:
    if estimate is None:
        return "-"
    factor = 100.0 if name in _PERCENT else 1.0
    ends = [factor * end for end in (estimate.value, estimate.low, estimate.high)]
    digits = 0 if name in _WITHOUT_INTERVAL else 1
    sign = "+" if differences else ""
    value, low, high = (f"{end:{sign},.{digits}f}" for end in ends)
    return value if name in _WITHOUT_INTERVAL else f"{value} [{low}, {high}]"
