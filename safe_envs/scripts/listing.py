"""`safe-envs list`: the registered envs."""

from __future__ import annotations

from typing import Any

from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, stdout, write_result
from safe_envs.systems import ENV_IDS

_COLUMNS = ("states", "inputs", "degree", "filter", "noise", "dt", "horizon")


def list_envs(json: Json = None) -> None:
    """List the registered envs."""
    from rich.markup import escape

    from safe_envs.scripts.reports.tables import make_table
    from safe_envs.systems.summary import summaries

    require_result(json)
    table = make_table("pl", "id, and what is to be kept safe", *_COLUMNS)
    table.columns[0].max_width = 50
    rows = []
    for env_id in ENV_IDS:
        found = summaries()[env_id]
        values = {
            "states": len(found.states),
            "inputs": len(found.inputs),
            "degree": list(found.degree.values()),
            "filter": found.filter,
            "noise": list(found.noise.values()),
            "dt": found.dt,
            "horizon": found.horizon,
        }
        rows.append({"env_id": env_id, "about": found.about, **values})
        cells = [_cell(name, value) for name, value in values.items()]
        table.add_row(f"[bold]{env_id}[/]\n{escape(found.about)}\n", *cells)
    stdout().print(table)
    write_result(json, lambda: {"envs": rows})


def _cell(name: str, value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{entry:g}" for entry in value) or "-"
    return f"{value:g} s" if name in ("dt", "horizon") else str(value)


if __name__ == "__main__":
    run_alone("list", list_envs)
