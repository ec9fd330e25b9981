"""A sweep: the cells that a file with settings and lists of their values describes."""

from __future__ import annotations

import ast
import importlib.util
import io
import itertools
import json
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from safe_envs.agents.evaluation.attainable import best_document
from safe_envs.agents.evaluation.evaluate import run_evaluation
from safe_envs.agents.evaluation.resolve import views_of
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec, RunSettings
from safe_envs.agents.jobs.store import (
    file_checksum,
    json_checksum,
    package_versions,
    source_checksum,
)
from safe_envs.agents.policies.names import absolute_policy, policy_files, policy_module
from safe_envs.engine.choice import require_engine
from safe_envs.errors import (
    ConfigurationError,
    SafeEnvsError,
    nearest,
    require_whole,
    shortened,
    shown,
)
from safe_envs.files import MOST_BYTES_OF_TEXT, read_bytes
from safe_envs.filters.conditions.names import AT_STATE
from safe_envs.filters.conditions.registry import LEARNED
from safe_envs.filters.conditions.syntax import (
    files_of,
    modules_of,
    name_by_itself,
    with_absolute_paths,
)
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.measurement import items_of
from safe_envs.problem.options import OPTION_NAMES, PARAMETER_GROUPS, WHOLE_OPTIONS
from safe_envs.registry import full_id, which_env
from safe_envs.text import real, whole_or_real

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
    """Return a finite number, or a word where an env takes one."""
    # All but those of a barrier, which may be counts, are floats, so that equal cells are one cell.
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


_MOST_BYTES = 65_000
"""Of a file: what this Python reads of YAML in a second."""

_DEEPEST = 10
_PLAIN = re.compile(r"[-+]?(0|[1-9][0-9]*)|[-+]?[0-9]*\.[0-9]*([eE][-+]?[0-9]+)?", re.ASCII)
_DATE = "tag:yaml.org,2002:timestamp"


class _Loader(yaml.SafeLoader):
    """A loader without aliases and tags: nested aliases stand for more than memory holds."""

    # No setting takes a date, and some texts look like one.
    yaml_implicit_resolvers: ClassVar[Any] = {
        first: [(tag, form) for tag, form in found if tag != _DATE]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node; refuse aliases, tags, and what is nested deeper than any sweep."""
        event: Any = self.peek_event()
        what = (
            "an alias"
            if isinstance(event, yaml.AliasEvent)
            else "a tag"
            if event.tag is not None
            else ""
        )
        if what or self.depth > _DEEPEST:
            problem = (
                f"{what} is not allowed; write the value itself"
                if what
                else f"it is nested more than {_DEEPEST} deep"
            )
            raise ComposerError(None, None, problem, event.start_mark)
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; refuse a name that is given twice, and one that is no word."""
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConstructorError(
                    None, None, "a name is a list or a mapping; give a word", key.start_mark
                )
            if key.value in seen:
                raise ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: Any) -> int | float:
        """Construct a decimal number; refuse 010 (8 in YAML), 1:30 (90) and 1_000."""
        if not _PLAIN.fullmatch(node.value):
            raise ConstructorError(None, None, f"{node.value} is no plain number", node.start_mark)
        return whole_or_real(node.value)


for kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _Loader.construct_number)


def document_in(path: Path) -> Any:
    """Return the content of a YAML file.

    Raises:
        ConfigurationError: it cannot be read, is no YAML, or holds a name twice or a number in a
            misleading form.
    """
    try:
        return value_of(read_bytes(path, _MOST_BYTES).decode(), str(path))
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: {error.strerror}; name a YAML file that says what"
            " to sweep"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"{path} is no YAML that says what to sweep: {shortened(error, 400)}"
        ) from error


def value_of(text: str, name: str) -> Any:
    """Return the value of a text in YAML.

    Args:
        text: in YAML.
        name: where it comes from, for the message.

    Raises:
        YAMLError: it is no YAML, or holds a name twice or a number in a misleading form.
    """
    if len(text) > _MOST_BYTES:
        raise yaml.YAMLError(f"it has {len(text)} characters, more than {_MOST_BYTES}")
    loader = _Loader(io.StringIO(text))
    loader.name = name
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


@dataclass(frozen=True)
class Cell:
    """One evaluation of a sweep; a `safe_envs.agents.jobs.job.Job`.

    Attributes:
        settings: value of every setting that is not the env's default, by name; paths are absolute.
        files: SHA-256 of each file that it reads, by path.
        versions: versions by which it is to be computed; see `versions`.
        trust: load a policy's .zip, which runs code that it contains.
        engine: what simulates; see `RunSettings`. It is no part of the configuration: results of
            the engines differ by rounding.
    """

    settings: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False
    engine: str = "auto"

    @property
    def configuration(self) -> dict[str, Any]:
        """Everything that the result depends on."""
        parts = {"settings": self.settings, "files": self.files, "versions": self.versions}
        return {name: dict(part) for name, part in parts.items()}

    @property
    def key(self) -> str:
        """Checksum of the configuration, 32 hexadecimal digits."""
        return json_checksum(list(self.configuration.values()))[:32]

    @property
    def env_id(self) -> str:
        """Id of the env that it simulates, or under which custom systems are registered.

        Raises:
            ConfigurationError: there is no such id, or neither or both of env and system are given.
        """
        return which_env(self.settings.get("env"), self.settings.get("system"))

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `gym.make`."""
        options = {name: self.settings[name] for name in ENV_OPTIONS if name in self.settings}
        for name, value in self.settings.items():
            group, dot, parameter = name.partition(".")
            if dot and group in PARAMETER_GROUPS:
                options.setdefault(group, {})[parameter] = value
        return options

    @property
    def spec(self) -> EvaluationSpec:
        """What to evaluate.

        Raises:
            ConfigurationError: a value is out of range.
        """
        return EvaluationSpec(
            self.env_id,
            filters=(self.settings["filter"],),
            options=self.options,
            trust=self.trust,
            **{name: self.settings[name] for name in EVALUATION_DEFAULTS},
        )

    def compute(self) -> dict[str, Any]:
        """Return the "row", "config" and "best" of the evaluation, in any process of this project.

        Raises:
            ConfigurationError: this process has other versions or other files than the one that
                wrote the cell.
            SafeEnvsError: the evaluation fails.
        """
        self._require_same_code()
        found = run_evaluation(self.spec, RunSettings(engine=self.engine))
        best = best_document(found.best, found.rows)
        return {"row": found.rows[0].as_dict(), "config": found.config, "best": best}

    def _require_same_code(self) -> None:
        here = versions()
        differing = [
            f"{name} {here.get(name, 'missing')} in place of {value}"
            for name, value in self.versions.items()
            if here.get(name) != value
        ]
        if differing:
            raise ConfigurationError(
                f"the worker has {', '.join(differing)}; install the same versions on all machines"
            )
        for path, digest in self.files.items():
            if file_checksum(Path(path)) != digest:
                raise ConfigurationError(
                    f"the worker finds another content in {path}; put all files of a sweep on a"
                    " disk that workers share"
                )


@dataclass(frozen=True)
class Sweep:
    """Cells, in the order of their file.

    Attributes:
        cells: each once.
        swept: names of the settings that are not the same in all of them.
    """

    cells: tuple[Cell, ...]
    swept: tuple[str, ...]


@cache
def versions() -> dict[str, str]:
    """Return the versions on which cells depend, with a checksum of this project's own code."""
    return {**package_versions(), "source": source_checksum(scripts=False)[:16]}


def absolute(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a cell with paths that mean the same in every process."""
    text = settings["filter"]
    at = AT_STATE if text.endswith(AT_STATE) else ""
    found = {**settings, "filter": with_absolute_paths(text.removesuffix(AT_STATE)) + at}
    found["policy"] = absolute_policy(settings["policy"])
    if "system" in settings:
        file, _, name = settings["system"].rpartition(":")
        found["system"] = f"{os.path.realpath(file)}:{name}"
    return found


def read_by(settings: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the files that a cell reads, without those that they import: see `with_imported`.

    A policy that does not exist is an unknown name, which `make_policy` reports.
    """
    if "system" in settings:
        yield Path(settings["system"].rpartition(":")[0])
    yield from files_of(settings["filter"].removesuffix(AT_STATE))
    yield from filter(os.path.exists, policy_files(settings["policy"]))


def installed(settings: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the Python files of the packages whose conditions and policy a cell uses.

    All files of a package count, but not what it imports from others. Nothing is run.
    """
    named = modules_of(settings["filter"].removesuffix(AT_STATE))
    modules = (*named, policy_module(settings["policy"]))
    for top in dict.fromkeys(module.split(".")[0] for module in modules if module):
        try:
            spec = importlib.util.find_spec(top)
        except ValueError:  # of a script that runs, which has none
            continue
        if spec is None or top == "safe_envs":  # the versions of a cell hold its own code
            continue
        folders = spec.submodule_search_locations
        if folders is not None:
            yield from (path for folder in folders for path in sorted(Path(folder).rglob("*.py")))
        elif spec.origin is not None and spec.origin.endswith(".py"):
            yield Path(spec.origin)


def with_imported(path: Path) -> list[Path]:
    """Return a file, and if it is Python the files of its folder that it imports, or that these do.

    Nothing is run: every import statement counts, wherever in a file it is. Imports from another
    folder, or by a name that is computed at run time, are not found.
    """
    found: dict[Path, None] = {}
    left = [path]
    while left:
        file = left.pop()
        if file not in found:
            found[file] = None
            left += [
                each
                for folder, names in _imports(file, path.parent)
                for each in _files_of(folder, names)
            ]
    return list(found)


def _imports(file: Path, root: Path) -> Iterable[tuple[Path, Sequence[str]]]:
    """Yield the imports of a file: the folder in which each begins, and the names below it."""
    if file.suffix != ".py":
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(read_bytes(file, MOST_BYTES_OF_TEXT))
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return  # whoever runs it reports what is wrong
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((root, each.name.split(".")) for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            folder = file.parents[node.level - 1] if node.level else root
            # What is imported from a package may be a module of it.
            yield from (
                (folder, [*(node.module or "").split("."), each.name]) for each in node.names
            )


def _files_of(folder: Path, names: Sequence[str]) -> Iterable[Path]:
    """Yield the existing modules and packages of a dotted name."""
    for name in filter(None, names):
        yield from (
            path
            for path in (folder / f"{name}.py", folder / name / "__init__.py")
            if path.is_file()
        )
        folder /= name


_NO_PART = ("seed", "episodes", "bounds")
"""Settings that need no check other than that of their kind."""

_TOGETHER = {"filter": ("env", "system", "knowledge", "objective"), "policy": ("env", "system")}
"""Settings with which another one has to be compatible."""

_MOST_CELLS = 50_000
"""All of them are compared, in a second, before the first is computed."""


def read_sweep(path: Path, trust: bool = False, engine: str = "auto") -> Sweep:
    """Read a sweep from a YAML file, and check all that can be checked before a cell is computed.

    The file has the sections `fixed` (setting: value), `grid` (setting: list of values; lists
    multiply) and `cells` (a list of setting: value). Settings are the arguments of an evaluation:
    see `docs/guides/sweep.md`.

    Args:
        path: of the file. Paths in it begin at the working directory.
        trust: load a policy's .zip, which runs code that it contains.
        engine: what simulates; see `RunSettings`.

    Raises:
        ConfigurationError: the file cannot be read, or an engine, section, setting, id, filter,
            policy or value is not allowed.
        RelativeDegreeError: a filter does not suit a barrier.
    """
    require_engine(engine)
    sweep = sweep_of(document_in(path), trust, engine, what=str(path))
    _check(sweep, str(path))
    return sweep


def sweep_of(
    document: Any, trust: bool = False, engine: str = "auto", what: str = "the sweep"
) -> Sweep:
    """Return the sweep of a file's content, with names and kinds of values checked.

    Args:
        document: mapping from the file's sections.
        trust: see `read_sweep`.
        engine: see `read_sweep`.
        what: name of the sweep in errors.

    Raises:
        ConfigurationError: a section or a setting is not allowed.
    """
    fixed, grid, given = sections(document, what)
    for name in (*grid, *itertools.chain.from_iterable(given)):
        if name in fixed:
            raise ConfigurationError(
                f"{what}: {name} is fixed, and has other values too; give it once"
            )
    count = 1
    for values in grid.values():
        count *= len(values)
    if count > _MOST_CELLS:
        raise ConfigurationError(f"{what}: the grid has {count} cells; the most are {_MOST_CELLS}")
    chosen = (
        [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
        if grid
        else []
    )
    chosen += given
    if not chosen:
        chosen = [{}]
    once = {
        _equal(settings): settings
        for settings in (complete({**fixed, **each}, what) for each in chosen)
    }
    cells = {cell.key: cell for cell in _cells(once.values(), trust, engine)}
    return Sweep(tuple(cells.values()), tuple(_swept([cell.settings for cell in cells.values()])))


def describe(cell: Cell, names: Iterable[str]) -> str:
    """Return a cell in a few words: its settings of these names.

    Args:
        cell: to describe.
        names: of the settings.
    """
    return ", ".join(
        f"{name} = {text_of(cell.settings[name])}" for name in names if name in cell.settings
    )


def _equal(settings: Settings) -> str:
    """Return a text that is the same for settings that differ only in 1 and 1.0 of a barrier."""

    def one_form(value: Any) -> Any:
        return json.loads(json.dumps(value), parse_int=float)

    return json.dumps(
        {
            name: one_form(value) if name.startswith("barrier.") else value
            for name, value in settings.items()
        }
    )


def _cells(found: Iterable[Settings], trust: bool, engine: str) -> Iterable[Cell]:
    digests: dict[Path, dict[str, str]] = {}
    checksums: dict[Path, str] = {}
    for given in found:
        settings, files = absolute(given), {}
        for path in read_by(settings):
            if path not in digests:
                digests[path] = {str(each): file_checksum(each) for each in with_imported(path)}
            files |= digests[path]
        for path in installed(settings):
            if path not in checksums:
                checksums[path] = file_checksum(path)
            files[str(path)] = checksums[path]
        yield Cell(settings, files, versions(), trust, engine)


def _swept(settings: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    names = dict.fromkeys(name for each in settings for name in each)
    return (name for name in names if len({json.dumps(each.get(name)) for each in settings}) > 1)


def _check(sweep: Sweep, what: str) -> None:
    """Make the problem, filter and policy of each cell with a value, or a pair, that is new."""
    # The others would repeat it, and the problem of a large system takes a second.
    seen: set[str] = set()
    for cell in sweep.cells:
        together = {
            name: [cell.settings.get(other) for other in others]
            for name, others in _TOGETHER.items()
        }
        parts = {
            name: json.dumps([name, value, together.get(name)])
            for name, value in cell.settings.items()
            if name not in _NO_PART
        }
        new = {name for name, part in parts.items() if part not in seen}
        if not new:
            continue
        seen |= set(parts.values())
        try:
            _check_cell(cell, "filter" in new)
        except SafeEnvsError as error:
            where = describe(cell, sweep.swept)
            raise type(error)(f"{what}{', cell ' * bool(where)}{where}: {error}") from error


def _check_cell(cell: Cell, derive: bool) -> None:
    ((_, name, found),) = views_of(cell.spec)
    needs_learning = any(part.split(":")[0] in LEARNED for part in name.split("+"))
    if derive and name != UNFILTERED and not (needs_learning or name_by_itself(name)):
        spec = cell.spec
        SafetyFilter.for_problem(
            found.problem, name, spec.knowledge, spec.objective, estimator=found.estimator
        )
