"""A study of agents, as tables and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from safe_envs.agents.evaluation.rate_text import percent_in
from safe_envs.agents.training.seed_statistics import caution
from safe_envs.text_tables import Column, columns_of

if TYPE_CHECKING:
    from safe_envs.agents.training.seed_statistics import SeedEstimate
    from safe_envs.agents.training.study import StudyResult
    from safe_envs.agents.training.study_summary import AgentSummary

_TITLES = {
    "safety": "safe %",
    "returns": "return",
    "interventions": "inter-\nvened %",
    "safety_alone": "safe %,\nno filter",
    "returns_alone": "return,\nno filter",
    "violations": "unsafe\nsteps in\ntraining",
    "seconds": "s",
}
_FILTERED = ("safety", "returns", "interventions")
_ALONE = ("safety_alone", "returns_alone", "violations", "seconds")
_PERCENT = ("safety", "interventions", "safety_alone")
_WITHOUT_INTERVAL = ("violations", "seconds")


def study_columns(rows: Sequence[AgentSummary], differences: bool = False) -> list[Column]:
    """Return columns with an entry for each agent and filter; the first two are their names.

    Args:
        rows: of an env.
        differences: whether they are differences, which have a sign.
    """
    cells = [(row.name, row.filter, *_cells(row, differences)) for row in rows]
    return columns_of("llr", ("agent", "filter", *_TITLES.values()), cells)


def study_markdown(rows: Sequence[AgentSummary], differences: bool = False) -> str:
    """Return two tables in Markdown: one with the filter, one without it and of the training.

    One wide table would not fit a page. See `study_columns` for the arguments.
    """
    filtered = _markdown(
        ["agent", "filter", *map(_one_line, _FILTERED)],
        [[row.name, _code(row.filter), *_cells(row, differences, _FILTERED)] for row in rows],
    )
    # With several filters an agent has several rows, which differ in the first table only.
    alone = {row.name: _cells(row, differences, _ALONE) for row in rows}
    unfiltered = _markdown(
        ["agent", *(_one_line(name).removesuffix(", no filter") for name in _ALONE)],
        [[name, *cells] for name, cells in alone.items()],
    )
    return f"With the filter:\n\n{filtered}\n\nWithout a filter, and in training:\n\n{unfiltered}"


def study_notes(found: StudyResult) -> list[str]:
    """Return what has to be known to read the tables, and what is missing in them."""
    study = found.study
    notes = [
        f"interquartile means over {study.seeds} seed{'s' if study.seeds > 1 else ''} with the 95 %"
        f" bootstrap interval, {study.episodes} episodes each; s is the processor time of a"
        " training.",
        *filter(None, [caution(study.seeds)]),
    ]
    for (env_id, variant, k), reason in found.missing.items():
        which = variant if k is None else f"{variant}, training {k}"
        notes.append(f"{env_id}, {which}: {reason}.")
    return notes


def _markdown(titles: list[str], lines: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (titles, ["---"] * len(titles), *lines))


def _code(text: str) -> str:
    """Return a text as code in a cell, which a bar such as that of a specification would end."""
    return f"`{text.replace('|', chr(92) + '|')}`"


def _one_line(name: str) -> str:
    return _TITLES[name].replace("-\n", "").replace("\n", " ")


def _cells(row: AgentSummary, differences: bool, names: Iterable[str] = _TITLES) -> list[str]:
    return [_text(name, row.estimates[name], differences) for name in names]


def _text(name: str, estimate: SeedEstimate | None, differences: bool) -> str:
    if estimate is None:
        return "-"
    ends = (estimate.value, estimate.low, estimate.high)
    if name in _PERCENT and not differences:
        return percent_in(*ends).replace(" %", "")
    sign = "+" if differences else ""
    if name in _WITHOUT_INTERVAL:
        # What is seldom is not never.
        digits = 1 if 0.0 < abs(estimate.value) <= 0.5 else 0
        return f"{estimate.value:{sign},.{digits}f}"
    factor = 100.0 if name in _PERCENT else 1.0
    value, low, high = (f"{factor * end:{sign},.1f}" for end in ends)
    return f"{value} [{low}, {high}]"
