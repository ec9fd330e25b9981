"""The results of a sweep on disk, and the table of all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safe_envs.agents.jobs.job import JobOutcome
from safe_envs.agents.jobs.store import ResultStore, reading, remove_stale
from safe_envs.agents.sweeps.spec import Cell, Sweep, text_of
from safe_envs.errors import ConfigurationError, install_extra, shortened
from safe_envs.files import MOST_BYTES_OF_TEXT, read_bytes, write_json

if TYPE_CHECKING:
    import pyarrow as pa

INDEX = "sweep.json"
"""Name of the file with the order of the cells and the names of the swept settings."""

_CELLS = "cells"
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
    "held_bound",
    "continuous_bound",
)
_WORDS = ("held_word", "continuous_word")
_BEST = ("lower", "upper")
_ADVICE = "remove it and start the sweep again"


class Store:
    """The folder of a sweep.

    Args:
        folder: created if it does not exist.
        sweep: whose cells are kept in it. Those of another sweep in the same folder remain, and are
            read until there is one of this sweep.

    Attributes:
        hidden: number of cells of another sweep, such as one with another grid or another version
            of the code.

    Raises:
        ConfigurationError: the folder cannot be created or written, or pyarrow is not installed.
    """

    def __init__(self, folder: Path, sweep: Sweep) -> None:
        _require_pyarrow()
        self._folder, self._cells = folder, {cell.key: cell for cell in sweep.cells}
        self._results = ResultStore(folder / _CELLS)
        self._results.remove_unfinished()
        remove_stale(folder, f".{Path(INDEX).stem}.*")
        there = {key for key in self._cells if self._results.path(key).is_file()}
        self._finished = {key for key in there if self._is_finished(key)}
        self._failed = there - self._finished
        self._index = {"cells": list(self._cells), "swept": list(sweep.swept)}
        # The results of another sweep, as of another version of the code, can be read until there
        # is one of this.
        before = _keys_before(folder)
        self.hidden = sum(
            self._results.path(key).is_file() for key in before if key not in self._cells
        )
        self._is_indexed = bool(there) or not before
        if self._is_indexed:
            write_json(folder / INDEX, self._index)

    @property
    def missing(self) -> list[Cell]:
        """Cells that are not computed yet, followed by those that failed."""
        missing = [cell for key, cell in self._cells.items() if key not in self._finished]
        return sorted(missing, key=lambda cell: cell.key in self._failed)

    def keep(self, outcome: JobOutcome) -> None:
        """Write an outcome, unless it failed and another run has the result.

        Raises:
            ConfigurationError: it cannot be written, as on a full disk.
        """
        key = outcome.key
        if outcome.error is not None and self._is_finished(key):
            self._finished.add(key)
            return
        result = outcome.result or {"row": None, "config": None, "best": None}
        content = {**result, "error": outcome.error, "seconds": outcome.seconds}
        try:
            if not self._is_indexed:
                write_json(self._folder / INDEX, self._index)
                self._is_indexed = True
            self._results.keep(key, self._cells[key].configuration, content)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"{error}. {len(self._finished)} of {len(self._cells)} cells are finished and kept"
                f" in {self._folder}; start again then, and only the others are computed"
            ) from error
        (self._finished if outcome.error is None else self._failed).add(key)

    def _is_finished(self, key: str) -> bool:
        try:
            found = self._results.read(key, self._cells[key].configuration)
            return found is not None and found["error"] is None and isinstance(found["row"], dict)
        except (ConfigurationError, KeyError):
            return False


def read(folder: Path | str) -> pa.Table:
    """Return the table of the cells of a sweep that are computed, in the order of its file.

    Columns: `key`; each setting that is swept or that some cell has, null where a cell leaves it to
    the env; counts and statistics as in the rows of
    `safe_envs.agents.evaluation.evaluate.evaluate`; `best_lower` and `best_upper`, the ends of the
    best attainable safety of cells with `best: true`, counted as the rates are; `error`, null for
    cells that did not fail; `seconds`, the only one that depends on the machine; and as JSON the
    whole row, its configuration, the versions and the checksums of files.

    Raises:
        ConfigurationError: the folder holds no sweep, a file in it cannot be read, or pyarrow is
            not installed.
    """
    _require_pyarrow()
    import pyarrow as pa

    folder = Path(folder)
    index, results = read_index(folder), ResultStore(folder / _CELLS)
    found = {key: results.document(key) for key in index["cells"]}
    documents = {key: document for key, document in found.items() if document is not None}
    with reading(folder / _CELLS, _ADVICE):
        settings = [dict(each["configuration"]["settings"]) for each in documents.values()]
        # A swept setting may be one of missing cells only.
        names = dict.fromkeys([*(name for each in settings for name in each), *index["swept"]])
        rows = [_columns(document) for document in documents.values()]
        return pa.table(
            {"key": pa.array(documents, pa.string())}
            | {name: _column([each.get(name) for each in settings]) for name in names}
            | {name: pa.array([row[name] for row in rows], kind) for name, kind in _kinds().items()}
        )


def read_index(folder: Path) -> dict[str, Any]:
    """Return the order of a sweep's cells.

    Returns:
        The keys of all cells under "cells", and the names of the swept settings under "swept".

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
            " writes it again"
        )
    return index


def _keys_before(folder: Path) -> list[str]:
    try:
        return read_index(folder)["cells"]
    except ConfigurationError:
        return []


def _require_pyarrow() -> None:
    if find_spec("pyarrow") is None:
        raise ConfigurationError(f"pyarrow is not installed; {install_extra('sweep')}")


def _kinds() -> dict[str, pa.DataType]:
    """Return the types of the columns that `_columns` fills."""
    import pyarrow as pa

    kinds = dict.fromkeys(_COUNTS, pa.int64()) | dict.fromkeys(_STATISTICS, pa.float64())
    kinds |= dict.fromkeys(_WORDS, pa.string())
    kinds |= {f"best_{name}": pa.float64() for name in _BEST}
    kinds |= {"error": pa.string(), "seconds": pa.float64()}
    return kinds | dict.fromkeys(("files", "versions", "config", "row"), pa.string())


def _columns(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a cell's row in the table, except for its settings."""
    configuration, row = document["configuration"], document["row"]
    texts = {name: configuration[name] for name in ("files", "versions")}
    texts |= {"config": document["config"], "row": row}
    statistics: Mapping[str, Any] = row or {}
    best: Mapping[str, Any] = document.get("best") or {}
    return (
        {name: statistics.get(name) for name in (*_COUNTS, *_STATISTICS, *_WORDS)}
        | {f"best_{name}": best.get(name) for name in _BEST}
        | {"error": document["error"], "seconds": document["seconds"]}
        | {name: None if part is None else json.dumps(part) for name, part in texts.items()}
    )


def _column(values: Sequence[Any]) -> pa.Array:
    """Return the values of a setting as a column: texts of JSON where they are not of one kind."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds <= {int, float}:
        return pa.array(values, pa.int64() if kinds == {int} else pa.float64())
    if kinds in ({bool}, {str}):
        return pa.array(values)
    return pa.array([None if value is None else text_of(value) for value in values], pa.string())
