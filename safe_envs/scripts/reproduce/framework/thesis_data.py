"""Settings, printed numbers, assumptions and errata of the thesis: `thesis/chapter_N.yaml`.

A file has `settings` (sections of named values) and `artefacts`. An artefact has a title, the size
of its figure in inches, the lines of its setting, its assumptions and errata, the argument why it
cannot be reproduced, if any, notes and claims by name, and its printed numbers. A claim has a
sentence, its evidence, and `printed: no` if it is a check of ours. In these texts {name} is a value
of the section that the artefact names, or one that its module gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import yaml
from matplotlib.figure import Figure

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Findings, Workload

_SIZE = [7.0, 4.2]
_TEXTS = ("setting", "assumptions", "errata")
_FIELDS = {"settings", "title", "size", *_TEXTS, "argument", "notes", "claims", "printed"}


@dataclass(frozen=True)
class Chapter:
    """What the thesis and this project's reading of it say about a chapter.

    Attributes:
        settings: values by name, of each section; lists are tuples.
        artefacts: texts and printed numbers, of each artefact.
    """

    settings: Mapping[str, Mapping[str, Any]]
    artefacts: Mapping[str, Mapping[str, Any]]

    def printed(self, artefact: str) -> dict[str, Any]:
        """Return the printed numbers of an artefact by name: a number each, or a tuple of them."""
        return dict(self.artefacts[artefact]["printed"])

    def note(self, artefact: str, name: str, /, **values: Any) -> str:
        """Return a note of an artefact.

        Args:
            artefact: its name.
            name: of the note.
            values: that the note names in addition to those of the section.
        """
        return self._filled(artefact, self.artefacts[artefact]["notes"][name], values)

    def claim(self, artefact: str, name: str, /, holds: Any, **values: Any) -> Claim:
        """Return a claim of an artefact.

        Args:
            artefact: its name.
            name: of the claim.
            holds: whether it is true.
            values: that sentence and evidence name in addition to those of the section.
        """
        text = self.artefacts[artefact]["claims"][name]
        sentence, evidence = (
            self._filled(artefact, text[part], values) for part in ("sentence", "evidence")
        )
        return Claim(sentence, bool(holds), evidence, text.get("printed", True))

    def _filled(self, artefact: str, text: str, values: Mapping[str, Any]) -> str:
        section = self.settings[self.artefacts[artefact]["settings"]]
        return text.format(**{**section, **values})

    def artefact(
        self,
        name: str,
        compute: Callable[[Workload], Findings],
        values: Callable[[Workload], Mapping[str, Any]],
        draw: Callable[[Figure, Findings], None] | None = None,
    ) -> Artefact:
        """Return an artefact with the texts of this chapter.

        Args:
            name: of the artefact, such as "table-4.1".
            compute: does the work.
            values: what the lines of the setting name beyond the section's values, for a sample.
            draw: fills an empty figure from the outcome; None for a table.
        """
        text = self.artefacts[name]
        section = self.settings[text["settings"]]

        def filled(field: str, **more: Any) -> tuple[str, ...]:
            return tuple(line.format(**{**section, **more}) for line in text[field])

        return Artefact(
            name,
            text["title"],
            compute,
            lambda sample: filled("setting", **values(sample)),
            filled("assumptions"),
            filled("errata"),
            text["argument"].format(**section),
            draw,
            text["size"],
        )


@cache
def chapter(number: int) -> Chapter:
    """Return the data of a chapter, checked.

    Raises:
        ConfigurationError: the file has an unknown field, a value of a wrong type, or lacks one.
    """
    name = f"chapter_{number}.yaml"
    text = (files("safe_envs.scripts.reproduce") / "thesis" / name).read_text(encoding="utf-8")
    return read(text, name)


def read(text: str, name: str) -> Chapter:
    """Return what the text of a file says.

    Args:
        text: YAML, see the module.
        name: of the file, for messages.

    Raises:
        ConfigurationError: see `chapter`.
    """
    try:
        document = yaml.safe_load(text)
        settings = {section: _values(each) for section, each in document["settings"].items()}
        artefacts = {key: _artefact(each, settings) for key, each in document["artefacts"].items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigurationError(f"{name}: {type(error).__name__}: {error}") from error
    return Chapter(settings, artefacts)


def _artefact(given: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    if unknown := given.keys() - _FIELDS:
        raise ValueError(f"unknown fields {sorted(unknown)}; allowed: {sorted(_FIELDS)}")
    if given["settings"] not in settings:
        raise ValueError(f"no section {given['settings']!r} in settings")
    single = {key: _text(given.get(key, "")) for key in ("settings", "title", "argument")}
    lines = {key: tuple(_lines(given.get(key, []))) for key in _TEXTS}
    notes = {key: _text(text) for key, text in given.get("notes", {}).items()}
    named = {key: _values(given.get(key, {})) for key in ("claims", "printed")}
    return {**single, **lines, "notes": notes, **named, "size": _value(given.get("size", _SIZE))}


def _lines(given: Any) -> list[str]:
    """Return texts of lists in lists as one list: an anchor may stand for several lines."""
    if isinstance(given, list):
        return [line for each in given for line in _lines(each)]
    return [_text(given)]


def _text(given: Any) -> str:
    if not isinstance(given, str):
        raise TypeError(f"{given!r} is not a text")
    return given


def _values(given: Mapping[str, Any]) -> dict[str, Any]:
    return {_text(name): _value(value) for name, value in given.items()}


def _value(given: Any) -> Any:
    """Return a finite number, a text, a tuple of such, or values by name."""
    if isinstance(given, dict):
        return _values(given)
    if isinstance(given, list):
        return tuple(map(_value, given))
    if not isinstance(given, str | int | float) or (
        isinstance(given, float) and not math.isfinite(given)
    ):
        raise TypeError(f"{given!r} is neither a text nor a finite number")
    return given
