"""The decisions of a filter in Python, by which C is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import NumericalError
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.filter_qp.limits import WIDEST
from safe_envs.wrappers.safety_filter import SafetyFilter

OK, INVALID_BOUNDS, INVALID_INPUT, UNDEFINED = range(4)
"""Status codes; see `safe_envs.wrappers.export.c_header.STATUSES`."""

_PART = 4096


@dataclass
class Decisions:
    """Decisions at N states, as C gives them.

    Attributes:
        action: executed inputs, shape (N, m).
        pursued: proposed inputs, or those of a goal, shape (N, m).
        barrier: values of the barriers, shape (N, k).
        margin: of the constraints, shape (N, k).
        slack: of the constraints, shape (N, k).
        active: which constraints bind or cannot be met, shape (N, k).
        feasible: whether all can be met, shape (N,).
        cause: index of a constraint or -1, shape (N,).
        status: status codes, shape (N,).
    """

    action: np.ndarray
    pursued: np.ndarray
    barrier: np.ndarray
    margin: np.ndarray
    slack: np.ndarray
    active: np.ndarray
    feasible: np.ndarray
    cause: np.ndarray
    status: np.ndarray

    @classmethod
    def empty(cls, count: int, m: int, k: int) -> Decisions:
        """Return decisions to be filled in.

        Args:
            count: number of states.
            m: number of inputs.
            k: number of constraints.
        """
        return cls(
            action=np.full((count, m), np.nan),
            pursued=np.full((count, m), np.nan),
            barrier=np.full((count, k), np.nan),
            margin=np.full((count, k), np.nan),
            slack=np.full((count, k), np.nan),
            active=np.zeros((count, k), dtype=bool),
            feasible=np.zeros(count, dtype=bool),
            cause=np.full(count, -1),
            status=np.zeros(count, dtype=int),
        )

    def at(self, rows: Any) -> Decisions:
        """Return the decisions at some of the states."""
        return Decisions(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class Cases:
    """What a filter is asked.

    Attributes:
        states: states, shape (N, n).
        runtime: quantities that are measured at run time, shape (N, r).
        proposed: proposed inputs, shape (N, m).
        low: lower input bounds, shape (N, m).
        high: upper input bounds, shape (N, m).
    """

    states: np.ndarray
    runtime: np.ndarray
    proposed: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def rows(self) -> np.ndarray:
        """Return all in one table, in the order of the struct of C."""
        return np.hstack([self.states, self.runtime, self.proposed, self.low, self.high])

    def at(self, rows: Any) -> Cases:
        """Return some of the cases."""
        return Cases(*(getattr(self, f.name)[rows] for f in fields(self)))

    def __add__(self, other: Cases) -> Cases:
        parts = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        return Cases(*(np.vstack(pair) for pair in parts))


def decided(safety_filter: SafetyFilter, cases: Cases) -> Decisions:
    """Return what a filter decides in Python, by its arrays.

    Args:
        safety_filter: the filter.
        cases: what it is asked.
    """
    m, k = safety_filter.model.m, len(safety_filter.pairs)
    found = Decisions.empty(len(cases.states), m, k)
    bounded = cases.low <= cases.high
    finite = np.isfinite(np.hstack([cases.states, cases.runtime, cases.proposed])).all(axis=1)
    found.status[~finite] = INVALID_INPUT
    found.status[~bounded.all(axis=1)] = INVALID_BOUNDS
    qp = safety_filter.qp
    found.action[:] = resting(cases.low, cases.high)
    found.action[~bounded.all(axis=1)] = resting(np.array(qp.low), np.array(qp.high))
    found.pursued[:] = cases.proposed
    sound = np.flatnonzero(found.status == OK)
    for start in range(0, len(sound), _PART):
        _decide(safety_filter, cases, sound[start : start + _PART], found)
    return found


def _decide(safety_filter: SafetyFilter, cases: Cases, rows: np.ndarray, found: Decisions) -> None:
    """Decide for some states; where one has no answer, for the halves of them."""
    try:
        decision = _asked(safety_filter, cases.at(rows))
    except NumericalError:
        if len(rows) == 1:
            found.status[rows] = UNDEFINED
            return
        for half in np.array_split(rows, 2):
            _decide(safety_filter, cases, half, found)
        return
    found.action[rows], found.pursued[rows] = decision.action, decision.proposed
    found.barrier[rows], found.margin[rows] = decision.barrier, decision.margin
    found.slack[rows], found.active[rows] = decision.slack, decision.active
    found.feasible[rows], found.cause[rows] = decision.feasible, decision.cause


def resting(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the middle of input bounds; 0, or the bound next to it, where one is infinite.

    Args:
        low: lower bounds, any shape.
        high: upper bounds, likewise.
    """
    endless = (np.abs(low) >= WIDEST) | (np.abs(high) >= WIDEST)
    with np.errstate(invalid="ignore"):
        return np.where(endless, np.clip(0.0, low, high), 0.5 * low + 0.5 * high)


def _asked(safety_filter: SafetyFilter, cases: Cases) -> Any:
    """Return what a filter decides; input bounds are handed over where they are not its own."""
    qp = safety_filter.qp
    named = [s for s in qp.runtime if s != TIME]
    values = dict(zip(named, cases.runtime.T, strict=False))
    own = (cases.low == qp.low).all() and (cases.high == qp.high).all()
    return safety_filter.filter(
        cases.states,
        cases.proposed,
        bounds=None if own else np.stack([cases.low, cases.high], axis=-1),
        parameters=values if named else None,
        t=cases.runtime[:, -1] if TIME in qp.runtime else None,
    )


class Constraints:
    """The constraints of a filter as functions of a batch of states.

    Args:
        safety_filter: the filter.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        qp, self._m = safety_filter.qp, safety_filter.model.m
        self._terms = [term.arrays for term in qp.terms]
        self._n = safety_filter.model.n
        symbols = (*qp.symbols, *(s for term in qp.terms for s in term.symbols))
        entries = [e for c in qp.constraints for e in (*c.coefficient, c.offset)]
        self._values: Callable[..., Sequence[Any]] = compile_function(
            symbols, [qp.model.numeric(e) for e in entries], "arrays"
        )

    def at(self, cases: Cases) -> tuple[np.ndarray, np.ndarray]:
        """Return a, shape (N, k, m), and b, shape (N, k)."""
        count = len(cases.states)
        columns = tuple(np.hstack([cases.states, cases.runtime]).T.copy())
        with np.errstate(all="ignore"):
            terms = [v for term in self._terms for v in term(columns[: self._n])]
            values = stacked(self._values(*columns, *terms), count)
        values = values.reshape(count, -1, self._m + 1)
        return values[..., :-1], values[..., -1]
