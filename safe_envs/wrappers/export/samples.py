"""States and inputs at which an exported filter is tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.wrappers.export.reference import Cases, Constraints, Decisions, decided
from safe_envs.wrappers.filter_qp.limits import WIDEST
from safe_envs.wrappers.safety_filter import SafetyFilter

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
    """Return cases with an entry of each state, or of each proposed input, that is not finite.

    Args:
        cases: any cases.
        rng: source of random numbers.
    """
    count, n = cases.states.shape
    bad = np.array([np.nan, np.inf, -np.inf])[np.arange(count) % 3]
    states, proposed = cases.states.copy(), cases.proposed.copy()
    of_state = rng.random(count) < 0.7
    rows = np.flatnonzero(of_state)
    states[rows, rng.integers(0, n, len(rows))] = bad[rows]
    rows = np.flatnonzero(~of_state)
    proposed[rows, rng.integers(0, proposed.shape[1], len(rows))] = bad[rows]
    return Cases(states, cases.runtime, proposed, cases.low, cases.high)


def golden_cases(
    safety_filter: SafetyFilter, region: Region, *, is_single: bool
) -> tuple[Cases, Decisions]:
    """Return a few cases of every sort, and what Python decides there.

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
    chosen = cases.at(kept) + flat + spoilt(cases.at(slice(0, 6)), rng)
    crossed = cases.at(slice(0, 1))
    chosen += Cases(
        crossed.states, crossed.runtime, crossed.proposed, crossed.high, crossed.low - 1.0
    )
    return chosen, decided(safety_filter, chosen)


def rounded(cases: Cases) -> Cases:
    """Return cases whose numbers are those of single precision."""
    parts = (cases.states, cases.runtime, cases.proposed, cases.low, cases.high)
    with np.errstate(over="ignore", invalid="ignore"):
        return Cases(*(part.astype(np.float32).astype(float) for part in parts))
