"""What is shown of artefacts: in the terminal, as a page, and as data."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from textwrap import dedent
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markdown_it import MarkdownIt
from rich.console import Console

from safe_envs.agents.jobs.store import package_versions
from safe_envs.files import write_atomically
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows
from thesis import verdict
from thesis.artefact import DATA, Number, Outcome, Sample, Texts, chapter_of, texts
from thesis.verdict import Judgement, judge

_TITLES = ("thesis", "ours", "95 %")


@dataclass(frozen=True)
class Entry:
    """An artefact with its outcome, the seconds that this took, and how much was simulated."""

    name: str
    outcome: Outcome
    seconds: float
    sample: Sample

    @property
    def texts(self) -> Texts:
        """What the data file says of the artefact."""
        return texts()[self.name]

    @property
    def settings(self) -> str:
        """The settings as the data file has them, with units in comments."""
        text = (DATA / f"chapter_{chapter_of(self.name)}.yaml").read_text(encoding="utf-8")
        sections = re.findall(
            r"^(  (\w+):.*\n(?:    .*\n)+)", text.partition("\ncommon:")[0], re.MULTILINE
        )
        return dedent("".join(body for body, name in sections if name in self.texts.settings))

    @property
    def judgement(self) -> Judgement:
        """The verdict with its reasons."""
        return judge(self.outcome, self.sample, self.texts.argument)

    def tables(self) -> Iterator[tuple[str, list[tuple[str, ...]]]]:
        """Yield tables of numbers, with their headings: name, thesis, ours, interval."""
        others = self.outcome.alternative_settings.items()
        for heading, numbers in (
            ("", self.outcome.numbers),
            *((f"other setting: {name}", found.numbers) for name, found in others),
            ("by the printed formula", self.outcome.printed_formula),
        ):
            if numbers:
                yield heading, [_cells(number) for number in numbers]

    def claims(self) -> list[tuple[str, ...]]:
        """Return claims and checks: sentence, who says so, whether it holds, by what."""
        others = self.outcome.alternative_settings.items()
        every = [("", claim) for claim in self.outcome.claims]
        every += [
            (f" (other setting: {n})", claim) for n, found in others for claim in found.claims
        ]
        return [
            (
                claim.sentence + where,
                "thesis" if claim.printed else "check of ours",
                "yes" if claim.holds else "no",
                claim.evidence,
            )
            for where, claim in sorted(every, key=lambda each: not each[1].printed)
        ]

    def document(self) -> dict[str, Any]:
        """Return all of it as JSON-able data."""
        return {
            "name": self.name,
            "verdict": self.judgement.verdict.value,
            "reasons": list(self.judgement.reasons),
            "seconds": self.seconds,
            "outcome": self.outcome.document(),
        }


def _cells(number: Number) -> tuple[str, ...]:
    printed = "-"
    if number.printed is not None:
        size = f" (of {number.printed_trials})" if number.printed_trials else ""
        printed = f"{number.printed:g}{number.suffix}{size}"
    ours = number.text.removesuffix(number.interval).rstrip()
    return number.name, printed, ours, number.interval


def print_entry(console: Console, entry: Entry) -> None:
    """Print the verdict on an artefact with its reasons, numbers and claims."""
    say(console, f"\n{entry.name}: {entry.texts.title}\n{entry.judgement.text}")
    for reason in entry.judgement.reasons:
        say(console, f"  {reason}")
    for heading, rows in entry.tables():
        console.print()
        print_rows(console, "prrr", (heading, *_TITLES), rows)
    console.print()
    rows = [(sentence, holds) for sentence, _, holds, _ in entry.claims()]
    print_rows(console, "pl", ("claim", "holds"), rows)


def document(entries: Sequence[Entry], sample: Sample) -> dict[str, Any]:
    """Return artefacts with their verdicts and outcomes, as JSON-able data."""
    return {"sample": asdict(sample), "artefacts": [entry.document() for entry in entries]}


def write_page(folder: Path, entries: Sequence[Entry], sample: Sample) -> None:
    """Write `index.md` next to the pictures, and the same as `index.html`."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "data"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|")
    values = {
        "entries": entries,
        "titles": _TITLES,
        "sample": sample,
        "rules": verdict.__doc__,
        "versions": package_versions(),
        "pictures": {e.name for e in entries if (folder / f"{e.name}.svg").exists()},
    }
    markdown = environment.get_template("index.md.jinja").render(**values)
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)
    page = environment.get_template("index.html.jinja").render(body=html)
    for name, text in (("index.md", markdown), ("index.html", page)):
        write_atomically(folder / name, lambda part, text=text: part.write_text(text))
