"""The decisions of a promise filter in Python, by which C is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from safe_envs.dynamics.integrators import Integrator
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_memory import PromiseMemory
from safe_envs.wrappers.value.starts import draw_starts

_PART = 4096
_BEYOND = 1.5
_DEFAULT = (-2.0, 2.0)


@dataclass(frozen=True)
class PromiseCases:
    """What a promise filter is asked.

    Attributes:
        states: states, shape (N, n).
        proposed: proposed inputs, shape (N, m).
        instants: control periods that have passed, int (N,); 0 for the start of an episode.
        levels: p_k of the decision before, shape (N,).
    """

    states: np.ndarray
    proposed: np.ndarray
    instants: np.ndarray
    levels: np.ndarray

    def at(self, rows: Any) -> PromiseCases:
        """Return some of the cases."""
        return PromiseCases(*(getattr(self, f.name)[rows] for f in fields(self)))

    def moved(self, step: np.ndarray) -> PromiseCases:
        """Return the cases with other states.

        Args:
            step: what is added, shape (N, n).
        """
        return PromiseCases(self.states + step, self.proposed, self.instants, self.levels)


@dataclass(frozen=True)
class PromiseDecisions:
    """Decisions at N states.

    Attributes:
        action: executed inputs, shape (N, m).
        level: p_k, shape (N,).
        expected: q_k of the action, shape (N,).
        replaced: whether it is not the proposed input, shape (N,).
    """

    action: np.ndarray
    level: np.ndarray
    expected: np.ndarray
    replaced: np.ndarray


def random_cases(
    promise_filter: PromiseFilter,
    region: Sequence[tuple[float, float]],
    count: int,
    rng: np.random.Generator,
) -> PromiseCases:
    """Draw cases uniformly; a proposed input may lie beyond its bounds.

    Known states are what they are to be, but for one case in fifty.

    Args:
        promise_filter: the filter.
        region: from which states are drawn; empty for (-2, 2) of each.
        count: how many.
        rng: source of random numbers.

    Returns:
        The cases.
    """
    problem, steps = promise_filter.problem, promise_filter.look_ahead.steps
    ends = np.array(list(region) or [_DEFAULT] * problem.plant.n, dtype=float)
    low, high = np.array(problem.box, dtype=float).T
    instants = rng.integers(0, steps + 2, count)
    instants[rng.random(count) < 0.1] = 0
    states = rng.uniform(ends[:, 0], ends[:, 1], (count, len(ends)))
    kept = rng.random(count) > 0.02
    for i, values in _assumed(promise_filter).items():
        states[kept, i] = values[np.minimum(instants[kept], steps)]
    half = 0.5 * (high - low)
    proposed = 0.5 * (low + high) + _BEYOND * half * rng.uniform(-1.0, 1.0, (count, len(low)))
    # Promises near 1, where they bind, and some that nothing is left of.
    promises = 1.0 - rng.random(count) ** 3
    promises[rng.random(count) < 0.05] = 0.0
    return PromiseCases(states, proposed, instants, promises)


def _assumed(promise_filter: PromiseFilter) -> Mapping[int, np.ndarray]:
    ahead = promise_filter.look_ahead
    return ahead.parts.reduced.assumed if isinstance(ahead, LookAhead) else {}


def decided(promise_filter: PromiseFilter, cases: PromiseCases) -> PromiseDecisions:
    """Return what the filter decides in Python, one step at a time.

    Args:
        promise_filter: the filter.
        cases: what it is asked.
    """
    count = len(cases.states)
    parts = [
        _decided(promise_filter, cases.at(slice(first, first + _PART)))
        for first in range(0, count, _PART)
    ]
    names = [f.name for f in fields(PromiseDecisions)]
    return PromiseDecisions(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _decided(promise_filter: PromiseFilter, cases: PromiseCases) -> PromiseDecisions:
    count = len(cases.states)
    memory, x = PromiseMemory(promise_filter, count), tuple(cases.states.T.copy())
    starts = cases.instants == 0
    memory.restore(
        {
            "instant": np.maximum(cases.instants - 1, 0),
            "promise": cases.levels,
            "promise_ended": np.zeros(count, dtype=bool),
            "promise_automaton": np.zeros(count, dtype=int),
        }
    )
    memory.advance(x, False)
    if starts.any():
        memory.begin(x, starts)
    return decision_of(memory, x, clipped(promise_filter, cases.proposed))


def clipped(promise_filter: PromiseFilter, proposed: np.ndarray) -> np.ndarray:
    """Return proposed inputs inside their bounds, as a filter is given them.

    Args:
        promise_filter: the filter.
        proposed: shape (N, m).
    """
    low, high = np.array(promise_filter.problem.box, dtype=float).T
    return np.clip(proposed, low, high)


def decision_of(
    memory: PromiseMemory, x: tuple[np.ndarray, ...], proposed: np.ndarray
) -> PromiseDecisions:
    """Return what a memory decides at states.

    Args:
        memory: of episodes.
        x: components of the states.
        proposed: inputs within their bounds, shape (N, m).
    """
    found = memory.decide_arrays(x, tuple(proposed.T.copy()))
    margin = np.array(found.margin[0])
    promise = memory.levels
    return PromiseDecisions(
        np.array(found.action).T.reshape(len(x[0]), -1),
        promise.copy(),
        margin + promise,
        np.array(found.active[0]),
    )


class PromiseEpisodes:
    """Episodes of the plant under the filter in Python, with proposed inputs that are noise.

    Args:
        promise_filter: the filter.
        count: how many at once.
        seed: of starts, noise and inputs.

    Attributes:
        x: components of the states at hand.
    """

    def __init__(self, promise_filter: PromiseFilter, count: int, seed: int) -> None:
        problem = promise_filter.problem
        self._filter, self._rng = promise_filter, np.random.default_rng(seed)
        # There is one start alone where all are equal.
        starts = draw_starts(problem, count, seed)
        self.x = tuple(np.resize(np.asarray(c, dtype=float), count) for c in starts)
        self._memory = PromiseMemory(promise_filter, count)
        self._memory.begin(self.x)
        self._integrator = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")

    def propose(self) -> np.ndarray:
        """Return proposed inputs, shape (N, m), that push to one side for a while."""
        low, high = np.array(self._filter.problem.box, dtype=float).T
        size = len(self.x[0])
        pushed = self._rng.random((size, len(low))) ** 0.2
        side = np.arange(size)[:, None] % 2
        return np.where(side, low + (high - low) * pushed, high - (high - low) * pushed)

    def decide(self, proposed: np.ndarray) -> PromiseDecisions:
        """Return what the filter decides at the states at hand.

        Args:
            proposed: inputs within their bounds, shape (N, m).
        """
        return decision_of(self._memory, self.x, proposed)

    def move(self, action: np.ndarray) -> None:
        """Go on under inputs, shape (N, m)."""
        draws = self._rng.standard_normal((self._integrator.channels, len(self.x[0])))
        with np.errstate(all="ignore"):
            moved = self._integrator.step(self.x, tuple(action.T), draws)
        self.x = tuple(np.broadcast_to(c, self.x[0].shape).astype(float) for c in moved)
        self._memory.advance(self.x, False)
