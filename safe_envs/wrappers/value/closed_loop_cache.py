"""Tables of closed loops that were computed once, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import logging
import weakref
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from safe_envs.errors import ConfigurationError, shown
from safe_envs.file_locks import locked
from safe_envs.package_version import package_version
from safe_envs.user_cache import cache_folder, make_room, mark_used
from safe_envs.wrappers.value.closed_loop import ClosedLoop, ClosedLoopTable
from safe_envs.wrappers.value.closed_loop_files import (
    FORMAT,
    load_closed_loop,
    save_closed_loop,
)
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.table_files import ValueFileError

FOLDER = "closed-loops"
"""Name of their folder in the user's cache."""

_LOG = logging.getLogger("safe_envs")

_IN_USE: weakref.WeakValueDictionary[str, ClosedLoopTable] = weakref.WeakValueDictionary()
"""Tables of this process, by their keys."""


def closed_loop_for(
    loop: ClosedLoop, progress: Callable[[float], None] | None = None
) -> ClosedLoopTable:
    """Return the table of a closed loop: one that is kept, or else a new one, which is then kept.

    Two processes do not compute the same: the second one waits. An interrupted computation leaves
    nothing behind.

    Args:
        loop: the closed loop.
        progress: called with the part of the work that is done.

    Raises:
        ConfigurationError: No table of it takes minutes and fits into memory.
    """
    grid = loop.grid()
    key = _key(loop, grid)
    folder = cache_folder(FOLDER)
    place = None if folder is None else folder / f"{key}.npz"
    table = _kept(loop, grid, key, place)
    if table is not None:
        return table
    with ExitStack() as stack:
        if place is not None:
            with suppress(ConfigurationError):  # The disk may be full.
                stack.enter_context(locked(place.with_suffix(".lock"), "", lambda: _tell(loop)))
            table = _kept(loop, grid, key, place)
        if table is None:
            table = loop.table(grid, progress=progress)
            if place is not None:
                _keep(table, loop, place)
    _IN_USE[key] = table
    return table


def _key(loop: ClosedLoop, grid: Grid) -> str:
    """Return the name of a table; another version of the package may compute another one."""
    described = [FORMAT, package_version(), loop.fingerprint(), list(grid.shape)]
    return hashlib.sha256(json.dumps(described).encode()).hexdigest()


def _kept(loop: ClosedLoop, grid: Grid, key: str, place: Path | None) -> ClosedLoopTable | None:
    """Return a table of memory or of a file, marked as used; None where there is none."""
    table = _IN_USE.get(key)
    if table is not None or place is None or not place.is_file():
        return table
    try:
        table = load_closed_loop(place, loop, grid)
    except ValueFileError as error:
        _LOG.warning("%s; it is computed again where it is asked for", error)
        return None
    mark_used(place)
    _IN_USE[key] = table
    return table


def _keep(table: ClosedLoopTable, loop: ClosedLoop, place: Path) -> None:
    try:
        save_closed_loop(table, loop, place)
    except ConfigurationError as error:
        _LOG.warning("the table is not kept: %s", error)
    make_room()


def _tell(loop: ClosedLoop) -> None:
    name = shown(loop.problem.name)
    _LOG.warning("another process computes the closed loop of %s: it is waited for", name)
