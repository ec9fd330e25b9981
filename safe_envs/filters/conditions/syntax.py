"""The text of a filter taken apart: names and places of conditions, their settings, their files."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from safe_envs.errors import (
    ConfigurationError,
    RelativeDegreeError,
    nearest,
    shown,
)
from safe_envs.filters.conditions.names import (
    BACKUP,
    BY_THEMSELVES,
    ONLY_DEGREE_1,
    PARAMETERS,
    PROMISE,
    condition_names,
    is_built_in,
    unknown_filter,
    wrong_rates,
)
from safe_envs.plugins import CONDITIONS, module_of, resolved

_FILE = r"(?:\.{0,2}/[^:]{0,4096}?|[^+:,/][^+:,]{0,4096}?)\.py:[A-Za-z_]\w*"
"""FILE.py:NAME; only a path from / or ./ may hold a "+" or a comma, for these divide conditions."""

_MODULE = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(?=\s*(?:[:+,]|$))"
"""MODULE:NAME; a parameter is none, for a "=" follows its name."""

_HEAD_BY_ITSELF = re.compile(rf"\s*({'|'.join(BY_THEMSELVES)})\s*(?:[:+]|$)")

_RATES = re.compile(r"alpha=[-+.0-9e]+(,[-+.0-9e]+)*")
"""Rates that are numbers; with class-K functions among them more may be wrong than their count."""


class ConditionText(NamedTuple):
    """The text of one condition, taken apart: its name or place, and what sets its parameters."""

    text: str
    name: str
    settings: list[str]


def head_pattern(*more: str) -> str:
    """Return the regular expression of what the text of a condition begins with.

    Args:
        more: names that are accepted besides those of conditions.
    """
    names = sorted((*more, *BY_THEMSELVES, *condition_names()), key=len, reverse=True)
    return rf"(?:(?:{'|'.join(map(re.escape, names))})(?=\s*(?:[:+,]|$))|{_FILE}|{_MODULE})"


def require_known(text: str, *more: str) -> None:
    """Raise ConfigurationError unless the text of a filter begins with the name of one.

    Args:
        text: as for `parse_conditions`.
        more: names that the message lists besides those of conditions.
    """
    name = parts_of(text)[0].name
    if not (_is_known(name) or name in BY_THEMSELVES):
        raise unknown_filter(name, *more)


def require_parameters(text: str) -> None:
    """Raise ConfigurationError for parameters that the conditions of a model do not have.

    Args:
        text: as for `parse_conditions`.
    """
    for part in parts_of(text):
        allowed = PARAMETERS.get(part.name, ())
        for key, _, value in (setting.partition("=") for setting in part.settings if allowed):
            if key not in allowed:
                raise ConfigurationError(
                    f"filter {part.name} has no parameter {shown(key)}; {nearest(key, allowed)}"
                )
            if not value:
                raise ConfigurationError(
                    f"filter {part.name} gives {key} no value; give it as {key}=VALUE"
                )


def require_degrees(text: str, degrees: Mapping[str, int]) -> None:
    """Raise an error for a cbf or hocbf that does not suit the degree of its barrier.

    Args:
        text: as for `parse_conditions`.
        degrees: relative degree of each barrier, by its name.

    Raises:
        RelativeDegreeError: A number of rates is not the relative degree.
    """
    parts = parts_of(text)
    for part, (barrier, degree) in zip(parts * len(degrees), degrees.items(), strict=False):
        rates = next((s for s in part.settings if _RATES.fullmatch(s)), None)
        if part.name == "cbf" and degree != 1:
            raise RelativeDegreeError(f"{wrong_rates(barrier, degree, 1)}. {ONLY_DEGREE_1}")
        if part.name == "hocbf" and rates is not None and rates.count(",") + 1 != degree:
            raise wrong_rates(barrier, degree, rates.count(",") + 1)


def name_by_itself(text: str) -> str:
    """Return the name of the filter that acts by itself, of which a text is; "" of conditions."""
    found = _HEAD_BY_ITSELF.match(text)
    return found.group(1) if found else ""


def names_promise(text: str) -> bool:
    """Return whether the text of a filter is that of the promise filter."""
    return name_by_itself(text) == PROMISE


def names_backup(text: str) -> bool:
    """Return whether the text of a filter is that of the backup filter."""
    return name_by_itself(text) == BACKUP


def _is_known(name: str) -> bool:
    return ":" in name or name in condition_names()


def parts_of(text: str) -> list[ConditionText]:
    """Take the text of a filter apart: a "+" divides where the head of a condition follows it."""
    head = re.compile(head_pattern())
    start = len(_head(text, head))
    # A class-K function, a complex pole or the path of a file may hold a "+" too.
    first, *others = re.split(rf"\+(?={head.pattern})", text[start:])
    return [_part(part, head) for part in (text[:start] + first, *others)]


def _part(text: str, head: re.Pattern[str]) -> ConditionText:
    name = _head(text, head)
    rest, *settings = text[len(name) :].split(":")
    return ConditionText(text, name + rest, settings)


def _head(text: str, head: re.Pattern[str]) -> str:
    """Return the name or the place at the beginning of a text."""
    found = head.match(text)
    name = found.group() if found else ""
    source, colon, _ = name.rpartition(":")
    is_there = found and (not colon or source.endswith(".py") or _has_module(source))
    return name if is_there else text.split(":")[0]


def _has_module(name: str) -> bool:
    top = name.split(".")[0]
    return top in sys.modules or importlib.util.find_spec(top) is not None


def learned_parts(text: str) -> list[tuple[str, str | None]]:
    """Return the method and the file, None without one, of each condition that needs a model."""
    from safe_envs.filters.conditions.registry import condition_class

    return [
        (method, next((s[len("file=") :] for s in part.settings if s.startswith("file=")), None))
        for part in parts_of(text)
        if _is_known(part.name) and (method := condition_class(part.name).method) is not None
    ]


def files_of(text: str) -> tuple[Path, ...]:
    """Return the files that the text of a filter names, of Python, a learned model or a table.

    Nothing is run and no file is opened.
    """
    parts = parts_of(text)
    sources = [part.name.rpartition(":")[0] for part in parts]
    settings = [s.partition("=") for part in parts for s in part.settings]
    names_file = _file_key(text)
    return tuple(
        Path(path)
        for path in (
            *(source for source in sources if source.endswith(".py")),
            *(value for key, _, value in settings if key == names_file),
        )
    )


def modules_of(text: str) -> tuple[str, ...]:
    """Return the modules of the conditions in a text that are MODULE:NAME or of a package.

    Nothing is imported.
    """
    found = (_module_of(part.name) for part in parts_of(text))
    return tuple(module for module in found if module is not None)


def _module_of(name: str) -> str | None:
    source, colon, _ = name.rpartition(":")
    if colon:
        return None if source.endswith(".py") else source
    return None if is_built_in(name) else module_of(CONDITIONS, name)


def with_absolute_paths(text: str) -> str:
    """Return the text of a filter with the whole paths of its files, as it holds in any folder."""
    names_file = _file_key(text)

    def absolute(setting: str) -> str:
        key, _, value = setting.partition("=")
        return f"{key}={os.path.realpath(value)}" if key == names_file else setting

    return "+".join(
        ":".join([resolved(part.name), *map(absolute, part.settings)]) for part in parts_of(text)
    )


def _file_key(text: str) -> str:
    """Return which setting of a filter names a file that it reads."""
    return "table" if names_promise(text) else "file"
