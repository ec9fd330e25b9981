"""`safe-envs list`: what there is to evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.markup import escape

from safe_envs import ENV_IDS, SafetyProblem
from safe_envs.dynamics.lie import relative_degree
from safe_envs.registry import env_class, make_problem
from safe_envs.scripts.options.console import require_result, stdout, write_result
from safe_envs.scripts.reports.tables import make_table

_COLUMNS = ("states", "inputs", "degree", "filter", "noise", "dt", "horizon")


def list_envs(json_file: Path | None = None) -> None:
    """Print a table of the registered envs, with what each is about and its defaults.

    Args:
        json_file: where the same goes as JSON, if it is to.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    require_result(json_file)
    table = make_table("pl", "id, and what is to be kept safe", *_COLUMNS)
    table.columns[0].max_width = 50
    rows = [
        {"env_id": env_id, "about": _about(env_id), **_defaults(make_problem(env_id))}
        for env_id in ENV_IDS
    ]
    for row in rows:
        table.add_row(
            f"[bold]{row['env_id']}[/]\n{escape(row['about'])}\n",
            *[_cell(name, row[name]) for name in _COLUMNS],
        )
    stdout().print(table)
    write_result(json_file, lambda: {"envs": rows})


def _about(env_id: str) -> str:
    return (env_class(env_id).__doc__ or "").strip().partition("\n")[0]


def _defaults(problem: SafetyProblem) -> dict[str, Any]:
    levels = {p.name: value for p, value in problem.plant.parameters.items()}
    return {
        "states": problem.plant.n,
        "inputs": problem.plant.m,
        "degree": [relative_degree(problem.model, b.expression) for b in problem.barriers],
        "filter": problem.filter,
        "noise": [levels[name] for name in problem.noise],
        "dt": problem.dt,
        "horizon": problem.horizon,
    }


def _cell(name: str, value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{entry:g}" for entry in value) or "-"
    return f"{value:g} s" if name in ("dt", "horizon") else str(value)


if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main("list")
