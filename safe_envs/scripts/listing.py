"""`safe-envs list`: the registered envs."""

from __future__ import annotations

from typing import Any

from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, stdout, write_result
from safe_envs.systems import ENV_IDS

_COLUMNS = ("states", "inputs", "degree", "filter", "noise", "dt", "horizon")


def list_envs(json: Json = None) -> None:
    """List the registered envs."""
    from rich.text import Text

    from safe_envs.scripts.reports.tables import print_columns
    from safe_envs.systems.summary import summaries
    from safe_envs.text import Column

    require_result(json)
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
            "sensor": dict(found.sensors),
        }
        rows.append({"env_id": env_id, "about": found.about, **values})
    ids = Column("id", tuple(Text(row["env_id"], style="bold") for row in rows), "l")
    abouts = Column("what is to be kept safe", tuple(row["about"] for row in rows), "p")
    settings = [
        Column(name, tuple(_cell(name, row[name]) for row in rows), "l", part=1 + (i > 2))
        for i, name in enumerate(_COLUMNS)
    ]
    print_columns(stdout(), [ids], [abouts, *settings])
    write_result(json, lambda: {"envs": rows})


def _cell(name: str, value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{entry:g}" for entry in value) or "-"
    return f"{value:g} s" if name in ("dt", "horizon") else str(value)


if __name__ == "__main__":
    run_alone("list", list_envs)
