"""Files of decision logs: CSV, and Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import MOST_BYTES, read_bytes
from safe_envs.errors import ConfigurationError, install_extra, shortened, shown
from safe_envs.wrappers.decision_log.columns import LogColumns

_ADVICE = "give what `DecisionLog.to_csv` or `to_parquet` wrote"
_MOST_COLUMNS = 1000


def write_csv(path: Path, columns: LogColumns, table: np.ndarray) -> None:
    """Write a log as CSV; see `DecisionLog.to_csv`.

    Args:
        path: of the file.
        columns: of the log.
        table: shape (periods, columns).
    """

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns.headings)
            # The last three are whole numbers.
            writer.writerows([*row[:-3], *map(int, row[-3:])] for row in table.tolist())

    write_atomically(path, write)


def write_parquet(path: Path, columns: LogColumns, table: np.ndarray) -> None:
    """Write a log as Parquet; see `DecisionLog.to_parquet`.

    Args:
        path: of the file.
        columns: of the log.
        table: shape (periods, columns).
    """
    _require_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = [*[np.float64] * (len(columns.headings) - 3), np.bool_, np.bool_, np.int64]
    found = pa.table(
        [pa.array(values.astype(kind)) for values, kind in zip(table.T, kinds, strict=True)],
        names=columns.headings,
    )
    write_atomically(path, lambda part: pq.write_table(found, part))


def read_log(path: Path) -> tuple[LogColumns, np.ndarray]:
    """Return the columns and the table of a log's file; see `DecisionLog.read`.

    Args:
        path: of the file.
    """
    readers: dict[str, Callable[[bytes], tuple[LogColumns, np.ndarray]]] = {
        ".csv": _read_csv,
        ".parquet": _read_parquet,
    }
    if path.suffix not in readers:
        raise ConfigurationError(
            f"{shortened(path)} is neither FILE.csv nor FILE.parquet; {_ADVICE}"
        )
    try:
        columns, table = readers[path.suffix](read_bytes(path))
        _require_log(columns, table)
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: {error.strerror}; {_ADVICE}"
        ) from error
    except (ValueError, csv.Error) as error:
        if isinstance(error, ConfigurationError):
            raise
        raise ConfigurationError(
            f"{shortened(path)} holds no log: {shortened(error)}; {_ADVICE}"
        ) from error
    return columns, table


def _read_csv(content: bytes) -> tuple[LogColumns, np.ndarray]:
    lines = io.TextIOWrapper(io.BytesIO(content), "utf-8", newline="")
    headings = next(csv.reader(lines), [])
    columns = _columns(headings)
    first = lines.readline()
    if not first:
        return columns, np.empty((0, len(headings)))
    if not first.strip():
        raise ValueError("it has an empty line")
    lines = itertools.chain([first], lines)
    return columns, np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)


def _read_parquet(content: bytes) -> tuple[LogColumns, np.ndarray]:
    _require_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(content))
        schema, count = file.schema_arrow, file.metadata.num_rows
        columns = _columns(schema.names)
        allowed = {pa.float64(), pa.int64(), pa.bool_()}
        if not set(schema.types) <= allowed:
            raise ValueError("its columns are no numbers")
        # Compressed columns may be far larger than the file.
        if 8 * count * len(schema.names) > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES / 1e6:g} MB, the largest that is read")
        table = file.read()
    except pa.ArrowException as error:
        raise ValueError(f"it is no Parquet ({error})") from error
    if any(column.null_count for column in table.columns):
        raise ValueError("numbers are missing in it")
    return columns, np.column_stack([c.to_numpy().astype(np.float64) for c in table.columns])


def _columns(headings: list[str]) -> LogColumns:
    if len(headings) > _MOST_COLUMNS:
        raise ValueError(f"it has {len(headings)} columns; {_MOST_COLUMNS} are the most")
    return LogColumns.read(headings)


def _require_log(columns: LogColumns, table: np.ndarray) -> None:
    """Raise ValueError unless the numbers are as a log writes them."""
    if table.shape[1] != len(columns.headings):
        raise ValueError(
            f"{table.shape[1]} numbers in a line with {len(columns.headings)} headings"
        )
    if not np.isfinite(table[:, 0]).all():
        raise ValueError("a time in it is not finite")
    back = np.flatnonzero(np.diff(table[:, 0]) < 0.0)
    if back.size:
        raise ValueError(f"time goes back in it, after {table[back[0], 0]:g} s")
    flags, cause = table[:, -3:-1], table[:, -1]
    causes = range(-1, len(columns.barriers))
    if not (np.isin(flags, (0.0, 1.0)).all() and np.isin(cause, causes).all()):
        raise ValueError("a flag in it is neither 0 nor 1, or a cause is none of its barriers")


def path_of(given: Path | str, allowed: str) -> Path:
    """Return the path of a file.

    Args:
        given: by the user.
        allowed: what may be given, for the error.

    Raises:
        ConfigurationError: It is no path.
    """
    if not isinstance(given, str | Path):
        raise ConfigurationError(f"{shown(given)} is no path; give {allowed}")
    return Path(given)


def _require_pyarrow() -> None:
    if find_spec("pyarrow") is None:
        raise ConfigurationError(
            f"pyarrow is not installed, which Parquet needs; {install_extra('sweep')}, or use CSV"
        )
