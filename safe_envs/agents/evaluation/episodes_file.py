"""The results of single episodes as a Parquet file, written while they are simulated."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.errors import ConfigurationError, install_extra
from safe_envs.files import replaced_at_the_end, require_writable, writing


class EpisodeSink(Protocol):
    """Receives the results of all episodes in the order of filters, identifications, episodes."""

    def begin(self, name: str, repeat: int) -> None:
        """Go on with the episodes of another filter or identification.

        Args:
            name: of the filter.
            repeat: number of the identification.
        """

    def add(self, results: EpisodeResults) -> None:
        """Receive the episodes that follow."""


class KeptEpisodes(EpisodeSink):
    """Keeps the results in memory."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, int], list[EpisodeResults]] = {}
        self._current: list[EpisodeResults] = []

    def begin(self, name: str, repeat: int) -> None:
        """See `EpisodeSink`.

        Args:
            name: of the filter.
            repeat: number of the identification.
        """
        self._current = self._parts[name, repeat] = []

    def add(self, results: EpisodeResults) -> None:
        """See `EpisodeSink`."""
        self._current.append(results)

    def joined(self) -> dict[str, list[EpisodeResults]]:
        """Return the results for each filter and identification."""
        found: dict[str, list[EpisodeResults]] = {}
        for (name, _), parts in self._parts.items():
            found.setdefault(name, []).append(EpisodeResults.joined(parts))
        return found


_GROUP = 65_536
"""Rows that are written at a time, so that the file does not depend on the size of batches."""

_TYPES = {
    "filter": "string",
    "identification": "int64",
    "episode": "int64",
    "safe": "bool",
    "return": "float64",
    "min_h": "float64",
    "first_violation": "float64",
    "length": "int32",
    "interventions": "int32",
    "infeasible": "int32",
    "effort": "float64",
}


def require_parquet(path: Path, option: str) -> None:
    """Check that a Parquet file can be written: asked before a long run.

    Args:
        path: of the file.
        option: what the user calls it.

    Raises:
        ConfigurationError: pyarrow is not installed, or the file has another suffix or cannot be
            written.
    """
    if find_spec("pyarrow") is None:
        raise ConfigurationError(
            f"pyarrow is not installed, which writes Parquet; {install_extra('sweep')}"
        )
    if path.suffix != ".parquet":
        raise ConfigurationError(f"{option} {path} is no name of a Parquet file; give FILE.parquet")
    require_writable(path)


class EpisodesFile(EpisodeSink):
    """Writes the columns of `Evaluation.episode_columns`, with null for NaN.

    The rows are in the order of filters, identifications and episodes. What waits to be written
    does not grow with their number.

    Args:
        path: of the file, in messages.
        writer: a `pyarrow.parquet.ParquetWriter`.
        dt: control period in s.
    """

    def __init__(self, path: Path, writer: Any, dt: float) -> None:
        self._path, self._writer, self._dt = path, writer, dt
        self._waiting: list[EpisodeResults] = []
        self._count = 0
        self._label, self._first = ("", 0), 0

    def begin(self, name: str, repeat: int) -> None:
        """See `EpisodeSink`; errors as for `add`.

        Args:
            name: of the filter.
            repeat: number of the identification.
        """
        self.flush()
        self._label, self._first = (name, repeat), 0

    def add(self, results: EpisodeResults) -> None:
        """See `EpisodeSink`.

        Raises:
            ConfigurationError: they cannot be written, as on a full disk.
        """
        self._waiting.append(results)
        self._count += len(results.length)
        if self._count >= _GROUP:
            self._write(_GROUP)

    def flush(self) -> None:
        """Write what waits; errors as for `add`."""
        if self._count:
            self._write(1)

    def _write(self, least: int) -> None:
        """Write groups while there are at least so many rows."""
        import pyarrow as pa

        results, done = EpisodeResults.joined(self._waiting), 0
        while self._count >= least:
            group = results.part(slice(done, done + _GROUP))
            columns = group.columns(*self._label, self._first, self._dt)
            table = pa.table(
                {name: pa.array(values, from_pandas=True) for name, values in columns.items()},
                schema=self._writer.schema,
            )
            with writing(self._path):
                self._writer.write_table(table)
            self._first += len(group.length)
            done += len(group.length)
            self._count -= len(group.length)
        self._waiting = [results.part(slice(done, None))]


@contextmanager
def episodes_file(path: Path, dt: float) -> Iterator[EpisodesFile]:
    """Open a file that is there at the end, whole or not at all.

    Args:
        path: of the file.
        dt: control period in s.

    Returns:
        A context that gives the file.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with replaced_at_the_end(path) as temporary:
        with writing(path):
            writer = pq.ParquetWriter(temporary, pa.schema(_TYPES.items()))
        file = EpisodesFile(path, writer, dt)
        try:
            yield file
            file.flush()
        finally:
            with writing(path):
                writer.close()
