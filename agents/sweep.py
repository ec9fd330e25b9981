"""What a sweep is: from a file that names settings and their values to cells, each of which is one evaluation."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation import BARE
from agents.policy import make_policy, policy_files
from agents.problems import load_problem
from agents.sweep_cell import ENV_OPTIONS, PARAMETERS, Cell, checksum, versions
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, require_whole
from wrappers import require_readable

_SECTIONS = ("fixed", "grid", "cells")
_DEFAULTS: dict[str, Any] = {
    "policy": "nominal",
    "knowledge": "model",
    "objective": "nearest",
    "seed": 0,
    "episodes": 1000,
    "bounds": False,
}
_NAMES = ("env", "filter", *ENV_OPTIONS, *_DEFAULTS)
_WORDS = ("env", "system", "filter", "policy", "knowledge", "objective")
_NO_PART = ("seed", "episodes", "bounds")
"""Settings that change neither the problem nor the filter nor the policy."""
_GROUPS = tuple(f"{group}.NAME" for group in PARAMETERS)
_FILE = re.compile("(?<=file=)[^:+]+")
_MOST_CELLS = 1_000_000

Settings = dict[str, Any]


@dataclass(frozen=True)
class Sweep:
    """Cells, in the order of their file.

    Attributes:
        cells: each once.
        swept: names of the settings that are not the same in all of them.
    """

    cells: tuple[Cell, ...]
    swept: tuple[str, ...]


def read_sweep(path: Path, trust: bool = False) -> Sweep:
    """Read a sweep from a YAML file, and check all that can be checked before a cell is computed.

    The file has the sections `fixed` (setting: value), `grid` (setting: list of values; lists multiply) and `cells` (a list of
    setting: value). Settings are the arguments of an evaluation: see `docs/guides/sweep.md`.

    Args:
        path: of the file. Paths in it begin at the working directory.
        trust: load a policy's .zip, which runs code that it contains.

    Raises:
        ConfigurationError: the file cannot be read, or a section, setting, id, filter, policy or value is not allowed.
        RelativeDegreeError: a filter does not suit a barrier.
    """
    sweep = sweep_of(_document(path), trust, what=str(path))
    _check(sweep)
    return sweep


def sweep_of(document: Any, trust: bool = False, what: str = "the sweep") -> Sweep:
    """A sweep from what its file holds, with names and kinds of values checked.

    Args:
        document: the file's mapping from sections.
        trust: see `read_sweep`.
        what: how errors call it.

    Raises:
        ConfigurationError: a section or a setting is not allowed.
    """
    sections = _mapping(document, what, _SECTIONS)
    fixed = _settings(sections.get("fixed"), f"{what}: fixed")
    grid = _grid(sections.get("grid"), f"{what}: grid")
    given = _listed(sections.get("cells"), f"{what}: cells")
    for name in (*grid, *itertools.chain.from_iterable(given)):
        if name in fixed:
            raise ConfigurationError(f"{what}: {name} is fixed, and has other values too; give it once")
    count = 1
    for values in grid.values():
        count *= len(values)
    if count > _MOST_CELLS:
        raise ConfigurationError(f"{what}: the grid has {count} cells; the most are {_MOST_CELLS}")
    chosen = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())] if grid else []
    chosen += given
    if not chosen:
        chosen = [{}]
    complete = [_complete({**fixed, **each}, what) for each in chosen]
    cells = {cell.key: cell for cell in _cells(complete, trust)}
    return Sweep(tuple(cells.values()), tuple(_swept([cell.settings for cell in cells.values()])))


def describe(cell: Cell, names: Iterable[str]) -> str:
    """A cell in a few words: the settings of these names."""
    return ", ".join(f"{name} = {text_of(cell.settings[name])}" for name in names if name in cell.settings)


def text_of(value: Any) -> str:
    """The value of a setting as text."""
    return value if isinstance(value, str) else json.dumps(value)


def _document(path: Path) -> Any:
    import yaml

    try:
        return yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}; name a YAML file that says what to sweep") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} is no YAML: {error}") from error


def _mapping(given: Any, what: str, allowed: Sequence[str] | None) -> dict[str, Any]:
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        form = "NAME: VALUE entries" if allowed is None else f"the sections {', '.join(allowed)}"
        raise ConfigurationError(f"{what} is {json.dumps(given, default=str)[:80]}; give {form}")
    for name in given:
        if allowed is not None and name not in allowed:
            raise ConfigurationError(f"{what} has the section {name!r}; {nearest(name, allowed)}")
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
            raise ConfigurationError(f"{what}: {name} = {text_of(values)}; give a list of values, or put it under fixed")
    return {name: [_value(name, value, what) for value in values] for name, values in lists.items()}


def _listed(given: Any, what: str) -> list[Settings]:
    if given is None:
        return []
    if not isinstance(given, list) or not given:
        raise ConfigurationError(f"{what} is {text_of(given)}; give a list, each entry with settings")
    return [_settings(each, f"{what}, entry {i}") for i, each in enumerate(given, 1)]


def _require_known(name: str, what: str) -> None:
    group, dot, parameter = name.partition(".")
    if not (name in _NAMES or (group in PARAMETERS and dot and parameter)):
        hint = f"; give its parameters as {name}.NAME" if name in PARAMETERS else f"; {nearest(name, (*_NAMES, *_GROUPS))}"
        raise ConfigurationError(f"{what} has the setting {name!r}{hint}")


def _value(name: str, value: Any, what: str) -> Any:
    """A value of the kind that its setting takes; YAML reads 1e-3 as a word."""
    if name in _WORDS:
        if not isinstance(value, str):
            raise ConfigurationError(f"{what}: {name} = {text_of(value)}; give a text")
        return value
    if name == "bounds":
        if not isinstance(value, bool):
            raise ConfigurationError(f"{what}: bounds = {text_of(value)}; give true or false")
        return value
    if name in ("seed", "episodes", "substeps"):
        require_whole(f"{what}: {name}", value, 0 if name == "seed" else 1)
        return value
    if isinstance(value, list):
        return [_value(name, entry, what) for entry in value]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            if name == "start" or name.startswith("barrier."):
                return value
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ConfigurationError(f"{what}: {name} = {json.dumps(value, default=str)}; give a number")
    return value


def _complete(settings: Settings, what: str) -> Settings:
    """The settings of a cell, in one order, with what is the same for every env where it was left open."""
    if ("env" in settings) == ("system" in settings):
        raise ConfigurationError(f"{what}: a cell needs env: ENV_ID or system: FILE.py:NAME, one of the two")
    if "filter" not in settings:
        raise ConfigurationError(f"{what}: a cell has no filter; name one, or {BARE} for the bare env")
    given = {**_DEFAULTS, **settings}
    return {name: given[name] for name in sorted(given, key=lambda name: (name not in _NAMES, _rank(name), name))}


def _rank(name: str) -> int:
    return _NAMES.index(name) if name in _NAMES else PARAMETERS.index(name.partition(".")[0])


def _cells(complete: Iterable[Settings], trust: bool) -> Iterable[Cell]:
    digests: dict[str, str] = {}
    for settings in complete:
        absolute = _absolute(settings)
        paths = [str(path) for path in _paths(absolute)]
        for path in paths:
            if path not in digests:
                digests[path] = checksum(Path(path))
        yield Cell(absolute, {path: digests[path] for path in paths}, versions(), trust)


def _absolute(settings: Settings) -> Settings:
    """The settings with paths that mean the same in every process."""
    found = {**settings, "filter": _FILE.sub(lambda match: str(Path(match.group()).resolve()), settings["filter"])}
    if policy_files(settings["policy"]) and Path(settings["policy"]).exists():
        found["policy"] = str(Path(settings["policy"]).resolve())
    file, colon, name = settings.get("system", "").rpartition(":")
    if colon and file.endswith(".py"):
        found["system"] = f"{Path(file).resolve()}:{name}"
    return found


def _paths(settings: Settings) -> Iterable[Path]:
    """The files that a cell reads. A policy that is not there is an unknown name, which `make_policy` says better."""
    file, _, _ = settings.get("system", "").rpartition(":")
    if file.endswith(".py"):
        yield Path(file)
    yield from (Path(match) for match in _FILE.findall(settings["filter"]))
    yield from (path for path in policy_files(settings["policy"]) if path.exists())


def _swept(settings: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    names = dict.fromkeys(name for each in settings for name in each)
    return (name for name in names if len({json.dumps(each.get(name)) for each in settings}) > 1)


def _check(sweep: Sweep) -> None:
    """Make the problem, the filter and the policy of every cell that has a value, or a pair with the env, that none before it had.

    Others would repeat it, and to make the problem of a large system takes a second.

    Raises:
        SafeEnvsError: one cannot be made; says of which cell.
    """
    seen: set[str] = set()
    for cell in sweep.cells:
        place = (cell.settings.get("env"), cell.settings.get("system"))
        looked_at = {name: value for name, value in cell.settings.items() if name not in _NO_PART}
        parts = {json.dumps([name, value, place if name in ("filter", "policy") else None]) for name, value in looked_at.items()}
        if parts <= seen:
            continue
        seen |= parts
        try:
            _check_cell(cell)
        except SafeEnvsError as error:
            raise type(error)(f"cell {describe(cell, sweep.swept) or 1}: {error}") from error


def _check_cell(cell: Cell) -> None:
    for name, allowed in (("knowledge", ("model", "plant")), ("objective", ("nearest", "clf"))):
        if cell.settings[name] not in allowed:
            raise ConfigurationError(f"{name} = {cell.settings[name]!r}; {nearest(cell.settings[name], allowed)}")
    problem = load_problem(cell.env_id, cell.options)
    if cell.settings["filter"] != BARE:
        require_readable(cell.settings["filter"], problem)
    make_policy(cell.settings["policy"], problem, cell.trust)
