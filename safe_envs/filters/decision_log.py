"""What a filter decided in a control loop: kept cheaply, written to a file, read back."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import (
    ConfigurationError,
    IndependentCopies,
    InvalidInputError,
    install_extra,
    nearest,
    shortened,
    shown,
)
from safe_envs.files import MOST_BYTES, read_bytes, write_atomically
from safe_envs.filters.arguments import WIDEST
from safe_envs.filters.conditions.estimates import belief_symbols
from safe_envs.filters.qp import FilterDecision
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.signals import TIME
from safe_envs.text import finite_number

_FLAGS = ("intervention", "feasible", "cause")
_BRACKETED_END = re.compile(r" \[([^][]*)\]$")
_HEADING = re.compile(r"(\w+):(.*?)(?: \[([^][]*)\])?", re.DOTALL)
_MOST_COLUMNS = 1000
_SECTIONS = ("state", "parameter", "nominal", "action", "low", "high", "h", "slack")


@dataclass(frozen=True)
class LogColumns:
    """Names of what a log holds, and units.

    A column is called "section:name [unit]", without the brackets where no unit is known. The
    sections are state, parameter (given at run time), nominal, action, low and high (of each
    input), h and slack (of each barrier). "t [s]" comes first; last are "intervention", "feasible"
    and "cause", the index of the barrier that caused an intervention, or -1.

    Attributes:
        states: n names.
        inputs: m names.
        barriers: k names, each once.
        parameters: names of what is given at run time.
        units: by name, as far as they are known.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    barriers: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        states: Iterable[object],
        inputs: Iterable[object],
        barriers: Sequence[str],
        parameters: Iterable[object] = (),
        units: Mapping[object, str] | None = None,
    ) -> LogColumns:
        """Return the columns of symbols or names; barriers of the same name are numbered.

        In names and units characters that cannot be printed are replaced by spaces, and brackets at
        the end of a name by parentheses: there they would be read as a unit.

        Args:
            states: n symbols.
            inputs: m symbols.
            barriers: k names.
            parameters: symbols of what is given at run time.
            units: by symbol or name.

        Raises:
            ConfigurationError: The units are no mapping, or one is of nothing that is logged or
                holds a bracket; or states, inputs or parameters have a name twice.
        """
        if not isinstance(units, Mapping | None):
            raise ConfigurationError(
                f"units = {shown(units)}; give a dict of texts, such as {{'x': 'm'}}"
            )
        names = _numbered([_name(barrier) for barrier in barriers])
        parts = [tuple(map(_name, part)) for part in (states, inputs, names, parameters)]
        for part in parts:
            for name, count in Counter(part).items():
                if count > 1:
                    raise ConfigurationError(
                        f"{shown(name)} names {count} columns of the log; give each its own name"
                    )
        given = {_name(k): printable(str(unit)).strip() for k, unit in (units or {}).items()}
        given = {name: unit for name, unit in given.items() if unit}
        known = list(itertools.chain(*parts))
        for name, unit in given.items():
            if name not in known:
                raise ConfigurationError(f"units has {shown(name)}; {nearest(name, known)}")
            if "[" in unit or "]" in unit:
                raise ConfigurationError(f"the unit of {name} is {shown(unit)}; write no brackets")
        return cls(*parts, units=given)

    @cached_property
    def _names(self) -> dict[str, tuple[str, ...]]:
        """Names of what each section holds."""
        each = (self.states, self.parameters, *[self.inputs] * 4, *[self.barriers] * 2)
        return dict(zip(_SECTIONS, each, strict=True))

    @cached_property
    def sections(self) -> dict[str, slice]:
        """Where the columns of each section are."""
        widths = {"t": 1, **{name: len(of) for name, of in self._names.items()}}
        widths |= dict.fromkeys(_FLAGS, 1)
        ends = itertools.accumulate(widths.values())
        return {
            name: slice(end - width, end)
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }

    @cached_property
    def headings(self) -> list[str]:
        """Return the names of all columns."""
        named = [
            f"{section}:{name}{self._bracketed(name) if section != 'slack' else ''}"
            for section, names in self._names.items()
            for name in names
        ]
        return ["t [s]", *named, *_FLAGS]

    def misfit(self, numbers: Sequence[float]) -> str | None:
        """Return why numbers cannot be those of a period; None if they can.

        Args:
            numbers: of one period.
        """
        if len(numbers) != len(self.headings):
            return f"{len(numbers)} numbers for {len(self.headings)} columns"
        *_, intervened, feasible, cause = numbers
        if not math.isfinite(numbers[0]) or not {intervened, feasible} <= {0.0, 1.0}:
            return "t must be finite, and the two flags near the end 0 or 1"
        last = len(self.barriers) - 1
        if cause not in range(-1, last + 1):
            return f"the cause at the end must be a whole number from -1 to {last}"
        return None

    def _bracketed(self, name: str) -> str:
        return f" [{self.units[name]}]" if name in self.units else ""

    @classmethod
    def read(cls, headings: Sequence[str]) -> LogColumns:
        """Read the names of columns as `headings` has them.

        Raises:
            ValueError: They are not those of a log.
        """
        if len(headings) > _MOST_COLUMNS:
            raise ValueError(f"it has {len(headings)} columns; {_MOST_COLUMNS} are the most")
        twice = [heading for heading, count in Counter(headings).items() if count > 1]
        if twice:
            raise ValueError(f"it has the column {shown(twice[0])} twice")
        found: dict[str, list[str]] = {section: [] for section in _SECTIONS}
        units = {}
        for heading in headings[1 : -len(_FLAGS)]:
            parts = _HEADING.fullmatch(heading)
            if parts is None or parts[1] not in found:
                raise ValueError(f"it has the column {shown(heading)}")
            found[parts[1]].append(parts[2])
            if parts[3]:
                units[parts[2]] = parts[3]
        columns = cls(
            *(tuple(found[name]) for name in ("state", "action", "h", "parameter")), units=units
        )
        if columns.headings != list(headings) or not (columns.inputs and columns.barriers):
            raise ValueError("its columns are not those of a log, in their order")
        return columns


def printable(text: str) -> str:
    """Return a text with spaces for control characters and halves of surrogate pairs."""
    return "".join([c if c.isprintable() else " " for c in text])


def _name(given: object) -> str:
    return _BRACKETED_END.sub(r" (\1)", printable(str(given)))


def _numbered(names: Sequence[str]) -> list[str]:
    """Return names, each once: those that come twice get numbers that no other name has."""
    count, found = Counter(names), []
    taken = {name for name in names if count[name] == 1}
    for name in names:
        if count[name] > 1:
            numbers = itertools.count(1)
            name = next(new for i in numbers if (new := f"{name} {i}") not in taken)
            taken.add(name)
        found.append(name)
    return found


def _read_csv(content: bytes) -> tuple[LogColumns, np.ndarray]:
    lines = io.TextIOWrapper(io.BytesIO(content), "utf-8", newline="")
    headings = next(csv.reader(lines), [])
    columns = LogColumns.read(headings)
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
        columns = LogColumns.read(schema.names)
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


Defaults = Sequence[tuple[sp.Symbol, str, float | None]]
"""Each symbol of run time, its name, and its value where none is given."""


def _runtime_values(known: Defaults, parameters: Mapping[Any, float]) -> list[float]:
    """Return what was given at run time, in order; raises where not each is there once."""
    found, used = [], 0
    for symbol, name, default in known:
        value = parameters.get(name)
        if value is None:
            value = parameters.get(symbol)
        if value is not None:
            used += 1
        elif default is not None:
            value = default
        else:
            raise InvalidInputError(f"parameters lacks {symbol}; give what the filter was given")
        found.append(value)
    if used < len(parameters):
        raise InvalidInputError(
            f"parameters has {', '.join(map(str, parameters))}; the log takes each of"
            f" {', '.join([name for _, name, _ in known]) or 'none'} once"
        )
    return found


class DecisionLog(IndependentCopies):
    """States, inputs, barriers and slacks of a control loop over time.

    Adding a decision takes a few microseconds and 8 bytes for each column. The log grows with every
    period: a loop that runs for days writes it now and then, outside the loop, and goes on with
    another one.

    Args:
        columns: what is logged; see `for_filter`.

    Attributes:
        columns: as given.

    Raises:
        ConfigurationError: they are no `LogColumns`.
    """

    def __init__(self, columns: LogColumns) -> None:
        if not isinstance(columns, LogColumns):
            raise ConfigurationError(
                f"columns = {shown(columns)}; make a log by DecisionLog.for_filter(safety_filter)"
            )
        self.columns = columns
        self._width = len(columns.headings)
        self._values = array("d")
        self._bounds: tuple[Sequence[float], Sequence[float]] = ((), ())
        self._defaults: Defaults = []
        self._believed: frozenset[Any] = frozenset()
        # The columns of the time, the state and the parameters come first.
        self._inputs = 1 + len(columns.states)

    @classmethod
    def for_filter(
        cls, safety_filter: SafetyFilter, units: Mapping[Any, str] | None = None
    ) -> DecisionLog:
        """Return an empty log with the names of a filter's states, inputs and barriers.

        Of a filter that is given measurements the state is the estimate. The covariance that
        conditions with `belief` are given is left out; their h is that of the belief.

        Args:
            safety_filter: whose decisions will be added.
            units: of states, inputs, run-time parameters and barriers, by symbol or name.

        Raises:
            ConfigurationError: What is given is no filter, or a unit is of nothing that is logged.
        """
        if not isinstance(safety_filter, SafetyFilter):
            raise ConfigurationError(
                f"{shown(safety_filter)} is no SafetyFilter; give the one that decides"
            )
        qp, model = safety_filter.qp, safety_filter.model
        belief = [s for group in belief_symbols(model.n) for s in group]
        runtime = [symbol for symbol in qp.runtime if symbol not in (TIME, *belief)]
        names = [barrier.name for barrier, _ in safety_filter.pairs]
        log = cls(LogColumns.of(model.states, model.inputs, names, runtime, units))
        # A filter has `WIDEST` where it was given no bound.
        low, high = (
            [math.copysign(math.inf, b) if abs(b) == WIDEST else b for b in bounds]
            for bounds in (qp.low, qp.high)
        )
        log._bounds = low, high
        log._defaults = [(s, s.name, model.parameters.get(s)) for s in runtime]
        log._inputs += len(runtime)
        log._believed = frozenset(each for s in belief for each in (s, s.name) if s in qp.runtime)
        return log

    def add(
        self,
        t: float,
        x: Any,
        decision: FilterDecision,
        *,
        input_bounds: Any = None,
        parameters: Mapping[Any, float] | None = None,
    ) -> None:
        """Add the decision of one period.

        Args:
            t: time in s, of a clock that never goes back, such as `time.monotonic`.
            x: state, shape (n,); `safety_filter.measured.mean` after a measurement.
            decision: what the filter returned for that one state.
            input_bounds: as given to the filter; those of its construction by default.
            parameters: as given to the filter.

        Raises:
            InvalidInputError: Something is missing, not finite or does not fit the log, or the time
                lies before the last one.
        """
        try:
            if self._believed and parameters:
                parameters = {k: v for k, v in parameters.items() if k not in self._believed}
            action, proposed = decision.action.tolist(), decision.proposed.tolist()
            intervened = decision.cause >= 0 and action != proposed
            low, high = self._bounds
            if input_bounds is not None:
                low, high = np.broadcast_to(
                    np.asarray(input_bounds, float), (len(action), 2)
                ).T.tolist()
            known = self._defaults
            values = array(
                "d",
                [
                    t,
                    *x,
                    *(_runtime_values(known, parameters or {}) if known or parameters else ()),
                    *proposed,
                    *action,
                    *low,
                    *high,
                    *decision.barrier.tolist(),
                    *decision.slack.tolist(),
                    intervened,
                    decision.feasible,
                    decision.cause if intervened else -1,
                ],
            )
        except InvalidInputError:
            raise
        except (AttributeError, OverflowError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"the log takes one state and its decision at a time ({error}); give t in s, x of"
                f" shape ({len(self.columns.states)},) and what the filter returned for it"
            ) from error
        if len(values) != self._width or not math.isfinite(values[0]):
            raise InvalidInputError(
                f"t = {shown(t)} with {len(values)} numbers in all does not fit the log, which"
                f" takes {self._width}: a finite t, {len(self.columns.states)} states, and the"
                " decision of the filter that the log was made for"
            )
        if not math.isfinite(sum(values[: self._inputs])):  # which may be of finite numbers
            for heading, value in zip(self.columns.headings, values[: self._inputs], strict=False):
                if not math.isfinite(value):
                    raise InvalidInputError(
                        f"{heading} is {value}, of which a filter decides nothing; give what it"
                        " decided about"
                    )
        self._extend(values)

    def append(self, values: Sequence[float]) -> None:
        """Add the numbers of one period in the order of `LogColumns.headings`.

        Raises:
            InvalidInputError: They do not fit, or the time lies before the last one.
        """
        try:
            row = array("d", values)
        except (OverflowError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"the log takes {self._width} numbers, not {shown(values)}: {error}"
            ) from error
        if (reason := self.columns.misfit(row)) is not None:
            raise InvalidInputError(f"{shown(row.tolist())} does not fit the log: {reason}")
        self._extend(row)

    def _extend(self, row: array[float]) -> None:
        if self._values and row[0] < self._values[-self._width]:
            raise InvalidInputError(
                f"t = {row[0]} s lies before the last time of the log,"
                f" {self._values[-self._width]} s; take a clock that never goes back, such as"
                " time.monotonic, and another log for another run"
            )
        self._values.extend(row)

    def __len__(self) -> int:
        return len(self._values) // self._width

    def table(self) -> np.ndarray:
        """Return all that was added, shape (periods, columns); see `LogColumns.headings`."""
        # A copy: the array cannot grow while somebody holds a view.
        return np.array(self._values).reshape(-1, self._width)

    def section(self, name: str) -> np.ndarray:
        """Return the columns of a section of `LogColumns`, shape (periods, columns).

        Raises:
            ConfigurationError: There is no such section.
        """
        if name not in self.columns.sections:
            raise ConfigurationError(
                f"unknown section {shown(name)}; {nearest(str(name), self.columns.sections)}"
            )
        table = np.frombuffer(self._values).reshape(-1, self._width)
        return table[:, self.columns.sections[name]].copy()

    def between(self, start: float | None = None, end: float | None = None) -> DecisionLog:
        """Return a log of the periods between two times, both included.

        Args:
            start: in s; by default that of the log.
            end: in s; by default that of the log.

        Raises:
            ConfigurationError: A time is no finite number.
        """
        t, found = self.t, DecisionLog(self.columns)
        first, last = 0, len(t)
        if start is not None:
            first = int(np.searchsorted(t, finite_number("start", start), "left"))
        if end is not None:
            last = int(np.searchsorted(t, finite_number("end", end), "right"))
        found._values = self._values[first * self._width : max(first, last) * self._width]
        return found

    @property
    def t(self) -> np.ndarray:
        """Times in s, shape (periods,)."""
        return self.section("t")[:, 0]

    @property
    def intervention(self) -> np.ndarray:
        """Whether a constraint changed the input, bool (periods,)."""
        return self.section("intervention")[:, 0] > 0.0

    @property
    def feasible(self) -> np.ndarray:
        """Whether all constraints could be met, bool (periods,)."""
        return self.section("feasible")[:, 0] > 0.0

    @property
    def interventions(self) -> int:
        """Number of periods in which a constraint changed the input."""
        return int(np.count_nonzero(self.intervention))

    @property
    def infeasible(self) -> int:
        """Number of periods in which no input within its bounds met all constraints."""
        return int(np.count_nonzero(~self.feasible))

    @property
    def h_min(self) -> float:
        """Smallest value of any barrier; inf for an empty log."""
        return float(self.section("h").min(initial=math.inf))

    def __str__(self) -> str:
        if not len(self):
            return "an empty log"
        h = self.section("h")
        k, i = np.unravel_index(np.argmin(h), h.shape)
        unit = self.columns.units.get(self.columns.barriers[i], "")
        return (
            f"{len(self)} decisions: {self.interventions} interventions, {self.infeasible}"
            f" infeasible; smallest h {h[k, i]:.4g}{' ' * bool(unit)}{unit}"
            f" ({self.columns.barriers[i]}, t = {self.t[k]:.6g} s)"
        )

    def to_csv(self, path: Path | str) -> None:
        """Write a CSV file with one line of headings, whole or not at all.

        Numbers are written so that they are read back to the last bit.

        Args:
            path: of the file.

        Raises:
            ConfigurationError: The file cannot be written.
        """

        def write(part: Path) -> None:
            with part.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.writer(stream, lineterminator="\n")
                writer.writerow(self.columns.headings)
                # The last three are whole numbers.
                rows = self.table().tolist()
                writer.writerows([*row[:-3], *map(int, row[-3:])] for row in rows)

        write_atomically(path_of(path, "FILE.csv"), write)

    def to_parquet(self, path: Path | str) -> None:
        """Write a Parquet file, whole or not at all; needs pyarrow.

        Args:
            path: of the file.

        Raises:
            ConfigurationError: pyarrow is not installed, or the file cannot be written.
        """
        target = path_of(path, "FILE.parquet")
        _require_pyarrow()
        import pyarrow as pa
        import pyarrow.parquet as pq

        headings, columns = self.columns.headings, self.table().T
        kinds = [*[np.float64] * (len(headings) - 3), np.bool_, np.bool_, np.int64]
        found = pa.table(
            [pa.array(values.astype(kind)) for values, kind in zip(columns, kinds, strict=True)],
            names=headings,
        )
        write_atomically(target, lambda part: pq.write_table(found, part))

    @classmethod
    def read(cls, path: Path | str) -> DecisionLog:
        """Read what `to_csv` or `to_parquet` wrote, by the suffix of the file.

        Args:
            path: of the file, FILE.csv or FILE.parquet.

        Raises:
            ConfigurationError: The file cannot be read, is too large, or holds no log.
        """
        place = path_of(path, "FILE.csv or FILE.parquet")
        advice = "give what `DecisionLog.to_csv` or `to_parquet` wrote"
        reader = {".csv": _read_csv, ".parquet": _read_parquet}.get(place.suffix)
        name = shortened(place)
        if reader is None:
            raise ConfigurationError(f"{name} is neither FILE.csv nor FILE.parquet; {advice}")
        try:
            columns, table = reader(read_bytes(place))
            _require_log(columns, table)
        except OSError as error:
            raise ConfigurationError(
                f"{name} cannot be read: {error.strerror}; {advice}"
            ) from error
        except ConfigurationError:
            raise
        except (ValueError, csv.Error) as error:
            raise ConfigurationError(
                f"{name} holds no log: {shortened(error)}; {advice}"
            ) from error
        log = cls(columns)
        log._values.frombytes(np.ascontiguousarray(table, dtype=np.float64).tobytes())
        return log
