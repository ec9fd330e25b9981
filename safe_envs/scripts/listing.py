"""`safe-envs list`: the registered envs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, stdout, write_result
from safe_envs.scripts.reports.tables import make_table
from safe_envs.systems import ENV_IDS

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem

_COLUMNS = ("states", "inputs", "degree", "filter", "noise", "dt", "horizon")


def list_envs(json: Json = None) -> None:
    """List the registered envs."""
    from rich.markup import escape

    from safe_envs.registry import env_class, make_problem

    require_result(json)
    table = make_table("pl", "id, and what is to be kept safe", *_COLUMNS)
    table.columns[0].max_width = 50
    rows = []
    for env_id in ENV_IDS:
        about = " ".join((env_class(env_id).__doc__ or "").strip().partition("\n\n")[0].split())
        rows.append({"env_id": env_id, "about": about, **_defaults(make_problem(env_id))})
        cells = [_cell(name, rows[-1][name]) for name in _COLUMNS]
        table.add_row(f"[bold]{env_id}[/]\n{escape(about)}\n", *cells)
    stdout().print(table)
    write_result(json, lambda: {"envs": rows})


def _defaults(problem: SafetyProblem) -> dict[str, Any]:
    from safe_envs.dynamics.lie import relative_degree

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
    run_alone("list", list_envs)
