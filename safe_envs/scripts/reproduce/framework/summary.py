"""The verdicts on several artefacts, as a table and as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.table import Table

from safe_envs.scripts.reports.tables import make_table
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Findings, Workload
from safe_envs.scripts.reproduce.framework.verdict import judge

Found = Sequence[tuple[Artefact, Findings, float]]
"""Artefacts with their outcomes and the seconds that these took."""


def summary_document(found: Found, sample: Workload) -> dict[str, Any]:
    """Return artefacts with their verdicts and outcomes, as JSON-able data.

    Args:
        found: what was computed.
        sample: by which.
    """
    rows = []
    for artefact, outcome, seconds in found:
        judgement = judge(artefact, outcome, sample)
        verdict = {"verdict": judgement.verdict.value, "reasons": list(judgement.reasons)}
        rows.append(
            {"name": artefact.name, **verdict, "seconds": seconds, "outcome": outcome.document()}
        )
    return {"sample": asdict(sample), "artefacts": rows}


def summary_table(found: Found, sample: Workload) -> Table:
    """Return a table of verdicts.

    Args:
        found: what was computed.
        sample: by which.
    """
    table = make_table("llp", "artefact", "verdict", "because", tight=False)
    for artefact, outcome, _ in found:
        judgement = judge(artefact, outcome, sample)
        table.add_row(artefact.name, judgement.text, "; ".join(judgement.reasons))
    return table
