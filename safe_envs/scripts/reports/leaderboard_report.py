"""The leaderboard of agents, as a table and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from safe_envs.agents.evaluation.rate_text import percent_in
from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.agents.training.leaderboard import LeaderboardRow

_ROWS = 5
"""Rows of each env: the first, third and last are those of a policy without another filter."""


def leaderboard_table(rows: Sequence[LeaderboardRow]) -> Table:
    """Return a table with a row for each policy and filter."""
    titles = ("env", "policy", "filter", "safe [95 % interval]", "return", "processor time")
    table = make_table("lllr", *titles, tight=False)
    for row in rows:
        name = row.env_id.removeprefix("safe_envs/")
        statistics = (_rate(row), f"{row.return_mean:.4g}", _time(row))
        table.add_row(name, row.policy, row.filter, *statistics)
    return table


def leaderboard_markdown(rows: Sequence[LeaderboardRow]) -> str:
    """Return a table in Markdown with a row for each env: safety and return of each policy."""
    policies = [
        f"{row.policy} + filter" if k % 2 else row.policy for k, row in enumerate(rows[:_ROWS])
    ]
    table = [["env", "filter", *policies, "processor time"], ["---"] * 8]
    for k in range(0, len(rows), _ROWS):
        of_env = rows[k : k + _ROWS]
        cells = [f"{_rate(row)}, {row.return_mean:.4g}" for row in of_env]
        name = of_env[0].env_id.removeprefix("safe_envs/").removesuffix("-v0")
        table.append([name, of_env[1].filter, *cells, f"{_time(of_env[2])}, {_time(of_env[4])}"])
    return "\n".join(f"| {' | '.join(line)} |" for line in table)


def _rate(row: LeaderboardRow) -> str:
    return percent_in(row.safety_rate, row.ci_low, row.ci_high)


def _time(row: LeaderboardRow) -> str:
    return "-" if row.trained_in is None else f"{row.trained_in:.0f} s"
