"""How long single decisions of a filter take: the tail of the distribution, not only its middle."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from benchmarks.cases import flights_within_limits, obstacle_course
from safe_envs.wrappers import FilterDecision, SafetyFilter

COLUMNS = ("median", "p99", "p99.9", "max", "gc off: p99.9", "gc off: max", "collections")
"""Of the table: microseconds of processor time of a call, and the number of garbage collections."""

_PREFIX = "latency, "
_CALLS = 10_000
_DRAWN = 8192
_STATES = 64
"""That take turns, so that no case lives in the caches of one state."""


class TimedCalls(NamedTuple):
    """Calls of a filter.

    Attributes:
        safety_filter: that decides.
        states: shape (B, n).
        inputs: proposed ones, shape (B, m).
    """

    safety_filter: SafetyFilter
    states: np.ndarray
    inputs: np.ndarray

    def decisions(self) -> FilterDecision:
        """Return what is decided, as a batch."""
        return self.safety_filter.filter(self.states, self.inputs)

    def where(self, chosen: np.ndarray) -> TimedCalls:
        """Return the first of the calls that are chosen.

        Args:
            chosen: bool (B,).
        """
        places = np.flatnonzero(chosen)[:_STATES]
        return self._replace(states=self.states[places], inputs=self.inputs[places])


def cases() -> dict[str, TimedCalls]:
    """Return the calls to time, by name: those that are free, or bind and can be met, or cannot."""
    found = {}
    for count, title in ((1, "one constraint"), (3, "three constraints")):
        calls = TimedCalls(*obstacle_course(count, _DRAWN))
        decision = calls.decisions()
        binding = decision.active.any(axis=1)
        found[f"{title}, two inputs, free"] = calls.where(~binding)
        found[f"{title}, two inputs, binding"] = calls.where(binding & decision.feasible)
    calls = TimedCalls(*flights_within_limits(0.3, _DRAWN))
    decision = calls.decisions()
    binding = decision.active.any(axis=1)
    found["QuadrotorLimits, feasible, binding"] = calls.where(binding & decision.feasible)
    calls = TimedCalls(*flights_within_limits(0.7, _DRAWN))
    found["QuadrotorLimits, infeasible"] = calls.where(~calls.decisions().feasible)
    return found


def measure() -> dict[str, float]:
    """Return the figures of each case, by name; see `COLUMNS`."""
    found = {}
    for name, calls in cases().items():
        with _counted_collections() as collections:
            on = _times(calls)
        with _without_collections():
            off = _times(calls)
        values = (*np.quantile(on, (0.5, 0.99, 0.999, 1.0)), *np.quantile(off, (0.999, 1.0)))
        figures = zip(COLUMNS, (*values, float(collections[0])), strict=True)
        found |= {f"{_PREFIX}{name}: {column}": float(value) for column, value in figures}
    return found


def rows_of(figures: Mapping[str, float]) -> dict[str, list[float]]:
    """Return the rows of a table with the `COLUMNS`, by the name of the case.

    Args:
        figures: those of a benchmark, with others.
    """
    found: dict[str, list[float]] = {}
    for name, value in figures.items():
        if name.startswith(_PREFIX):
            case = name.removeprefix(_PREFIX).partition(": ")[0]
            found.setdefault(case, []).append(value)
    return found


def is_latency(name: str) -> bool:
    """Return whether a figure is one of these, by its name."""
    return name.startswith(_PREFIX)


def _times(calls: TimedCalls) -> np.ndarray:
    """Return the processor time of single calls in microseconds, less that of the clock itself."""
    clock, decide = time.process_time_ns, calls.safety_filter.filter
    pairs = list(zip(calls.states, calls.inputs, strict=True))
    empty, taken = np.empty(_CALLS), np.empty(_CALLS)
    for x, u in pairs:
        decide(x, u)
    for i in range(_CALLS):
        begun = clock()
        empty[i] = clock() - begun
    for i in range(_CALLS):
        x, u = pairs[i % len(pairs)]
        begun = clock()
        decide(x, u)
        taken[i] = clock() - begun
    return 1e-3 * (taken - np.median(empty))


@contextmanager
def _counted_collections() -> Iterator[list[int]]:
    """Count the garbage collections meanwhile."""
    found = [0]

    def note(phase: str, _: object) -> None:
        found[0] += phase == "start"

    gc.callbacks.append(note)
    try:
        yield found
    finally:
        gc.callbacks.remove(note)


@contextmanager
def _without_collections() -> Iterator[None]:
    """Switch garbage collection off, as a control loop may."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
