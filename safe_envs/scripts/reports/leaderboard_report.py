"""The leaderboard of agents, as a table and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.rate_text import percent_in
from safe_envs.agents.evaluation.yardstick import times_unavoidable
from safe_envs.scripts.reports.best_text import best_notes, best_text, times_text
from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.agents.training.leaderboard import LeaderboardRow

Best = Mapping[str, AttainableSafety | str]

_ROWS = 5
"""Rows of each env: the first, third and last are those of a policy without another filter."""


def leaderboard_table(rows: Sequence[LeaderboardRow], best: Best) -> Table:
    """Return a table with a row for each policy and filter.

    Args:
        rows: of the leaderboard.
        best: the best attainable safety of each env, or why there is none, as far as is known.
    """
    compared = ("best", "times unavoidable") if best else ()
    titles = ("safe [95 % interval]", *compared, "return", "processor time")
    table = make_table("lllr", "env", "policy", "filter", *titles, tight=False)
    for row in rows:
        name, found = row.env_id.removeprefix("safe_envs/"), best.get(row.env_id)
        known = None if isinstance(found, str) else found
        times = times_text(times_unavoidable(known, row.ci_low, row.ci_high))
        statistics = (f"{row.return_mean:.4g}", _time(row))
        cells = (best_text(known), times)[: len(compared)]
        table.add_row(name, row.policy, row.filter, _rate(row), *cells, *statistics)
    return table


def leaderboard_notes(best: Best) -> list[str]:
    """Return what has to be known to read the best attainable safety.

    Args:
        best: of each env, or why there is none, as far as is known.
    """
    notes = dict.fromkeys(
        note for found in best.values() if not isinstance(found, str) for note in best_notes(found)
    )
    missing = (f"{key}: {found}" for key, found in best.items() if isinstance(found, str))
    return [*notes, *missing]


def leaderboard_markdown(rows: Sequence[LeaderboardRow], best: Best) -> str:
    """Return a table in Markdown with a row for each env: safety and return of each policy.

    Args:
        rows: of the leaderboard.
        best: see `leaderboard_table`.
    """
    policies = [
        f"{row.policy} + filter" if k % 2 else row.policy for k, row in enumerate(rows[:_ROWS])
    ]
    compared = ["best"] * bool(best)
    titles = ["env", "filter", *compared, *policies, "processor time"]
    table = [titles, ["---"] * len(titles)]
    for k in range(0, len(rows), _ROWS):
        of_env = rows[k : k + _ROWS]
        cells = [f"{_rate(row)}, {row.return_mean:.4g}" for row in of_env]
        name = of_env[0].env_id.removeprefix("safe_envs/").removesuffix("-v0")
        found = best.get(of_env[0].env_id)
        known = [best_text(None if isinstance(found, str) else found)] * len(compared)
        times = f"{_time(of_env[2])}, {_time(of_env[4])}"
        table.append([name, of_env[1].filter, *known, *cells, times])
    return "\n".join(f"| {' | '.join(line)} |" for line in table)


def _rate(row: LeaderboardRow) -> str:
    return percent_in(row.safety_rate, row.ci_low, row.ci_high)


def _time(row: LeaderboardRow) -> str:
    return "-" if row.trained_in is None else f"{row.trained_in:.0f} s"
