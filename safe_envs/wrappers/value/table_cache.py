"""Tables of the value that were computed once, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from safe_envs.atomic_io import require_writable
from safe_envs.errors import ConfigurationError, shown
from safe_envs.file_locks import locked
from safe_envs.package_version import package_version
from safe_envs.problem.problem import SafetyProblem
from safe_envs.user_cache import cache_folder
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

MOST_BYTES_KEPT = 8_000_000_000

_LOG = logging.getLogger("safe_envs")
_DIGITS = 64
_DAY = 86_400.0


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
    fingerprint = reduced(
        problem, settings.knowledge, settings.intervals, settings.specification
    ).fingerprint
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


def table_at_hand(problem: SafetyProblem, settings: ValueSettings) -> ValueTable | None:
    """Return the table of a problem if it is kept; nothing is computed.

    Args:
        problem: whose values are asked for.
        settings: what is asked for.

    Raises:
        ConfigurationError: No grid takes the problem.
    """
    folder = cache_folder(FOLDER)
    # The fingerprint takes some time, and most users have no table at all.
    if folder is None or next(folder.glob("[0-9a-f]" * _DIGITS + ".npz"), None) is None:
        return None
    fingerprint = reduced(
        problem, settings.knowledge, settings.intervals, settings.specification
    ).fingerprint
    return _kept(folder / f"{_key(fingerprint, settings)}.npz", fingerprint, settings)


def forget_old_tables(folder: Path, most: int = MOST_BYTES_KEPT) -> None:
    """Remove the tables that were not used for longest, and what killed processes have left.

    The table that was used last remains, whatever its size, and all files of other names.

    Args:
        folder: of the tables.
        most: bytes that may remain.
    """
    used = {}
    for place in folder.glob("[0-9a-f]" * _DIGITS + ".npz"):
        with suppress(OSError):  # Another process may have removed it.
            state = place.stat()
            used[place] = (state.st_mtime, state.st_size)
    total = 0
    for i, (place, (_, size)) in enumerate(sorted(used.items(), key=lambda each: -each[1][0])):
        total += size
        if i and total > most:
            with suppress(OSError):
                place.unlink()
    for part in folder.glob(f".{'[0-9a-f]' * 8}*.npz"):
        with suppress(OSError):
            if part.stat().st_mtime < time.time() - _DAY:
                part.unlink()


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


def _key(fingerprint: str, settings: ValueSettings) -> str:
    """Return the name of a table; another version of the package may compute another one."""
    described = [FORMAT, package_version(), fingerprint, settings.as_dict()]
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:_DIGITS]


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
    with suppress(OSError):
        os.utime(place)
    return table


def _keep(table: ValueTable, place: Path) -> None:
    try:
        save_table(table, place)
    except ConfigurationError as error:
        _LOG.warning("the table is not kept: %s", error)
    forget_old_tables(place.parent)


def _tell(problem: SafetyProblem) -> None:
    _LOG.warning("another process computes the values of %s: it is waited for", shown(problem.name))
