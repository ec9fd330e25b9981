"""A log of decisions, to which a control loop adds one each period."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, InvalidInputError, nearest, shown
from safe_envs.independent_copies import IndependentCopies
from safe_envs.number_text import finite_number
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.conditions.belief import belief_symbols
from safe_envs.wrappers.decision_log.columns import LogColumns
from safe_envs.wrappers.decision_log.files import path_of, read_log, write_csv, write_parquet
from safe_envs.wrappers.decision_log.given import (
    Defaults,
    endless,
    pairs_of,
    require_finite,
    runtime_values,
)
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.safety_filter import SafetyFilter


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
        log._bounds = endless(qp.low), endless(qp.high)
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
        bounds: Any = None,
        parameters: Mapping[Any, float] | None = None,
    ) -> None:
        """Add the decision of one period.

        Args:
            t: time in s, of a clock that never goes back, such as `time.monotonic`.
            x: state, shape (n,); `safety_filter.measured.mean` after a measurement.
            decision: what the filter returned for that one state.
            bounds: as given to the filter; those of its construction by default.
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
            low, high = self._bounds if bounds is None else pairs_of(bounds, len(action))
            known = self._defaults
            values = array(
                "d",
                [
                    t,
                    *x,
                    *(runtime_values(known, parameters or {}) if known or parameters else ()),
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
        if not math.isfinite(sum(values[: self._inputs])):
            require_finite(self.columns.headings, values[: self._inputs])
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
        write_csv(path_of(path, "FILE.csv"), self.columns, self.table())

    def to_parquet(self, path: Path | str) -> None:
        """Write a Parquet file, whole or not at all; needs pyarrow.

        Args:
            path: of the file.

        Raises:
            ConfigurationError: pyarrow is not installed, or the file cannot be written.
        """
        write_parquet(path_of(path, "FILE.parquet"), self.columns, self.table())

    @classmethod
    def read(cls, path: Path | str) -> DecisionLog:
        """Read what `to_csv` or `to_parquet` wrote, by the suffix of the file.

        Args:
            path: of the file, FILE.csv or FILE.parquet.

        Raises:
            ConfigurationError: The file cannot be read, is too large, or holds no log.
        """
        columns, table = read_log(path_of(path, "FILE.csv or FILE.parquet"))
        log = cls(columns)
        log._values.frombytes(np.ascontiguousarray(table, dtype=np.float64).tobytes())
        return log
