"""The past of an episode, as far as a picture shows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.problem.problem import SafetyProblem

_KEPT = 5000


@dataclass(frozen=True)
class DrawnDecision:
    """A filter's decision as pictures show it: components in physical units."""

    nominal: Sequence[float]
    active: bool
    feasible: bool


@dataclass(frozen=True)
class EpisodeSnapshot:
    """An instant of an episode with its past, oldest first.

    Attributes:
        states: shape (k, n), the last row is now.
        times: since the start of the episode in s, shape (k,).
        h: smallest barrier, shape (k,).
        barriers: each barrier now.
        least: minimum h since the start of the episode, states that are not kept included.
        executed: input of the last step, None at the start of an episode.
        decision: of a filter on that input, None without a filter.
        violated: where h was negative first, shape (n,); None if it never was.
        violated_at: when that was, in s.
    """

    states: np.ndarray
    times: np.ndarray
    h: np.ndarray
    barriers: Sequence[float]
    least: float
    executed: Sequence[float] | None
    decision: DrawnDecision | None
    violated: np.ndarray | None
    violated_at: float

    @property
    def state(self) -> np.ndarray:
        """The state now, shape (n,)."""
        return self.states[-1]

    @property
    def intervening(self) -> bool:
        """Whether a filter changed the action of the last step."""
        if self.decision is None or self.executed is None or not self.decision.active:
            return False
        return any(u != v for u, v in zip(self.executed, self.decision.nominal, strict=True))

    @property
    def infeasible(self) -> bool:
        """Whether no action met the conditions of the filter."""
        return self.decision is not None and not self.decision.feasible


class History:
    """Records an episode; of a very long one, at least the last 5000 states.

    Args:
        problem: with the barriers.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._barriers = BarrierFunction(
            problem.plant.states, [b.expression for b in problem.barriers], "floats"
        )
        # The columns are the time, the smallest barrier, and the states.
        self._rows = np.empty((2 * _KEPT, 2 + problem.plant.n))
        self._count = 0

    def restart(self, state: Sequence[float], time: float) -> None:
        """Forget the past: an episode begins, or continues from another state.

        Args:
            state: components of the state now.
            time: since the start of the episode in s.
        """
        self._count = 0
        self._least = math.inf
        self._violated: np.ndarray | None = None
        self._violated_at = 0.0
        self.append(state, time, None, None)

    def append(
        self,
        state: Sequence[float],
        time: float,
        executed: Sequence[float] | None,
        decision: DrawnDecision | None,
    ) -> None:
        """Add a state and what led to it.

        Args:
            state: components of the state now.
            time: since the start of the episode in s.
            executed: components of the input, in physical units.
            decision: of a filter on that input.
        """
        if self._count == len(self._rows):
            self._rows[:_KEPT] = self._rows[-_KEPT:]
            self._count = _KEPT
        barriers = self._barriers(*state)
        h = float(min(barriers))
        self._least = min(self._least, h)
        self._rows[self._count] = (time, h, *state)
        self._count += 1
        self._latest = tuple(map(float, barriers)), executed, decision
        if self._violated is None and h < 0.0:
            self._violated, self._violated_at = np.array(state, dtype=float), time

    @property
    def snapshot(self) -> EpisodeSnapshot:
        """The latest instant with its past."""
        rows = self._rows[: self._count]
        barriers, executed, decision = self._latest
        return EpisodeSnapshot(
            rows[:, 2:],
            rows[:, 0],
            rows[:, 1],
            barriers,
            self._least,
            executed,
            decision,
            self._violated,
            self._violated_at,
        )
