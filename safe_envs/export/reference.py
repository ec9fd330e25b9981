"""The decisions of a filter in Python, by which C is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import NumericalError
from safe_envs.export.program import INVALID_BOUNDS, INVALID_INPUT, OK, UNDEFINED
from safe_envs.filters.arguments import WIDEST
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.signals import TIME

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

    def groups(self, row: int) -> list[np.ndarray]:
        """Return the numbers of one case by the member of the struct of C; none is empty."""
        parts = (getattr(self, f.name)[row] for f in fields(self))
        return [part for part in parts if part.size]

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
        input_bounds=None if own else np.stack([cases.low, cases.high], axis=-1),
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


_BEYOND = 1.5
"""How far proposed inputs go, in half widths of the input bounds from their middle."""
_ORDINARY = 10.0
_TRIED = 1500
_OF_A_SORT = 3

Region = Sequence[tuple[float, float]]
"""(low, high) of each state, and of each quantity that is measured at run time."""


def random_cases(
    safety_filter: SafetyFilter, region: Region, count: int, rng: np.random.Generator
) -> Cases:
    """Draw cases uniformly; a proposed input may lie beyond its bounds.

    Args:
        safety_filter: the filter.
        region: from which states and measured quantities are drawn.
        count: how many.
        rng: source of random numbers.

    Returns:
        The cases, with the filter's own input bounds.
    """
    ends, qp = np.array(region, dtype=float), safety_filter.qp
    low, high = np.array(qp.low), np.array(qp.high)
    measured = rng.uniform(ends[:, 0], ends[:, 1], (count, len(ends)))
    # Where there are no bounds, what is proposed is of ordinary size.
    near = np.where(np.abs(low) < WIDEST, low, -_ORDINARY)
    far = np.where(np.abs(high) < WIDEST, high, _ORDINARY)
    half = 0.5 * np.abs(far - near)
    proposed = near + half + _BEYOND * half * rng.uniform(-1.0, 1.0, (count, len(low)))
    n = safety_filter.model.n
    shape = (count, len(low))
    bounds = np.broadcast_to(low, shape).copy(), np.broadcast_to(high, shape).copy()
    return Cases(measured[:, :n], measured[:, n:], proposed, *bounds)


def with_other_bounds(cases: Cases, rng: np.random.Generator) -> Cases:
    """Return cases with narrower input bounds; some inputs are held.

    Args:
        cases: with finite input bounds, or none.
        rng: source of random numbers.
    """
    low, high = np.maximum(cases.low, -_ORDINARY * 1e5), np.minimum(cases.high, _ORDINARY * 1e5)
    parts = np.sort(rng.random((2, *low.shape)), axis=0)
    held = rng.random(low.shape) < 0.05
    parts[1][held] = parts[0][held]
    low, high = (low + part * (high - low) for part in parts)
    return Cases(cases.states, cases.runtime, cases.proposed, low, high)


def without_effect(safety_filter: SafetyFilter, region: Region, rng: np.random.Generator) -> Cases:
    """Return cases where a constraint says nothing of the input, as far as any is found.

    Args:
        safety_filter: the filter.
        region: from which states and measured quantities are drawn.
        rng: source of random numbers.
    """
    cases = random_cases(safety_filter, region, _TRIED, rng)
    # Zeros, and states that agree, are where products and differences vanish exactly.
    cases.states[rng.random(cases.states.shape) < 0.6] = 0.0
    a, b = Constraints(safety_filter).at(cases)
    flat = (a == 0.0).all(axis=2).any(axis=1) & np.isfinite(b).all(axis=1)
    return cases.at(np.flatnonzero(flat))


def spoilt(cases: Cases, rng: np.random.Generator) -> Cases:
    """Return cases with an entry of each state or proposed input that is not finite, or far away.

    Args:
        cases: any cases.
        rng: source of random numbers.
    """
    count, n = cases.states.shape
    bad = np.resize([np.nan, np.inf, -np.inf, 1e3], count)
    states, proposed = cases.states.copy(), cases.proposed.copy()
    of_state = rng.random(count) < 0.7
    rows = np.flatnonzero(of_state)
    states[rows, rng.integers(0, n, len(rows))] = bad[rows]
    rows = np.flatnonzero(~of_state)
    proposed[rows, rng.integers(0, proposed.shape[1], len(rows))] = bad[rows]
    return Cases(states, cases.runtime, proposed, cases.low, cases.high)


def at_ends(cases: Cases, region: Region, rng: np.random.Generator) -> Cases:
    """Return cases with most entries of states at ends of the region, and inputs at their bounds.

    Args:
        cases: any cases.
        region: from which states and measured quantities are drawn.
        rng: source of random numbers.
    """
    states, proposed = cases.states.copy(), cases.proposed.copy()
    ends = np.array(region, dtype=float)[: states.shape[1]]
    for values, low, high in ((states, *ends.T), (proposed, cases.low, cases.high)):
        side = rng.random(values.shape)
        chosen = np.where(side < 0.4, low, np.where(side > 0.6, high, values))
        values[:] = np.where(np.abs(chosen) < WIDEST, chosen, values)
    return Cases(states, cases.runtime, proposed, cases.low, cases.high)


def golden_cases(
    safety_filter: SafetyFilter, region: Region, *, is_single: bool
) -> list[tuple[list[np.ndarray], Decisions]]:
    """Return a few cases of every sort, as groups of numbers, and what Python decides there.

    Sorts are told by flags, by the constraints that are active, and by inputs at their bounds.
    Where a small change of the state changes a flag, rounding could too: such cases are left out.

    Args:
        safety_filter: the filter.
        region: from which states and measured quantities are drawn.
        is_single: whether the filter computes in single precision.
    """
    rng = np.random.default_rng(0)
    cases = random_cases(safety_filter, region, _TRIED, rng)
    flat = without_effect(safety_filter, region, rng)
    flat = flat.at(slice(0, _OF_A_SORT))
    cases = rounded(cases) if is_single else cases
    found = decided(safety_filter, cases)
    step, allowed = (1e-5, 3e-4) if is_single else (1e-9, 1e-7)
    moved = Cases(
        cases.states + step * np.abs(cases.states) * rng.choice([-1.0, 1.0], cases.states.shape),
        *(cases.runtime, cases.proposed, cases.low, cases.high),
    )
    other = decided(safety_filter, moved)
    width = cases.high - cases.low
    steady = (np.abs(found.action - other.action) <= allowed * width).all(axis=1)
    steady &= (found.active == other.active).all(axis=1) & (found.feasible == other.feasible)
    steady &= (found.status == other.status) & (found.cause == other.cause)
    at_bound = (found.action == cases.low) * 2 + (found.action == cases.high)
    sorts: dict[tuple[object, ...], int] = {}
    kept: list[int] = []
    for i in np.flatnonzero(steady):
        sort = (found.status[i], found.feasible[i], *found.active[i], *at_bound[i])
        sorts[sort] = sorts.get(sort, 0) + 1
        if sorts[sort] <= _OF_A_SORT and len(sorts) <= 40:
            kept.append(int(i))
    flat = rounded(flat) if is_single else flat
    chosen = cases.at(kept) + flat + spoilt(cases.at(slice(0, 3)), rng)
    crossed = cases.at(slice(0, 1))
    low, high = crossed.high, crossed.low - 1.0
    chosen += Cases(crossed.states, crossed.runtime, crossed.proposed, low, high)
    found = decided(safety_filter, chosen)
    return [(chosen.groups(i), found.at(i)) for i in range(len(found.status))]


def rounded(cases: Cases) -> Cases:
    """Return cases whose numbers are those of single precision."""
    parts = (cases.states, cases.runtime, cases.proposed, cases.low, cases.high)
    with np.errstate(over="ignore", invalid="ignore"):
        return Cases(*(part.astype(np.float32).astype(float) for part in parts))
