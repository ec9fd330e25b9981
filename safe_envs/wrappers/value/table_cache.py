"""Tables of the value that were computed once, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from contextlib import ExitStack, suppress
from pathlib import Path

from safe_envs.atomic_io import require_writable
from safe_envs.errors import ConfigurationError, shown
from safe_envs.file_locks import locked
from safe_envs.package_version import package_version
from safe_envs.problem.problem import SafetyProblem
from safe_envs.user_cache import cache_folder, make_room, mark_used
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.solve import Progress, solve
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_files import (
    FORMAT,
    ValueFileError,
    load_table,
    require_asked,
    save_table,
)

FOLDER = "values"
"""Name of their folder in the user's cache."""

_LOG = logging.getLogger("safe_envs")


def table_for(
    problem: SafetyProblem,
    settings: ValueSettings | None = None,
    progress: Progress | None = None,
    file: Path | str | None = None,
) -> ValueTable:
    """Return the table of a problem: one that is kept, or else a new one, which is then kept.

    Two processes do not compute the same: the second one waits. An interrupted computation leaves
    nothing behind.

    Args:
        problem: whose values are asked for.
        settings: what is asked for.
        progress: called with the part of the work that is done.
        file: to read the table from; it is written if there is none.

    Raises:
        ConfigurationError: The file holds something else, or cannot be read or written; or see
            `solve`.
    """
    settings = settings or ValueSettings()
    if file is not None:
        return _of_file(Path(file), problem, settings, progress)
    folder = cache_folder(FOLDER)
    if folder is None:
        return solve(problem, settings, progress)
    fingerprint = _fingerprint(problem, settings)
    place = folder / f"{_key(fingerprint, settings)}.npz"
    table = _kept(place, fingerprint, settings)
    if table is not None:
        return table
    with ExitStack() as stack:
        with suppress(ConfigurationError):  # The disk may be full.
            stack.enter_context(locked(place.with_suffix(".lock"), "", lambda: _tell(problem)))
        table = _kept(place, fingerprint, settings)
        if table is None:
            table = solve(problem, settings, progress)
            _keep(table, place)
    return table


def table_key(problem: SafetyProblem, settings: ValueSettings) -> str:
    """Return 64 hexadecimal digits, which are the same for what has the same table.

    Args:
        problem: whose values are asked for.
        settings: what is asked for.

    Raises:
        ConfigurationError: No grid takes the problem.
    """
    return _key(_fingerprint(problem, settings), settings)


def _of_file(
    file: Path, problem: SafetyProblem, settings: ValueSettings, progress: Progress | None
) -> ValueTable:
    # os.path takes any text for a path, also one that is too long to be one.
    if os.path.lexists(file):
        table = load_table(file, problem)
        require_asked(file, table, settings)
        return table
    require_writable(file)
    table = table_for(problem, settings, progress)
    save_table(table, file)
    return table


def _fingerprint(problem: SafetyProblem, settings: ValueSettings) -> str:
    given = (settings.knowledge, settings.intervals, settings.specification)
    return reduced(problem, *given).fingerprint


def _key(fingerprint: str, settings: ValueSettings) -> str:
    """Return the name of a table; another version of the package may compute another one."""
    described = [FORMAT, package_version(), fingerprint, settings.as_dict()]
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def _kept(place: Path, fingerprint: str, settings: ValueSettings) -> ValueTable | None:
    """Return the table of a file, marked as used; None where there is none, or none to rely on."""
    if not place.is_file():
        return None
    try:
        table = load_table(place)
        require_asked(place, table, settings)
    except ValueFileError as error:
        _LOG.warning("%s; it is computed again", error)
        return None
    if table.fingerprint != fingerprint:
        return None
    mark_used(place)
    return table


def _keep(table: ValueTable, place: Path) -> None:
    try:
        save_table(table, place)
    except ConfigurationError as error:
        _LOG.warning("the table is not kept: %s", error)
    make_room()


def _tell(problem: SafetyProblem) -> None:
    _LOG.warning("another process computes the values of %s: it is waited for", shown(problem.name))
