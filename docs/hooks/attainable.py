"""The table of the best attainable safety of each env, from what commands have written.

    safe-envs best safe_envs/Scalar-v0 --json FOLDER/Scalar.json
    safe-envs evaluate safe_envs/Quadrotor-v0 --knowledge plant --json FOLDER/Quadrotor.json
    python docs/hooks/attainable.py FOLDER

take the files of a folder over into `docs/assets/attainable.json`, those of `evaluate` for envs
that no grid serves. Entries of other envs remain.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from safe_envs.text import percents_between

KEPT = Path(__file__).resolve().parents[1] / "assets" / "attainable.json"

_HEADER = (
    "| env | lower | upper | simulated [95 % interval] | by |\n|---|---|---|---|---|",
    "| env | coordinates | grid | steps | time | table |\n|---|---|---|---|---|---|",
)
"""Of the values, and of the grids they were computed on."""

_NEAR = 0.01
"""Of a gap that is called one: below, lower and upper are close."""

_OF_BEST = ("lower", "upper", "contradiction", "coordinates", "cells", "steps", "seconds", "memory")


def attainable_table(kept: Path = KEPT) -> str:
    """Return Markdown with a line for each env of the file, and one for each grid."""
    entries = sorted(json.loads(kept.read_text()).items())
    values = [_line(*entry) for entry in entries]
    grids = [_grid_line(name, entry) for name, entry in entries if "cells" in entry]
    return "\n".join([_HEADER[0], *values, "", _HEADER[1], *grids])


def taken_over(folder: Path, kept: Path = KEPT) -> None:
    """Add what commands wrote to a folder, a file for each env, to the entries of a file."""
    entries = json.loads(kept.read_text()) if kept.exists() else {}
    for path in sorted(folder.glob("*.json")):
        entries[path.stem] = entry_of(json.loads(path.read_text()))
    kept.write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n")


def entry_of(document: dict[str, Any]) -> dict[str, Any]:
    """Return what the table shows of a document of `best`, or of `evaluate`."""
    if "rows" not in document:
        kept = {name: document[name] for name in _OF_BEST}
        kept["simulated"] = [document["simulated"], *document["simulated_interval"]]
        return kept | {"by": "best"}
    safest = max(document["rows"], key=lambda row: row["safety_rate"])
    rate = [safest[name] for name in ("safety_rate", "ci_low", "ci_high")]
    return {"simulated": rate, "by": safest["filter"]}


def _line(name: str, entry: dict[str, Any]) -> str:
    rate, low, high = (100.0 * share for share in entry["simulated"])
    by = entry["by"] if entry["by"] == "best" else f"`{entry['by']}`"
    if "cells" not in entry:
        bounds = "no grid | no grid"
    elif entry["contradiction"]:
        bounds = "withheld | withheld"
    elif entry["upper"] - entry["lower"] >= 1.0 - _NEAR:
        bounds = "0 (grid too coarse) | 1 (grid too coarse)"
    else:
        ends = percents_between(entry["lower"], entry["upper"], 2)
        bounds = " | ".join(f"{end} %" for end in ends)
    return f"| {_link(name)} | {bounds} | {rate:.1f} % [{low:.1f}, {high:.1f}] | {by} |"


def _grid_line(name: str, entry: dict[str, Any]) -> str:
    coordinates = ", ".join(f"`{c}`" for c in entry["coordinates"])
    return (
        f"| {_link(name)} | {coordinates} | {' x '.join(map(str, entry['cells']))} |"
        f" {entry['steps']} | {entry['seconds']:.0f} s | {entry['memory'] / 1e6:.0f} MB |"
    )


def _link(name: str) -> str:
    return f"[{name}](../envs/{name}.md)"


if __name__ == "__main__":
    taken_over(Path(sys.argv[1]))
