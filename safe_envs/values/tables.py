"""Tables of the lower and upper envelope of a problem's value."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.arrays import checksum, reading, write_arrays
from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.files import MOST_BYTES_OF_TEXT
from safe_envs.filters.specification import MOST_STATES
from safe_envs.lazy_attributes import package_version
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import finite_number
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.reduction import reduced

KNOWLEDGE = ("model", "plant")
LEAVING = ("violation", "safe")


@dataclass(frozen=True)
class ValueSettings:
    """What a table of values is asked for, next to a problem.

    Attributes:
        knowledge: whose step is taken, that of the "model" or of the "plant".
        leaving: how an episode counts that leaves the workspace in the safe set: as a "violation",
            or as "safe", which is how `evaluate` counts it.
        intervals: of parameters that are uncertain; values hold for the worst ones, which may
            change at every step.
        specification: that an episode is to meet, over the sets that the problem names, such as
            "always safe & eventually goal"; "" for that of staying safe.
        cells: number along each coordinate; None for numbers that suit the problem.
        inputs: number of inputs that are scanned along each input; None for one that suits.
        memory: in bytes, which the tables must not exceed.

    Raises:
        ConfigurationError: A value is not allowed.
    """

    knowledge: str = "model"
    leaving: str = "violation"
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    specification: str = ""
    cells: tuple[int, ...] | None = None
    inputs: int | None = None
    memory: float = 4e9

    def __post_init__(self) -> None:
        for name, allowed in (("knowledge", KNOWLEDGE), ("leaving", LEAVING)):
            given = getattr(self, name)
            if given not in allowed:
                raise ConfigurationError(f"{name} = {shown(given)}; {nearest(str(given), allowed)}")
        if not isinstance(self.specification, str):
            raise ConfigurationError(
                f"specification = {shown(self.specification)}; give text, such as"
                ' "always safe & eventually goal"'
            )
        if self.cells is not None:
            if isinstance(self.cells, str) or not isinstance(self.cells, Iterable):
                raise ConfigurationError(
                    f"cells = {shown(self.cells)}; give a whole number for each coordinate, such as"
                    " (400, 100)"
                )
            object.__setattr__(self, "cells", tuple(self.cells))
            for count in self.cells:
                require_whole("cells", count, 2)
        if self.inputs is not None:
            require_whole("inputs", self.inputs, 2)
        if not finite_number("memory", self.memory) > 0:
            raise ConfigurationError(f"memory = {shown(self.memory)}; give a number of bytes")
        intervals = {str(name): _interval(name, given) for name, given in self.intervals.items()}
        object.__setattr__(self, "intervals", intervals)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as JSON-able data."""
        return {
            "specification": self.specification,
            "knowledge": self.knowledge,
            "leaving": self.leaving,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "cells": None if self.cells is None else list(self.cells),
            "inputs": self.inputs,
            "memory": self.memory,
        }


def _interval(name: str, given: Any) -> tuple[float, float]:
    try:
        low, high = given
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"interval of {name} = {shown(given)}; give two numbers, the lower one first"
        ) from error
    ends = tuple(finite_number(f"interval of {name}", end) for end in (low, high))
    return ends[0], ends[1]


@dataclass(frozen=True, eq=False)
class ValueTable:
    """Envelopes of a problem's value on the cells of a grid.

    The tables are of the control instants `first` to K; before `first` nothing changes any more, so
    that the first one stands for all earlier instants.

    Attributes:
        problem: its name.
        fingerprint: of the problem and of what determines its values.
        settings: what was asked for.
        grid: of the coordinates.
        inputs: that were scanned, in physical units, shape (U, m).
        first: control instant of the first one.
        lower: lower envelope, shape (K + 1 - first, cells), float32 in [0, 1]; 0 outside the grid.
            With a specification shape (K + 1 - first, states cells): the cells of each of the
            states of the automaton that are not settled, one state after the other.
        upper: upper envelope, of the same shape.
        seconds: that the computation took.
    """

    problem: str
    fingerprint: str
    settings: ValueSettings
    grid: Grid
    inputs: np.ndarray
    first: int
    lower: np.ndarray
    upper: np.ndarray
    seconds: float

    @property
    def steps(self) -> int:
        """Control periods of an episode, K."""
        return self.first + len(self.lower) - 1

    @property
    def states(self) -> int:
        """States of the automaton that the tables hold values of; 1 without a specification."""
        return self.lower.shape[1] // self.grid.cells

    @property
    def memory(self) -> int:
        """Bytes of the tables."""
        return self.lower.nbytes + self.upper.nbytes


MOST_BYTES_OF_TABLE = 8_000_000_000
"""Of a file with a table."""

FORMAT = 3
"""To be raised whenever the same problem and settings give other values, or values that are looked
up in another way: what is kept in caches is of the same version of the package often."""

WRITER = "safe-envs best"

_KIND = "values"
_FINGERPRINT = re.compile("[0-9a-f]{64}")
_LOWER, _UPPER, _INPUTS, _PERIODS = "lower", "upper", "inputs", "periods"
_ROUNDING = 1e-9


class ValueFileError(ConfigurationError):
    """A file is no table of values, damaged, or of another problem."""


def save_table(table: ValueTable, path: Path | str) -> None:
    """Write a table into a file, whole or not at all.

    Args:
        table: of values.
        path: of the file.

    Raises:
        ConfigurationError: It cannot be written there, is too large to be read, or holds values
            that are none.
    """
    path = Path(path)
    try:
        _require_values(table)
    except ValueError as error:
        raise ConfigurationError(f"{shortened(path)} is not written: {error}") from error
    grid = table.grid
    arrays = {
        **{_edges_of(i): axis.edges.astype("<f8") for i, axis in enumerate(grid.axes)},
        _PERIODS: np.array([axis.period for axis in grid.axes], dtype="<f8"),
        _INPUTS: table.inputs.astype("<f8"),
        _LOWER: table.lower.astype("<f4", copy=False),
        _UPPER: table.upper.astype("<f4", copy=False),
    }
    header = {
        "format": FORMAT,
        "kind": _KIND,
        "problem": table.problem,
        "fingerprint": table.fingerprint,
        "settings": table.settings.as_dict(),
        "first": int(table.first),
        "sizes": {"instants": len(table.lower), "cells": list(grid.shape)},
        "seconds": float(table.seconds),
        "version": package_version(),
    }
    header["sha256"] = checksum(header, arrays)
    write_arrays(path, header, arrays, MOST_BYTES_OF_TABLE - MOST_BYTES_OF_TEXT)


def load_table(path: Path | str, problem: SafetyProblem | None = None) -> ValueTable:
    """Read a table from a file.

    Args:
        path: of the file.
        problem: whose values it has to hold; None for those of any.

    Raises:
        ValueFileError: The file is missing, a folder, no such file, truncated, altered, or of
            another problem.
    """
    path = Path(path)
    table = _read(path)
    if problem is not None:
        _require_problem(path, table, problem)
    return table


def require_asked(path: Path, table: ValueTable, settings: ValueSettings) -> None:
    """Check that a table is what is asked for.

    The numbers of cells and inputs may be any where none are asked for.

    Args:
        path: of its file.
        table: that was read.
        settings: what is asked for.

    Raises:
        ValueFileError: It has other settings.
    """
    asked = settings.as_dict()
    found = table.settings.as_dict()
    if asked["cells"] != found["cells"]:
        # A grid may have a few more cells than it was asked for.
        found["cells"] = list(table.grid.shape)
    for name, value in asked.items():
        free = name == "memory" or (name in ("cells", "inputs") and value is None)
        if not free and found[name] != value:
            raise ValueFileError(
                f"{shortened(path)} holds values with {name} = {shown(found[name])}, and"
                f" {shown(value)} is asked for; ask for the former, or name another file"
            )


def _require_problem(path: Path, table: ValueTable, problem: SafetyProblem) -> None:
    settings = table.settings
    try:
        expected = reduced(
            problem, settings.knowledge, settings.intervals, settings.specification
        ).fingerprint
    except ConfigurationError:  # It has no such parameters, or other coordinates.
        expected = ""
    if table.fingerprint != expected:
        whose = (
            f"an earlier version of {shown(problem.name)}, with other dynamics, noise, sets or"
            " horizon"
            if table.problem == problem.name
            else f"{shown(table.problem)}, and not of {shown(problem.name)}"
        )
        raise ValueFileError(
            f"{shortened(path)} holds values of {whose}; name another file, or one that is not"
            f" there yet to let `{WRITER}` compute them"
        )


def _edges_of(axis: int) -> str:
    return f"edges_{axis}"


def _read(path: Path) -> ValueTable:
    name = shortened(path)
    with reading(path, WRITER, ValueFileError, MOST_BYTES_OF_TABLE) as file:
        header = dict(file.header)
        if header["kind"] != _KIND:
            raise ValueError("it holds something else")
        if header["format"] != FORMAT:
            raise ValueFileError(
                f"{name} has the format {shown(header['format'])}; this version reads {FORMAT}. Run"
                f" `{WRITER}` again"
            )
        arrays = file.arrays()
        if header.pop("sha256") != checksum(header, arrays):
            raise ValueFileError(
                f"{name} was altered: its content does not match its checksum. Remove it and run"
                f" `{WRITER}` again"
            )
        table = _table(header, arrays)
        _require_values(table)
    return table


def _table(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> ValueTable:
    """Return what was read as a table; raise one of the errors of damaged files otherwise."""
    problem, fingerprint, first = header["problem"], header["fingerprint"], header["first"]
    if not (isinstance(problem, str) and _FINGERPRINT.fullmatch(fingerprint)):
        raise ValueError("its name or fingerprint is none")
    if isinstance(first, bool) or not isinstance(first, int) or first < 0:
        raise ValueError("its first instant is none")
    periods = arrays.pop(_PERIODS)
    edges = [arrays.pop(_edges_of(i)) for i in range(len(periods))]
    inputs, lower, upper = (arrays.pop(each) for each in (_INPUTS, _LOWER, _UPPER))
    if arrays:
        raise ValueError("it holds more than it should")
    return ValueTable(
        problem=problem,
        fingerprint=fingerprint,
        settings=ValueSettings(**header["settings"]),
        grid=Grid(
            tuple(Axis(each, float(p)) for each, p in zip(edges, periods, strict=True)),
        ),
        inputs=inputs,
        first=first,
        lower=lower,
        upper=upper,
        seconds=float(header["seconds"]),
    )


def _require_values(table: ValueTable) -> None:
    """Raise ValueError unless a table is one: 0 <= lower <= upper <= 1 on cells that increase."""
    axes = table.grid.axes
    for axis in axes:
        edges, period = axis.edges, axis.period
        if edges.dtype != np.float64 or edges.ndim != 1 or len(edges) < 2:
            raise ValueError("the edges of an axis are no list of numbers")
        if not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
            raise ValueError("the edges of an axis do not increase")
        extent = edges[-1] - edges[0]
        if not (period == 0 or abs(period - extent) <= _ROUNDING * extent):
            raise ValueError("the edges of an axis do not cover its period")
    inputs = table.inputs
    if inputs.dtype != np.float64 or inputs.ndim != 2 or not np.isfinite(inputs).all():
        raise ValueError("the inputs are no table of numbers")
    if not axes or not inputs.size or not np.isfinite(table.seconds) or table.seconds < 0:
        raise ValueError("it has no axis, no input, or no time")
    states = table.states if table.lower.ndim == 2 else 1
    if not (states == 1 or (table.settings.specification and 1 <= states <= MOST_STATES)):
        raise ValueError("it holds values of states that no specification has")
    shape = (len(table.lower), states * table.grid.cells)
    for values in (table.lower, table.upper):
        if values.dtype != np.float32 or values.shape != shape or not values.size:
            raise ValueError(f"an envelope is no table of {shape} values")
    # One instant after the other, for a table may fill half of the memory. NaN is not <= 1.
    for lower, upper in zip(table.lower, table.upper, strict=True):
        if not (lower.min() >= 0 and upper.max() <= 1 and (lower <= upper).all()):
            raise ValueError("its values are not 0 <= lower <= upper <= 1")
