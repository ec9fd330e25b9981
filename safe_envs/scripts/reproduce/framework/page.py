"""The page of a reproduction: one file of HTML that needs no network, and the same as Markdown."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.atomic_io import write_atomically
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.reproduce.framework.artefact import (
    Artefact,
    Claim,
    Findings,
    Number,
    Workload,
)
from safe_envs.scripts.reproduce.framework.verdict import RULES, Judgement, judge

_COLOURS, _WIDTH = 64, 1432
"""Of a picture on the page, which need not be larger than its lines and few areas ask for."""


@dataclass(frozen=True)
class _Entry:
    """An artefact on the page."""

    artefact: Artefact
    outcome: Findings
    seconds: float
    judgement: Judgement
    picture: str

    @property
    def settings(self) -> list[tuple[str, Sequence[Number]]]:
        """Return the tables of numbers, with their headings."""
        tables = [
            ("", self.outcome.numbers),
            *(
                (f"Other setting: {name}", found.numbers)
                for name, found in self.outcome.alternative_settings.items()
            ),
        ]
        tables.append(("By the printed formula", self.outcome.printed_formula))
        return [(heading, numbers) for heading, numbers in tables if numbers]

    @property
    def checks(self) -> list[tuple[str, list[Claim]]]:
        """Return claims of the thesis and checks of ours, with their headings.

        Those of another setting carry its name.
        """
        claims = [*self.outcome.claims]
        for name, found in self.outcome.alternative_settings.items():
            claims += [
                replace(claim, sentence=f"{claim.sentence} (other setting: {name})")
                for claim in found.claims
            ]
        both = [
            ("claim of the thesis", [c for c in claims if c.printed]),
            ("check of ours", [c for c in claims if not c.printed]),
        ]
        return [(heading, some) for heading, some in both if some]


def write_page(
    folder: Path, found: Sequence[tuple[Artefact, Findings, float]], sample: Workload
) -> None:
    """Write `index.html` and `index.md` of what was found.

    Args:
        folder: where pictures are, and the page goes.
        found: artefacts with their outcomes and the seconds that these took.
        sample: by which they were computed.
    """
    entries = [_Entry(a, o, s, judge(a, o, sample), _picture(folder, a)) for a, o, s in found]
    environment = Environment(
        loader=PackageLoader("safe_envs.scripts.reproduce.framework", "templates"),
        undefined=StrictUndefined,
        autoescape=_is_html,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"value": _value, "range": _range, "printed": _printed, "cell": _cell}
    for name in ("index.html", "index.md"):
        text = environment.get_template(f"{name}.jinja").render(
            entries=entries,
            sample=sample,
            rules=RULES,
            versions=package_versions(),
            seconds=sum(e.seconds for e in entries),
        )
        write_atomically(folder / name, lambda part, text=text: part.write_text(text))


def _is_html(name: str | None) -> bool:
    return name is not None and ".html" in name


def _picture(folder: Path, artefact: Artefact) -> str:
    """Return the picture as text, for a page without other files."""
    if artefact.draw is None:
        return ""
    light, path = io.BytesIO(), folder / f"{artefact.name}.png"
    try:
        with Image.open(path, formats=["png"]) as picture:
            whole = picture.convert("RGB")
            size = (_WIDTH, round(whole.height * _WIDTH / whole.width))
            smaller = whole.resize(size, Image.Resampling.LANCZOS)
            smaller.quantize(_COLOURS).save(light, "png", optimize=True)
    except (Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise ConfigurationError(
            f"{path} cannot be read ({error}); remove it, and it is drawn again"
        ) from error
    return base64.b64encode(light.getvalue()).decode()


def _value(number: Number) -> str:
    form = ".1f" if number.unit == "%" else ".3g"
    return f"{number.ours:{form}}{number.suffix}"


def _range(number: Number) -> str:
    if number.low is None or number.high is None:
        return ""
    form = ".1f" if number.unit == "%" else ".3g"
    return f"[{number.low:{form}}, {number.high:{form}}]"


def _printed(number: Number) -> str:
    if number.printed is None:
        return "-"
    size = f" (of {number.printed_trials})" if number.printed_trials else ""
    return f"{number.printed:g}{number.suffix}{size}"


def _cell(text: str) -> str:
    """Return a text as a cell of a Markdown table."""
    return text.replace("|", "\\|")
