"""The leaderboard of agents, as tables and as Markdown."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.statistics import percent_in
from safe_envs.agents.evaluation.table import best_notes, best_text
from safe_envs.agents.training.study import caution
from safe_envs.errors import ConfigurationError
from safe_envs.files import read_bytes, require_writable, write_atomically
from safe_envs.text import Column, columns_of

if TYPE_CHECKING:
    from safe_envs.agents.training.leaderboard import LeaderboardEntry
    from safe_envs.agents.training.study import AgentSummary, SeedEstimate, StudyResult


_NONE = "-"
_UNIT = " %"
_DIGITS = 4


@dataclass(frozen=True)
class LeaderboardReport:
    """All that a leaderboard tells.

    Attributes:
        found: of the study.
        entries: of each variant on each env, in their order.
        over_envs: safety over all envs, by variant.
        best: the best attainable safety of each env, or why there is none, as far as is known.
    """

    found: StudyResult
    entries: tuple[LeaderboardEntry, ...]
    over_envs: Mapping[str, SeedEstimate]
    best: Mapping[str, AttainableSafety | str]

    def of(self, env_id: str) -> list[LeaderboardEntry]:
        """Return the entries of an env."""
        return [entry for entry in self.entries if entry.env_id == env_id]

    def best_of(self, env_id: str) -> AttainableSafety | None:
        """Return the best attainable safety of an env, where it is known."""
        found = self.best.get(env_id)
        return None if isinstance(found, str) else found

    def reasons(self) -> dict[str, list[str]]:
        """Return why variants are missing, and whose best attainable safety is, with their envs."""
        reasons: dict[str, list[str]] = {}

        def note(env_id: str, what: str, reason: str) -> None:
            name = short_name(env_id)
            # The same reason names each env in its turn.
            told = reason.replace(name, "it").rstrip(".")
            reasons.setdefault(f"{what}: {told}", []).append(name)

        for (env_id, variant, k), reason in self.found.missing.items():
            note(env_id, variant if k is None else f"{variant}, training {k}", reason)
        for env_id, found in self.best.items():
            if isinstance(found, str):
                note(env_id, "best", found)
        return reasons

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        return {
            "rows": [asdict(row) for row in self.found.rows],
            "entries": [asdict(entry) for entry in self.entries],
            "over_envs": {name: asdict(each) for name, each in self.over_envs.items()},
            "best": {
                key: each if isinstance(each, str) else each.as_dict()
                for key, each in self.best.items()
            },
            "missing": self.found.reasons(),
        }


def short_name(env_id: str) -> str:
    """Return the name of an env without its namespace and its version."""
    return env_id.removeprefix("safe_envs/").removesuffix("-v0")


def leaderboard_tables(report: LeaderboardReport) -> Iterator[tuple[str, list[Column]]]:
    """Yield a heading and the columns for each env, then those over all envs.

    Args:
        report: to tell.
    """
    seeds = report.found.study.seeds
    for env_id in report.found.study.env_ids:
        titles = (
            f"safe in %:\nIQM over {seeds}\nseeds [95 %]",
            "\nin % of their\nepisodes [95 %]",
            f"return:\nIQM over {seeds}\nseeds [95 %]",
            "\nunsafe\nsteps",
            "\n\nmin",
        )
        rows = [(_name(report, entry), *_cells(entry, unit="")) for entry in report.of(env_id)]
        best = report.best_of(env_id)
        if best is not None:
            safest = best_text(best).replace(_UNIT, "")
            rows.append(("best", safest, *[_NONE] * (len(titles) - 1)))
        columns = columns_of("lr", ("variant", *titles), rows)
        yield f"{short_name(env_id)}, filter {_filter(report, env_id)}", columns
    if len(report.found.study.env_ids) > 1 and report.over_envs:
        rows = [(name, _percent(estimate)) for name, estimate in report.over_envs.items()]
        columns = columns_of("lr", ("variant", "safe: IQM, 95 %"), rows)
        yield f"All {len(report.found.study.env_ids)} envs", columns


def leaderboard_notes(report: LeaderboardReport) -> list[str]:
    """Return what has to be known to read the tables, and what is missing in them.

    Args:
        report: to tell.
    """
    notes = [
        "IQM is the interquartile mean over seeds, with a bootstrap interval; the rate and the"
        " interval of the episodes are those of these agents alone. Unsafe steps are those of a"
        " training, min is its processor time in minutes.",
    ]
    notes += filter(None, [caution(report.found.study.seeds)])
    for found in report.best.values():
        if not isinstance(found, str):
            notes += best_notes(found)[:1]
    missing = [f"{', '.join(envs)}: {reason}." for reason, envs in report.reasons().items()]
    return [*dict.fromkeys(notes), *missing]


def leaderboard_markdown(report: LeaderboardReport, pictures: Mapping[str, str]) -> str:
    """Return Markdown with a table, and a picture where there is one, for each env.

    Args:
        report: to tell.
        pictures: links to them by env.
    """
    parts = []
    if len(report.found.study.env_ids) > 1 and report.over_envs:
        count = len(report.found.study.env_ids)
        rows = [[name, _percent(each)] for name, each in report.over_envs.items()]
        parts.append(f"### All {count} envs\n\n{_markdown(['variant', 'safe'], rows)}")
    titles = ["variant", "safe", "of the episodes", "return", "unsafe steps", "min"]
    for env_id in report.found.study.env_ids:
        name, best = short_name(env_id), report.best_of(env_id)
        rows = [[_name(report, entry), *_cells(entry)] for entry in report.of(env_id)]
        if best is not None:
            rows.append(["best", best_text(best), *[_NONE] * (len(titles) - 2)])
        picture = ""
        if env_id in pictures:
            picture = f"\n\n![Return against violations on {name}]({pictures[env_id]})"
        heading = f"### {name}\n\nFilter: `{_filter(report, env_id)}`."
        parts.append(f"{heading}{picture}\n\n{_markdown(titles, rows)}")
    # What to do about it comes after the first sentence.
    reasons = [
        f"- {', '.join(envs)}: {reason.split('. ')[0]}."
        for reason, envs in report.reasons().items()
    ]
    if reasons:
        parts.append("### What is missing\n\n" + "\n".join(reasons))
    return "\n\n".join(parts)


def _markdown(titles: list[str], rows: list[list[str]]) -> str:
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _name(report: LeaderboardReport, entry: LeaderboardEntry) -> str:
    """Return the name of a variant, with the number of its seeds where trainings failed."""
    seeds = entry.safety.seeds
    return entry.variant + (f", {seeds} seeds" if seeds < report.found.study.seeds else "")


def _filter(report: LeaderboardReport, env_id: str) -> str:
    """Return the text of the env's own filter."""
    from safe_envs.registry import make_problem

    return make_problem(env_id, **report.found.study.options).filter


def _cells(entry: LeaderboardEntry, unit: str = _UNIT) -> list[str]:
    pooled = percent_in(entry.safe / entry.episodes, entry.episodes_low, entry.episodes_high)
    unsafe = _NONE if entry.violations is None else _count(entry.violations.value)
    minutes = _NONE if entry.minutes is None else f"{entry.minutes:.2f}"
    rates = [rate.replace(_UNIT, unit) for rate in (_percent(entry.safety), pooled)]
    return [*rates, _number(entry.returns), unsafe, minutes]


def _count(value: float) -> str:
    """Return a count in at most six characters."""
    for scale, letter in ((1e6, " M"), (1e3, " k")):
        if value >= 9.9995 * scale:
            return f"{value / scale:.{1 if value < 99.95 * scale else 0}f}{letter}"
    # What is seldom is not never.
    return f"{value:,.{1 if 0.0 < value <= 0.5 else 0}f}"


def _percent(estimate: SeedEstimate) -> str:
    return percent_in(estimate.value, estimate.low, estimate.high)


def _number(estimate: SeedEstimate) -> str:
    """Return an estimate with its interval, all to the digits of the largest."""
    ends = (estimate.value, estimate.low, estimate.high)
    whole = len(f"{max(map(abs, ends)):.0f}")
    value, low, high = (f"{end:.{max(_DIGITS - whole, 0)}f}" for end in ends)
    return f"{value} [{low}, {high}]"


BEGIN, END = "<!-- leaderboard -->", "<!-- end of leaderboard -->"
"""The lines between which it is."""

_PART = re.compile(
    rf"((?:.*\n)?{re.escape(BEGIN)}(\r?\n))(?:.*\n)?({re.escape(END)}(?:\r?\n.*)?)", re.DOTALL
)
"""A page: up to the first line, the end of that line, and from the second line on."""


def put_into(page: Path, markdown: str | None) -> None:
    """Replace the part of a page between the two lines, and nothing else of it.

    Args:
        page: Markdown file.
        markdown: what is to be there; None to check the page only.

    Raises:
        ConfigurationError: the page cannot be read or written, or has not each line once, in this
            order.
    """
    try:
        text = read_bytes(page).decode()
    except OSError as error:
        raise ConfigurationError(
            f"--page {page} cannot be read ({error.strerror}); give a page that is there"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"--page {page} is no text in UTF-8 ({error}); give a page of Markdown"
        ) from error
    found = _PART.fullmatch(text)
    if found is None or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ConfigurationError(
            f"--page {page} needs the line {BEGIN} and below it the line {END}, each once; what is"
            " between them is replaced"
        )
    require_writable(page)
    if markdown is not None:
        before, newline, after = found.groups()
        lines = f"\n{markdown}\n\n".replace("\n", newline)
        whole = f"{before}{lines}{after}"
        write_atomically(page, lambda part: part.write_bytes(whole.encode()))


def link_from(page: Path | None, file: Path) -> str:
    """Return the link to a file in a page; without a page as it is seen from here.

    Args:
        page: that has the link.
        file: it leads to.
    """
    if page is None:
        return file.as_posix()
    return Path(os.path.relpath(file.resolve(), page.resolve().parent)).as_posix()


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
    cells = [(row.name, row.filter, *_agent_cells(row, differences)) for row in rows]
    return columns_of("llr", ("agent", "filter", *_TITLES.values()), cells)


def study_markdown(rows: Sequence[AgentSummary], differences: bool = False) -> str:
    """Return two tables in Markdown: one with the filter, one without it and of the training.

    One wide table would not fit a page. See `study_columns` for the arguments.
    """
    filtered = _markdown(
        ["agent", "filter", *map(_one_line, _FILTERED)],
        [[row.name, _code(row.filter), *_agent_cells(row, differences, _FILTERED)] for row in rows],
    )
    # With several filters an agent has several rows, which differ in the first table only.
    alone = {row.name: _agent_cells(row, differences, _ALONE) for row in rows}
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


def _code(text: str) -> str:
    """Return a text as code in a cell, which a bar such as that of a specification would end."""
    return f"`{text.replace('|', chr(92) + '|')}`"


def _one_line(name: str) -> str:
    return _TITLES[name].replace("-\n", "").replace("\n", " ")


def _agent_cells(row: AgentSummary, differences: bool, names: Iterable[str] = _TITLES) -> list[str]:
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
