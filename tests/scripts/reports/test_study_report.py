"""The Markdown of a study: tables that fit a page, with all the numbers of the printed one."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from safe_envs.agents.training.study import AgentSummary, SeedEstimate
from safe_envs.scripts.reports.leaderboard import study_columns, study_markdown
from safe_envs.scripts.reports.tables import print_columns

MOST_COLUMNS = 6


def summary(name, text, safety):
    values = {"safety": safety, "returns": 40.0, "interventions": 0.5, "safety_alone": 0.125}
    values |= {"returns_alone": 60.0, "violations": 34139.0, "seconds": 3.0}
    estimates = {key: SeedEstimate(value, value, value, 5) for key, value in values.items()}
    return AgentSummary("safe_envs/Scalar-v0", name, text, estimates)


ROWS = [summary("PPO", "scbf", 0.9), summary("PPO", "hocbf", 0.8), summary("SAC", "scbf", 0.7)]


def tables(markdown):
    """Return the rows of cells of each table."""
    found = [part.splitlines() for part in markdown.split("\n\n") if part.startswith("|")]
    return [[line.strip("| ").split(" | ") for line in lines] for lines in found]


@pytest.mark.parametrize("which", [0, 1])
def test_differences_have_a_sign(which):
    for line in tables(study_markdown(ROWS, differences=True))[which][2:]:
        assert all(cell.startswith("+") for cell in line[2 - which :])


def printed(rows):
    console = Console(file=io.StringIO(), width=100)
    columns = study_columns(rows)
    print_columns(console, columns[:2], columns[2:])
    return console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]


def test_what_is_seldom_is_not_printed_as_never_nor_what_is_frequent_as_always():
    row = summary("a", "scbf", 0.9997)
    rare = {name: SeedEstimate(1 / 3, 0.0, 1.0, 5) for name in ("violations", "seconds")}
    row = AgentSummary(row.env_id, row.name, row.filter, {**row.estimates, **rare})
    for text in (printed([row]), study_markdown([row])):
        assert "99.97 [99.97, 99.97]" in text
        assert text.split().count("0.3") == 2
