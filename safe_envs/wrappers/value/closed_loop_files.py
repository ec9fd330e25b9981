"""Tables of closed loops as files: what bounds of starts need, in an npz under a checksum."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.array_files import checksum, reading, write_arrays
from safe_envs.wrappers.value.closed_loop import ClosedLoop, ClosedLoopTable
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.table_files import ValueFileError

FORMAT = 1
"""To be raised whenever the same closed loop gets another table."""

WRITER = "safe-envs evaluate --closed-loop"

_KIND = "closed loop"
_LOWER = "lower"
_MOST_BYTES = 200_000_000
_MOST_PARTS = 1000


def save_closed_loop(table: ClosedLoopTable, loop: ClosedLoop, path: Path) -> None:
    """Write the first instants of a table into a file, whole or not at all.

    Args:
        table: of the closed loop.
        loop: the closed loop.
        path: of the file.

    Raises:
        ConfigurationError: It cannot be written there, or is too large to be read.
    """
    arrays = _edges(table.grid) | {_LOWER: table.lower[:2].astype("<f4", copy=False)}
    header = {
        "format": FORMAT,
        "kind": _KIND,
        "problem": loop.problem.name,
        "fingerprint": loop.fingerprint(),
        "parts": int(table.parts),
        "seconds": float(table.seconds),
    }
    header["sha256"] = checksum(header, arrays)
    write_arrays(path, header, arrays, _MOST_BYTES // 2)


def load_closed_loop(path: Path, loop: ClosedLoop, grid: Grid) -> ClosedLoopTable:
    """Read the first instants of a table.

    Args:
        path: of the file.
        loop: whose table it has to hold.
        grid: on which it has to be, edge by edge.

    Raises:
        ValueFileError: The file is missing, no such file, altered, or of another closed loop.
    """
    with reading(path, WRITER, ValueFileError, _MOST_BYTES) as file:
        header = dict(file.header)
        arrays = file.arrays()
        return _table(header, arrays, loop, grid)


def _table(
    header: dict[str, Any], arrays: dict[str, np.ndarray], loop: ClosedLoop, grid: Grid
) -> ClosedLoopTable:
    """Return what was read as a table; raise one of the errors of damaged files otherwise."""
    if (header["kind"], header["format"]) != (_KIND, FORMAT):
        raise ValueError("it holds something else")
    if header.pop("sha256") != checksum(header, arrays):
        raise ValueError("its content does not match its checksum")
    if header["fingerprint"] != loop.fingerprint():
        raise ValueError("it is of another closed loop")
    lower, parts, seconds = arrays.pop(_LOWER), header["parts"], float(header["seconds"])
    expected = _edges(grid)
    if arrays.keys() != expected.keys() or any(
        not np.array_equal(arrays[name], edges) for name, edges in expected.items()
    ):
        raise ValueError("it is on another grid")
    if type(parts) is not int or not 1 <= parts <= _MOST_PARTS:
        raise ValueError("its number of parts is none")
    if lower.dtype != np.float32 or lower.shape != (2, grid.cells):
        raise ValueError("its envelope is none of this grid")
    # NaN is not <= 1.
    if not (lower.min() >= 0 and lower.max() <= 1):
        raise ValueError("its values are not between 0 and 1")
    return ClosedLoopTable(grid, lower, loop.chain(grid), loop.executed, parts, seconds)


def _edges(grid: Grid) -> dict[str, np.ndarray]:
    return {f"edges_{i}": axis.edges.astype("<f8") for i, axis in enumerate(grid.axes)}
