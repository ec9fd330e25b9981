"""`safe-envs doctor`: whether the installation is complete and works, and how fast it is here."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.text import Text

from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.scripts.reports.installation import Check


def doctor(json: Json = None) -> None:
    """Check the installation.

    Checked are packages and extras, the solvers on problems with known answers, and every env with
    its default filter; the speed is measured.
    """
    from safe_envs import __version__
    from safe_envs.scripts.reports import installation

    require_result(json)
    parts = {
        "packages": installation.packages,
        "solvers": installation.solvers,
        "envs": installation.envs,
    }
    found: dict[str, list[Check]] = {}
    with progress_bar("Looking") as tell:
        for k, (title, look) in enumerate(parts.items()):
            found[title] = list(look())
            if tell is not None:
                tell((k + 1) / (len(parts) + 1))
        healthy = all(check.ok is not False for checks in found.values() for check in checks)
        speeds = installation.speeds() if healthy else {}
    say(stdout(), f"safe-envs {__version__} on {platform.platform()}\n")
    _print(found, speeds)
    say(stdout(), f"\n{'All is well.' if healthy else 'Something is wrong: see above.'}")
    document = {
        "healthy": healthy,
        "safe-envs": __version__,
        "checks": {title: [asdict(check) for check in checks] for title, checks in found.items()},
        "steps_per_second": speeds,
    }
    write_result(json, lambda: document)
    if not healthy:
        sys.exit(1)


def _print(found: Mapping[str, list[Check]], speeds: Mapping[str, float]) -> None:
    table = make_table("p", "", "", "found", "what to do", tight=False)
    for checks in found.values():
        for check in checks:
            mark = {True: "ok", False: "WRONG", None: "-"}[check.ok]
            advice = "" if check.ok else check.advice
            table.add_row(mark, Text(check.name), Text(check.found), Text(advice))
        table.add_section()
    for name, steps in speeds.items():
        table.add_row("", f"speed: {name}", f"{steps:,.0f} steps/s", "")
    stdout().print(table)


if __name__ == "__main__":
    run_alone("doctor", doctor)
