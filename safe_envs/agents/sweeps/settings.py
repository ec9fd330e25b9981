"""The settings of a sweep: their sections in a file, their names, and the kinds of their values."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, get_type_hints

from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec
from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.number_text import real
from safe_envs.problem.measurement_text import items_of
from safe_envs.problem.options import OPTION_NAMES, PARAMETER_GROUPS, WHOLE_OPTIONS
from safe_envs.registry import full_id

ENV_OPTIONS = ("system", *(name for name in OPTION_NAMES if name not in PARAMETER_GROUPS))
"""Settings that are arguments of `gym.make`."""

_OTHERWISE = ("problem", "filters", "options", "filter_spec", "learned", "trust")
"""Fields of an evaluation that a sweep states in another way, or not at all."""

EVALUATION_DEFAULTS: dict[str, Any] = {
    field.name: field.default for field in fields(EvaluationSpec) if field.name not in _OTHERWISE
} | {"bounds": False, "best": False, "closed_loop": False, "compare_estimates": False}
"""Settings that are fields of an `EvaluationSpec`, with the values of a cell without them."""

_SECTIONS = ("fixed", "grid", "cells")
_KINDS = get_type_hints(EvaluationSpec) | {
    **dict.fromkeys(WHOLE_OPTIONS, int),
    "policy": str,
    "estimator": str,
    "best": bool,
    "closed_loop": bool,
}
_WORDS = ("env", "system", "filter", *(name for name in EVALUATION_DEFAULTS if _KINDS[name] is str))
_NAMES = ("env", "filter", *ENV_OPTIONS, *EVALUATION_DEFAULTS)
_GROUPS = tuple(f"{group}.NAME" for group in PARAMETER_GROUPS)

Settings = dict[str, Any]


def sections(document: Any, what: str) -> tuple[Settings, dict[str, list[Any]], list[Settings]]:
    """Return the sections `fixed`, `grid` and `cells` of a sweep, each checked by itself.

    Args:
        document: content of the file.
        what: name of the sweep in errors.

    Raises:
        ConfigurationError: a section or a setting is unknown, or a value is not of its setting's
            kind.
    """
    given = _mapping(document, what, _SECTIONS)
    return (
        _settings(given.get("fixed"), f"{what}: fixed"),
        _grid(given.get("grid"), f"{what}: grid"),
        _listed(given.get("cells"), f"{what}: cells"),
    )


def complete(settings: Settings, what: str) -> Settings:
    """Return the settings of a cell in a fixed order, with the defaults of an evaluation.

    Args:
        settings: as given; checked by `sections`.
        what: name of the sweep in errors.

    Raises:
        ConfigurationError: the cell has no filter, or not just one of env and system.
    """
    if ("env" in settings) == ("system" in settings):
        raise ConfigurationError(
            f"{what}: a cell needs env: ENV_ID or system: FILE.py:NAME, one of the two"
        )
    if "filter" not in settings:
        raise ConfigurationError(
            f"{what}: a cell has no filter; name one, or {UNFILTERED} for the unfiltered env"
        )
    given = {**EVALUATION_DEFAULTS, **settings}
    return {
        name: given[name]
        for name in sorted(given, key=lambda name: (name not in _NAMES, _rank(name), name))
    }


def text_of(value: Any) -> str:
    """Return the value of a setting as text, also one that is not allowed, such as a YAML date."""
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value, default=str)
    except (TypeError, ValueError):
        return str(value)  # Keys of YAML need not be texts.


def _rank(name: str) -> int:
    return _NAMES.index(name) if name in _NAMES else PARAMETER_GROUPS.index(name.partition(".")[0])


def _mapping(given: Any, what: str, allowed: Sequence[str] | None) -> dict[str, Any]:
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        form = "NAME: VALUE entries" if allowed is None else f"the sections {', '.join(allowed)}"
        raise ConfigurationError(f"{what} is {shortened(text_of(given))}; give {form}")
    for name in given:
        if allowed is not None and name not in allowed:
            hint = (
                "a setting goes under fixed, a list of its values under grid"
                if _is_known(name)
                else nearest(name, allowed)
            )
            raise ConfigurationError(f"{what} has the section {shown(name)}; {hint}")
    return dict(given)


def _settings(given: Any, what: str) -> Settings:
    settings = _mapping({} if given is None else given, what, None)
    for name in settings:
        _require_known(name, what)
    return {name: _value(name, value, what) for name, value in settings.items()}


def _grid(given: Any, what: str) -> dict[str, list[Any]]:
    lists = _mapping({} if given is None else given, what, None)
    for name, values in lists.items():
        _require_known(name, what)
        if not isinstance(values, list) or not values:
            raise ConfigurationError(
                f"{what}: {name} = {shortened(text_of(values))}; give a list of values, or put it"
                " under fixed"
            )
    return {name: [_value(name, value, what) for value in values] for name, values in lists.items()}


def _listed(given: Any, what: str) -> list[Settings]:
    if given is None:
        return []
    if not isinstance(given, list) or not given:
        raise ConfigurationError(
            f"{what} is {shortened(text_of(given))}; give a list, each entry with settings"
        )
    return [_settings(each, f"{what}, entry {i}") for i, each in enumerate(given, 1)]


def _is_known(name: str) -> bool:
    group, dot, parameter = name.partition(".")
    return name in _NAMES or (group in PARAMETER_GROUPS and bool(dot and parameter))


def _require_known(name: str, what: str) -> None:
    if not _is_known(name):
        hint = (
            f"; give its parameters as {name}.NAME"
            if name in PARAMETER_GROUPS
            else f"; {nearest(name, (*_NAMES, *_GROUPS))}"
        )
        raise ConfigurationError(f"{what} has the setting {shown(name)}{hint}")


def _value(name: str, value: Any, what: str) -> Any:
    """Return a value of the kind that its setting takes, in one form where there are several."""
    if name in _WORDS:
        return _word(name, value, what)
    if _KINDS.get(name) is bool:
        if not isinstance(value, bool):
            raise ConfigurationError(
                f"{what}: {name} = {shortened(text_of(value))}; give true or false"
            )
        return value
    if _KINDS.get(name) is int:
        require_whole(f"{what}: {name}", value, WHOLE_OPTIONS.get(name, int(name != "seed")))
        return value
    if name == "measurement":
        try:
            return items_of(value)
        except ConfigurationError as error:
            raise ConfigurationError(f"{what}: {error}") from error
    if isinstance(value, list):
        return [_value(name, entry, what) for entry in value]
    return _number(name, value, what)


def _word(name: str, value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise ConfigurationError(f"{what}: {name} = {shortened(text_of(value))}; give a text")
    if "\0" in value:
        raise ConfigurationError(
            f"{what}: {name} = {shown(value)}, with a character that ends texts; leave it out"
        )
    if name == "system" and not (":" in value and value.rpartition(":")[0].endswith(".py")):
        raise ConfigurationError(
            f"{what}: system = {shortened(value)}; give FILE.py:NAME: by the content of that file a"
            " sweep tells which cells are done, and a module has none of its own"
        )
    if name == "env":
        try:
            return full_id(value)
        except ConfigurationError as error:
            raise ConfigurationError(f"{what}: {error}") from error
    return value


def _number(name: str, value: Any, what: str) -> Any:
    """Return a finite number, or a word where an env takes one.

    All but those of a barrier, which may be counts, are floats, so that equal cells are one cell.
    """
    given = value
    if isinstance(value, str):
        try:
            given = real(value)  # YAML reads 1e-3 as a word.
        except ValueError:
            if name == "start" or name.startswith("barrier."):
                return value
    if not isinstance(given, int | float) or isinstance(given, bool):
        raise ConfigurationError(
            f"{what}: {name} = {shortened(json.dumps(value, default=str))}; give a number"
        )
    if not abs(given) <= sys.float_info.max:
        raise ConfigurationError(f"{what}: {name} = {shortened(value)}; give a finite number")
    # 0.0 in place of -0.0, its equal.
    return given if name.startswith("barrier.") else float(given) + 0.0
