"""Results of a sweep on disk: a Parquet file for each cell, there whole or not at all, and the
table of all of them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safe_envs.agents.sweeps.cell import Cell, Outcome
from safe_envs.agents.sweeps.settings import text_of
from safe_envs.agents.sweeps.spec import Sweep
from safe_envs.atomic_io import write_atomically, write_json
from safe_envs.bounded_reading import MOST_BYTES_OF_TEXT, open_regular, read_bytes
from safe_envs.errors import ConfigurationError, shortened

if TYPE_CHECKING:
    import pyarrow as pa

INDEX = "sweep.json"
"""Name of the file with the order of the cells and the names of the swept settings."""

_CELLS = "cells"
_STALE = 3600.0
"""Age in seconds at which a temporary file is left over: to write one takes no second."""

_COUNTS = ("safe", "violations")
_STATISTICS = (
    "safety_rate",
    "ci_low",
    "ci_high",
    "min_h_median",
    "min_h_p05",
    "intervention_rate",
    "infeasible_rate",
    "effort_mean",
    "return_mean",
    "estimated_bound",
)
_DOCUMENTS = ("settings", "files", "versions", "config", "row")


class Store:
    """The folder of a sweep.

    Args:
        folder: made if it is not there.
        sweep: whose cells are kept in it. Those of another sweep in the same folder stay, and are
            read until one of this is there.

    Attributes:
        hidden: number of cells of another sweep, such as one with another grid or another version
            of the code.

    Raises:
        ConfigurationError: the folder cannot be made or written, or pyarrow is not installed.
    """

    def __init__(self, folder: Path, sweep: Sweep) -> None:
        _require_pyarrow()
        self._folder, self._cells = folder, {cell.key: cell for cell in sweep.cells}
        try:
            (folder / _CELLS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{folder} cannot be made: {error.strerror}; give another folder"
            ) from error
        _remove_stale(folder)
        there = {key for key in self._cells if _file_of(folder, key).is_file()}
        self._finished = {key for key in there if _is_finished(_file_of(folder, key))}
        self._failed = there - self._finished
        self._index = {"cells": list(self._cells), "swept": list(sweep.swept)}
        # The results of another sweep, as of another version of the code, can be read until there
        # is one of this.
        before = _keys_before(folder)
        self.hidden = sum(
            _file_of(folder, key).is_file() for key in before if key not in self._cells
        )
        self._is_indexed = bool(there) or not before
        if self._is_indexed:
            self._write_index()

    @property
    def missing(self) -> list[Cell]:
        """Cells that are not there yet, and after them those that failed."""
        missing = [cell for key, cell in self._cells.items() if key not in self._finished]
        return sorted(missing, key=lambda cell: cell.key in self._failed)

    def keep(self, outcome: Outcome) -> None:
        """Write an outcome, unless it failed and another run has the result.

        Raises:
            ConfigurationError: it cannot be written, as on a full disk.
        """
        path = _file_of(self._folder, outcome.key)
        if not self._is_indexed:
            self._write_index()
        if outcome.error is None or not _is_finished(path):
            self._write(
                lambda: write_atomically(
                    path, lambda part: _write_table(part, self._cells[outcome.key], outcome)
                )
            )
            (self._finished if outcome.error is None else self._failed).add(outcome.key)
        else:
            self._finished.add(outcome.key)

    def _write_index(self) -> None:
        path = self._folder / INDEX
        self._write(lambda: write_json(path, self._index))
        self._is_indexed = True

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except ConfigurationError as error:
            raise ConfigurationError(
                f"{error}. {len(self._finished)} of {len(self._cells)} cells are finished and kept"
                f" in {self._folder}; start again then, and only the others are computed"
            ) from error


def read(folder: Path | str) -> pa.Table:
    """The cells of a sweep that are there, in the order of its file.

    Columns: `key`; each setting that is swept or that some cell has, null where another one leaves
        it to the env; counts and
    statistics as in the rows of `safe_envs.agents.evaluation.evaluate.evaluate`; `error`, null for
    cells that did not fail; `seconds`, the only one that depends on the machine; and as JSON the
    whole row, its configuration, the versions and the checksums of files.

    Raises:
        ConfigurationError: the folder holds no sweep, a file in it cannot be read, or pyarrow is
            not installed.
    """
    _require_pyarrow()
    import pyarrow as pa

    folder = Path(folder)
    index = read_index(folder)
    paths = [path for key in index["cells"] if os.path.isfile(path := _file_of(folder, key))]
    if not paths:
        return _schema().empty_table()
    try:
        kept = pa.concat_tables([_table_in(path) for path in paths])
        settings = [dict(json.loads(text)) for text in kept["settings"].to_pylist()]
    except (OSError, pa.ArrowException, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ConfigurationError(
            f"a file in {folder / _CELLS} cannot be read ({shortened(error)}); remove it and start"
            " the sweep again"
        ) from error
    # A swept setting may be one of cells only that are not there yet.
    names = dict.fromkeys([*(name for each in settings for name in each), *index["swept"]])
    columns = {
        "key": kept["key"],
        **{name: _column([each.get(name) for each in settings]) for name in names},
    }
    return pa.table(
        columns
        | {name: kept[name] for name in kept.column_names if name not in ("key", "settings")}
    )


def read_index(folder: Path) -> dict[str, Any]:
    """Keys of all cells of a sweep in their order, under "cells", and names of the swept settings,
    under "swept".

    Raises:
        ConfigurationError: the folder holds no sweep.
    """
    try:
        index = json.loads(read_bytes(folder / INDEX, MOST_BYTES_OF_TEXT))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"{shortened(folder)} holds no sweep: it has no {INDEX}; give the folder of `safe-envs"
            " sweep ... --out`"
        ) from error
    texts = [index.get(name) if isinstance(index, dict) else None for name in ("cells", "swept")]
    if not all(
        isinstance(each, list) and all(isinstance(text, str) for text in each) for each in texts
    ):
        raise ConfigurationError(
            f"{folder / INDEX} is not as `safe-envs sweep` writes it; run the sweep again, which"
            " writes it anew"
        )
    return index


def _keys_before(folder: Path) -> list[str]:
    try:
        return read_index(folder)["cells"]
    except ConfigurationError:
        return []


def _remove_stale(folder: Path) -> None:
    """Remove what was being written when a run was killed: nothing that is young, which another run
    may be writing."""
    for path in (*folder.glob(f".{Path(INDEX).stem}.*"), *(folder / _CELLS).glob(".*.parquet")):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _STALE:
                path.unlink()


def _require_pyarrow() -> None:
    if find_spec("pyarrow") is None:
        raise ConfigurationError(
            'pyarrow is not installed; install it with pip install "safe-envs[sweep]"'
        )


def _file_of(folder: Path, key: str) -> Path:
    return folder / _CELLS / f"{key}.parquet"


def _is_finished(path: Path) -> bool:
    import pyarrow as pa

    try:
        return _table_in(path)["error"][0].as_py() is None
    except (OSError, pa.ArrowException, ValueError):
        return False


def _table_in(path: Path) -> pa.Table:
    """The row that the file of a cell holds.

    Raises:
        OSError, ArrowException, ValueError: it cannot be read, or is not as `_write_table` writes
            it.
    """
    import pyarrow.parquet as pq

    with open_regular(path, MOST_BYTES_OF_TEXT) as stream:
        file = pq.ParquetFile(stream)
        told = file.metadata
        parts = [
            told.row_group(i).column(j)
            for i in range(told.num_row_groups)
            for j in range(told.num_columns)
        ]
        # A few bytes under another compression, or in many rows, stand for more than the memory
        # holds.
        if told.num_rows != 1 or not {part.compression for part in parts} <= {
            "SNAPPY",
            "UNCOMPRESSED",
        }:
            raise ValueError("it is no cell of a sweep")
        table = file.read()
    if table.schema != _schema():
        raise ValueError("its columns are not those of a cell of a sweep")
    return table


def _schema() -> pa.Schema:
    import pyarrow as pa

    kinds = [
        ("key", pa.string()),
        *((name, pa.int64()) for name in _COUNTS),
        *((name, pa.float64()) for name in _STATISTICS),
    ]
    kinds += [
        ("error", pa.string()),
        ("seconds", pa.float64()),
        *((name, pa.string()) for name in _DOCUMENTS),
    ]
    return pa.schema(kinds)


def _write_table(path: Path, cell: Cell, outcome: Outcome) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    row: Mapping[str, Any] = outcome.row or {}
    documents = {
        "settings": cell.settings,
        "files": cell.files,
        "versions": cell.versions,
        "config": outcome.config,
        "row": outcome.row,
    }
    columns = {"key": outcome.key, "error": outcome.error, "seconds": outcome.seconds}
    columns |= {name: row.get(name) for name in (*_COUNTS, *_STATISTICS)}
    columns |= {
        name: None if document is None else json.dumps(document)
        for name, document in documents.items()
    }
    table = pa.Table.from_pylist([columns], schema=_schema())
    with path.open("wb") as file:
        pq.write_table(table, file)
        # A disk may say only now that it is full.
        file.flush()
        os.fsync(file.fileno())


def _column(values: Sequence[Any]) -> pa.Array:
    """The values of a setting: numbers, truth values or texts as they are, and all others as JSON."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds <= {int, float}:
        return pa.array(values, pa.int64() if kinds == {int} else pa.float64())
    if kinds in ({bool}, {str}):
        return pa.array(values)
    return pa.array([None if value is None else text_of(value) for value in values], pa.string())
