"""QPs of one to four inputs, ordinary, degenerate and of all scales, and the ways to solve them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE
from safe_envs.engine.decide import PLAIN, answer_length, decide, scratch_lengths, shape_of
from safe_envs.engine.program import decider
from safe_envs.filters.decisions import CallFrame
from safe_envs.wrappers import AffineConstraint, Condition, SafetyFilter
from tests.oracles.programs import decision_of

KINDS = (
    "plain",
    "flat",
    "integers",
    "parallel",
    "touching",
    "sides",
    "sizes",
    "far",
    "weights",
    "priorities",
    "endless",
    "open",
)


class QPs(NamedTuple):
    """a (N, k, m), b (N, k), v, low, high and w (N, m), and priority (k,)."""

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    w: np.ndarray
    priority: np.ndarray

    def states(self, which: Any) -> QPs:
        """The QPs of some states."""
        return QPs(*[part[which] for part in self[:6]], self.priority)

    @classmethod
    def one(cls, a, b, v, low=-1.0, high=1.0, w=1.0, priority=1.0) -> QPs:
        """A single QP; numbers stand for all inputs or constraints."""
        v, b = np.array(v, dtype=float), np.array(b, dtype=float)
        ends = [np.broadcast_to(np.array(part, dtype=float), v.shape) for part in (low, high, w)]
        a = np.array(a, dtype=float).reshape(1, len(b), len(v))
        priority = np.broadcast_to(np.array(priority, dtype=float), b.shape)
        return cls(a, b[None], v[None], *[end[None] for end in ends], priority)

    def values(self, u: np.ndarray) -> np.ndarray:
        """The constraints at inputs, (N, k)."""
        return (self.a @ u[:, :, None])[:, :, 0] + self.b

    def terms(self, u: np.ndarray) -> np.ndarray:
        """The sizes of their terms, (N, k)."""
        return (np.abs(self.a) @ np.abs(u)[:, :, None])[:, :, 0] + np.abs(self.b)

    def clipped(self) -> np.ndarray:
        """The proposals within their bounds."""
        return np.clip(self.v, self.low, self.high)

    def reach(self, u: np.ndarray) -> np.ndarray:
        """What errors are relative to: half-widths of the bounds, or where these are wide the
        way from the proposal, (N, m)."""
        way = (np.sqrt(self.w) * np.abs(u - self.v)).max(axis=1, keepdims=True) / np.sqrt(self.w)
        reach = np.minimum(0.5 * self.high - 0.5 * self.low, way + np.abs(u))
        return np.where(reach > 0.0, reach, 1.0)


class Answers(NamedTuple):
    """u (N, m), margin and active (N, k), feasible (N,)."""

    u: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: np.ndarray


def random_qps(rng, size, k, m, kind, shift) -> QPs:
    """QPs, of which a shift above 0 makes most contradictory."""
    a, b = rng.normal(size=(size, k, m)), rng.normal(size=(size, k)) * 0.7
    v, w = rng.normal(size=(size, m)) * 2, rng.uniform(0.5, 2.0, (size, m))
    low, high = -rng.uniform(0.5, 1.5, (size, m)), rng.uniform(0.5, 2.0, (size, m))
    priority = 10.0 ** rng.uniform(-1, 1, k)
    if kind == "flat":  # inputs that no row mentions, and rows that mention no input
        a[rng.random(a.shape) < 0.5] = 0.0
    if kind == "integers":  # duplicates, crossings and corners that coincide exactly
        a, b = rng.integers(-2, 3, a.shape) * 1.0, rng.integers(-4, 3, b.shape) * 1.0
        v, w = rng.integers(-3, 4, v.shape) * 1.0, np.ones((size, m))
        low, high = -np.ones((size, m)), np.ones((size, m))
    if kind == "parallel":  # duplicates and opposite rows
        for i in range(1, k):
            chosen, factor = rng.random(size) < 0.6, rng.choice([-1.0, 1.0, 2.0, -0.5], size)
            a[chosen, i] = a[chosen, 0] * factor[chosen, None]
            meeting = chosen & (rng.random(size) < 0.3)
            b[meeting, i] = (b[:, 0] * factor)[meeting]
    if kind == "sides":  # sides that differ by up to 1e6, in the units of the rows or not
        half = 10.0 ** rng.choice([0, 3, 6], (size, m))
        low, high, v = low * half, high * half, v * half
        a[::2] /= half[::2, None, :]
    if kind == "sizes":
        scale = 10.0 ** rng.uniform(-3, 3, (size, k))
        a, b = a * scale[:, :, None], b * scale
    if kind == "far":
        v *= 10.0 ** rng.uniform(0, 8, (size, 1))
    if kind == "weights":
        w = 10.0 ** rng.uniform(-4, 4, (size, m))
    if kind == "priorities":
        priority = 10.0 ** rng.uniform(-4, 4, k)
    if kind == "endless":
        high = 10.0 ** rng.choice([6, 30], (size, m))
        low = -high
    if kind == "open":  # one-sided bounds, or none
        low[rng.random(low.shape) < 0.4] = -np.inf
        high[rng.random(high.shape) < 0.4] = np.inf
    b = b - shift * np.abs(a).max(axis=2) * rng.random((size, k))
    if kind == "touching":  # rows exactly through one point, at times a corner, or beside it
        a, point = rng.integers(-3, 4, a.shape) * 1.0, rng.integers(-4, 5, v.shape) / 4.0
        low, high = -np.ones((size, m)), np.ones((size, m))
        b = -(a @ point[:, :, None])[:, :, 0] - shift * (rng.random((size, k)) < 0.3)
    return QPs(a, b, v, low, high, w, priority)


def one_by_one(solve: Callable[[QPs, int], Any]) -> Callable[[QPs], Answers]:
    """One state after the other."""

    def way(qps: QPs) -> Answers:
        found = [solve(qps, i) for i in range(len(qps.b))]
        return Answers(*[np.array(part) for part in zip(*found, strict=True)])

    return way


def numbers_of(qps: QPs, i: int) -> tuple[list[float], ...]:
    """The shape, weights, values, proposal and bounds of a QP, as the kernel takes them."""
    k, m = qps.a.shape[1:]
    shape = shape_of((k, m, 0), PLAIN, 0.0, 1.0, [[0] * 5 + [i] for i in range(k)])
    values = [*qps.a[i].ravel().tolist(), *qps.b[i].tolist()]
    weights = [*qps.w[i].tolist(), *qps.priority.tolist()]
    return shape, weights, values, qps.v[i].tolist(), [*qps.low[i].tolist(), *qps.high[i].tolist()]


def answer(qps: QPs, code: int, out: Sequence[float]) -> Any:
    """Inputs, margins, active constraints and whether all are met."""
    k, m = qps.a.shape[1:]
    return out[:m], out[m : m + k], [x > 0.0 for x in out[m + k : m + 2 * k]], code & 1 == 1


@one_by_one
def by_batch(qps: QPs, i: int) -> Any:
    """In machine code."""
    shape, weights, values, u, ends = numbers_of(qps, i)
    run = decider()
    assert run is not None
    return answer(qps, *CallFrame(shape, weights, ends, len(values)).decide(run, values, u, None))


@one_by_one
def by_floats(qps: QPs, i: int) -> Any:
    """Interpreted, on lists."""
    shape, weights, values, u, ends = numbers_of(qps, i)
    k, m = qps.a.shape[1:]
    out = [math.nan] * answer_length(k, m, 0)
    scratch = [[math.nan] * length for length in scratch_lengths(shape)]
    return answer(qps, decide(shape, weights, values, u, ends, out, scratch), out)


@dataclass(frozen=True)
class Row(Condition):
    """A constraint whose coefficients, offset and uncertainty are states."""

    row: tuple[sp.Symbol, ...] = ()
    form: tuple[sp.Symbol, ...] | None = None

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        return AffineConstraint(
            self.row[:-1], self.row[-1], (barrier.expression,), uncertainty=self.form
        )


@functools.cache
def system_of(k: int, m: int, more: int = 0) -> tuple[ControlAffineSDE, list[tuple[Barrier, Row]]]:
    """A system whose states are the numbers of k constraints, each with `more` of a form."""
    x, u = sp.symbols(f"x:{k * (m + 1 + more)}", real=True), sp.symbols(f"u:{m}", real=True)
    system = ControlAffineSDE(x, u, [0] * len(x), [[0] * m for _ in x])
    rows = [x[i * (m + 1 + more) :][: m + 1 + more] for i in range(k)]
    return system, [
        (Barrier(row[m], f"h_{i}"), Row(row=row[: m + 1], form=row[m + 1 :] or None))
        for i, row in enumerate(rows)
    ]


def filter_of(qps: QPs, i: int = 0) -> SafetyFilter:
    """The filter with the bounds and weights of a QP, of states that `state_of` gives."""
    system, pairs = system_of(*qps.a.shape[1:])
    bounds = np.stack([qps.low[i], qps.high[i]], axis=1)
    return SafetyFilter(
        system, pairs, input_bounds=bounds, weights=qps.w[i], priorities=qps.priority
    )


def state_of(qps: QPs, i: int = 0) -> np.ndarray:
    """The coefficients and offsets of a QP as the state of its filter."""
    return np.column_stack([qps.a[i], qps.b[i]]).ravel()


@one_by_one
def by_filter(qps: QPs, i: int) -> Any:
    """The filter."""
    return filter_of(qps, i).filter(state_of(qps, i), qps.v[i])[:4]


@one_by_one
def by_program(qps: QPs, i: int) -> Any:
    """The filter as a function of a compiled program, executed as Python."""
    found = decision_of(filter_of(qps, i))(state_of(qps, i), qps.v[i])
    margin = qps.states([i]).values(found.action[None])[0]
    return found.action, margin, np.full(margin.shape, found.active), found.feasible


WAYS = {
    "batch": by_batch,
    "floats": by_floats,
    "filter": by_filter,
    "program": by_program,
}
