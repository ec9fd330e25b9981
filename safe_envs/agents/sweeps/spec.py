"""A sweep: the cells that a file with settings and lists of their values describes."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.evaluation.views import views_of
from safe_envs.agents.jobs.fingerprint import file_checksum
from safe_envs.agents.sweeps.cell import Cell, Sweep, versions
from safe_envs.agents.sweeps.dependencies import absolute, installed, read_by, with_imported
from safe_envs.agents.sweeps.document import document_in
from safe_envs.agents.sweeps.settings import Settings, complete, sections, text_of
from safe_envs.compiled.engine import require_engine
from safe_envs.errors import ConfigurationError, SafeEnvsError
from safe_envs.wrappers import LEARNED, SafetyFilter
from safe_envs.wrappers.conditions.text_parts import name_by_itself

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
    """Make the problem, filter and policy of each cell with a value, or a pair, that is new.

    The others would repeat it, and the problem of a large system takes a second.

    Raises:
        SafeEnvsError: one cannot be made; the message names the cell.
    """
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
