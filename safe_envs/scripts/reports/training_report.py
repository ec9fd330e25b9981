"""The evaluations of an agent during its training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from safe_envs.agents.evaluation.rate_text import rate_of
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import make_table


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
    table = make_table("r", *titles, tight=False)
    for row in rows:
        steps, violations = f"{row['timesteps']:,}", f"{row['training']['violations']:.0f}"
        table.add_row(steps, rate_of(row), f"{row['return_mean']:.4g}", violations)
    say(console, f"Evaluations with the filter {filter_name}:")
    console.print(table)
