"""Conditions as text: `hocbf:p=2,8`, or `hocbf:p=2,8+cbf:alpha=1` for two barriers.

A condition of a user's file is `FILE.py:NAME`, of a module `MODULE:NAME`, and its parameters follow:
`my_filter.py:Eager:gain=2`.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, shortened, shown
from safe_envs.number_text import real_or_complex
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.base import Condition
from safe_envs.wrappers.conditions.registry import (
    condition_class,
    condition_names,
    name_of,
    unknown_filter,
)
from safe_envs.wrappers.learning import LearnedModel, load_learned

_MOST_ENTRIES = 12
"""Of a parameter, as for the longest chain of integrators that anybody filters: the poles of a
dozen gains take a second."""

_FILE = r"(?:\.{0,2}/[^:]{0,4096}?|[^+:,/][^+:,]{0,4096}?)\.py:[A-Za-z_]\w*"
"""FILE.py:NAME; only a path from / or ./ may hold a "+" or a comma, for these divide conditions."""

_MODULE = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(?=\s*(?:[:+,]|$))"
"""MODULE:NAME; a parameter is none, for a "=" follows its name."""

Learned = Mapping[str, LearnedModel]
"""Learned models by method."""


class _Part(NamedTuple):
    """The text of one condition, taken apart: its name or place, and what sets its parameters."""

    text: str
    name: str
    settings: list[str]


def parse_conditions(
    text: str, problem: SafetyProblem, learned: Learned | None = None
) -> tuple[Condition, ...]:
    """Read a condition for every barrier of a problem.

    Args:
        text: one for all barriers, or one for each with "+" between; see `parse_condition`.
            `ddscbf:file=FILE` reads the learned model from a file of `safe-envs identify`.
        problem: problem whose barriers and gains are taken.
        learned: models for the conditions that name no file.

    Returns:
        As many conditions as barriers.

    Raises:
        ConfigurationError: As `parse_condition`, or there are neither one nor as many texts as
            barriers.
    """
    return _parsed(
        text,
        problem,
        lambda condition, path: _learned_for(text, condition, path, problem, learned or {}),
    )


def require_readable(text: str, problem: SafetyProblem) -> None:
    """Raise ConfigurationError where `parse_conditions` would, without reading learned models.

    Args:
        text: as for `parse_conditions`.
        problem: problem whose barriers and gains are taken.
    """
    _parsed(text, problem, lambda condition, path: None)


def parse_condition(text: str, gains: Sequence[float]) -> Condition:
    """Read a condition from its name, or its name and parameters.

    Args:
        text: name, and parameters as `key=value` with commas between the entries of a tuple:
            `scbf`, `hocbf:p=2,8`, `cbf:alpha=2*s**3`, `my_filter.py:Eager:gain=2`.
        gains: rates p_1..p_r in 1/s that set the parameters where the text names none of them.

    Raises:
        ConfigurationError: The name or a parameter is unknown or comes twice, or a value is not
            allowed.
    """
    part = _part(text, re.compile(head_pattern()))
    return _of_model(part, *_settings(part), gains)


def spec_of(conditions: Condition | Sequence[Condition]) -> str:
    """Return the text from which `parse_conditions` makes the same conditions.

    That of a class from a user's file holds the whole path of the file.
    """
    each = [conditions] if isinstance(conditions, Condition) else conditions
    texts = [_spec(condition) for condition in each]
    return texts[0] if len(set(texts)) == 1 else "+".join(texts)


def learned_parts(text: str) -> list[tuple[str, str | None]]:
    """Return the method and the file, None without one, of each condition that needs a model."""
    return [
        (method, next((s[len("file=") :] for s in part.settings if s.startswith("file=")), None))
        for part in _parts(text)
        if _is_known(part.name) and (method := condition_class(part.name).method) is not None
    ]


def files_of(text: str) -> tuple[Path, ...]:
    """Return the files that the text of a filter names, of Python or of a learned model.

    Nothing is run and no file is opened.
    """
    parts = _parts(text)
    sources = [part.name.rpartition(":")[0] for part in parts]
    settings = [s.partition("=") for part in parts for s in part.settings]
    return tuple(
        Path(path)
        for path in (
            *(source for source in sources if source.endswith(".py")),
            *(value for key, _, value in settings if key == "file"),
        )
    )


def with_absolute_paths(text: str) -> str:
    """Return the text of a filter with the whole paths of its files, as it holds in any folder."""
    return "+".join(
        ":".join(
            [
                f"{os.path.realpath(source)}:{name}" if source.endswith(".py") else part.name,
                *(
                    f"file={os.path.realpath(setting[len('file=') :])}"
                    if setting.startswith("file=")
                    else setting
                    for setting in part.settings
                ),
            ]
        )
        for part in _parts(text)
        for source, _, name in [part.name.rpartition(":")]
    )


def head_pattern(*more: str) -> str:
    """Return the regular expression of what the text of a condition begins with.

    Args:
        more: names that are accepted besides those of conditions.
    """
    names = sorted((*more, *condition_names()), key=len, reverse=True)
    return rf"(?:(?:{'|'.join(map(re.escape, names))})(?=\s*(?:[:+,]|$))|{_FILE}|{_MODULE})"


def require_known(text: str, *more: str) -> None:
    """Raise ConfigurationError unless the text of a filter begins with a condition.

    Args:
        text: as for `parse_conditions`.
        more: names that the message lists besides those of conditions.
    """
    name = _parts(text)[0].name
    if not _is_known(name):
        raise unknown_filter(name, *more)


def _is_known(name: str) -> bool:
    return ":" in name or name in condition_names()


def _parts(text: str) -> list[_Part]:
    """Take the text of a filter apart: a "+" divides where the head of a condition follows it."""
    head = re.compile(head_pattern())
    start = len(_head(text, head))
    # A class-K function, a complex pole or the path of a file may hold a "+" too.
    first, *others = re.split(rf"\+(?={head.pattern})", text[start:])
    return [_part(part, head) for part in (text[:start] + first, *others)]


def _part(text: str, head: re.Pattern[str]) -> _Part:
    name = _head(text, head)
    rest, *settings = text[len(name) :].split(":")
    return _Part(text, name + rest, settings)


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


def _parsed(
    text: str, problem: SafetyProblem, learned_for: Callable[[Any, str | None], Any]
) -> tuple[Condition, ...]:
    parts, count = _parts(text), len(problem.barriers)
    if len(parts) not in (1, count):
        allowed = "one" if count == 1 else f"one for all {count} barriers, or one for each"
        raise ConfigurationError(
            f"filter {shown(text)} has {len(parts)} conditions; {problem.name} takes {allowed}"
        )
    found: list[Condition] = []
    for i, part in enumerate(parts * count if len(parts) == 1 else parts):
        condition, given = _settings(part)
        if condition.method is not None:
            learned = learned_for(condition, given.pop("file", None))
            found.append(_made(part, condition.from_learned, learned, problem.gains_of(i), **given))
        else:
            found.append(_of_model(part, condition, given, problem.gains_of(i)))
    return tuple(found)


def _of_model(
    part: _Part, condition: Any, given: dict[str, Any], gains: Sequence[float]
) -> Condition:
    if condition.method is not None or set(given) <= {"sampling_margin"}:
        return replace(_made(part, condition.for_gains, gains), **given)
    return _made(part, condition, **given)


def _made(part: _Part, make: Callable[..., Condition], *args: Any, **given: Any) -> Condition:
    """Call what makes a condition; an error of a user's class becomes one of ours."""
    try:
        return make(*args, **given)
    except SafeEnvsError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"filter {shown(part.text)} cannot be made"
            f" ({type(error).__name__}: {shortened(error)}); correct {part.name}"
        ) from error


def _learned_for(
    text: str, condition: Any, path: str | None, problem: SafetyProblem, learned: Learned
) -> LearnedModel:
    if path is not None:
        return load_learned(path, problem, condition.method)
    if condition.method not in learned:
        raise ConfigurationError(
            f"filter {shown(text)} needs a learned model: run `safe-envs identify`, and name its"
            f" file as {condition.name}:file=FILE"
        )
    return learned[condition.method]


def _settings(part: _Part) -> tuple[Any, dict[str, Any]]:
    """Return the class of a condition, and the arguments that its text sets."""
    condition = condition_class(part.name)
    parameters = dict(inspect.signature(condition).parameters)
    if condition.method is not None:
        parameters.pop("learned", None)
    names = [*parameters, *["file"] * (condition.method is not None)]
    given: dict[str, Any] = {}
    for setting in part.settings:
        key, _, value = setting.partition("=")
        if key in given:
            raise ConfigurationError(f"filter {shown(part.text)} names {shown(key)} twice")
        if key not in names:
            hint = _hint(key, names, given)
            raise ConfigurationError(f"filter {part.name} has no parameter {shown(key)}; {hint}")
        given[key] = value if key == "file" else _value(part.text, parameters[key], value)
    return condition, given


def _hint(key: str, names: Sequence[str], given: Mapping[str, Any]) -> str:
    if key == "sha256":
        return "it stands for a learned model without a file: save it, and name that as file=FILE"
    if "file" in given:
        return (
            f"{nearest(key, names)}; a file whose name holds a colon is given by --learned, or read"
            " by load_learned"
        )
    return nearest(key, names)


def _value(text: str, parameter: inspect.Parameter, value: str) -> Any:
    """Return the value of a parameter: one entry, or a tuple where that is annotated or default."""
    default = parameter.default
    several = isinstance(default, tuple) or "tuple" in str(parameter.annotation)
    entries, most = value.split(","), _MOST_ENTRIES if several else 1
    if len(entries) > most:
        allowed = f"at most {most} values" if several else "one value"
        raise ConfigurationError(
            f"filter {shown(text)}: {parameter.name} takes {allowed}; {len(entries)} were given"
        )
    if several:
        return tuple(map(_entry, entries))
    if isinstance(default, bool) and value in ("True", "False"):
        return value == "True"
    entry = _entry(value)
    whole = type(default) is int and isinstance(entry, float) and entry.is_integer()
    return int(entry) if whole else entry


def _entry(text: str) -> Any:
    """Return a number where the text is one; the condition says what else it takes."""
    try:
        return real_or_complex(text)
    except ValueError:
        return text


def _spec(condition: Condition) -> str:
    given = dict(condition.parameters)
    if condition.sampling_margin != "none":
        given["sampling_margin"] = condition.sampling_margin
    settings = [
        f"{key}={','.join(map(str, value)) if isinstance(value, tuple) else value}"
        for key, value in given.items()
    ]
    return ":".join([name_of(type(condition)), *settings])
