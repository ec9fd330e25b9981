"""The states of episodes that may contradict a bound, or that violate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.problem.problem import SafetyProblem

_KEPT = 64


@dataclass(frozen=True)
class VisitedStates:
    """The states of episodes where a filter violated its conditions most, and where h was largest.

    Attributes:
        violating: states before a first violation of h where the filter violated its conditions
            most, one an episode, shape (E, n).
        actions: what was executed there, shape (E, m).
        slack: violation of the worst condition there, shape (E,), the largest first.
        deepest: states where the smallest h was largest, one an episode, shape (D, n).
        depth: h there, shape (D,), the largest first.
    """

    violating: np.ndarray
    actions: np.ndarray
    slack: np.ndarray
    deepest: np.ndarray
    depth: np.ndarray

    @classmethod
    def nothing(cls, problem: SafetyProblem) -> VisitedStates:
        """Return those of no episodes."""
        n, m = len(problem.states), len(problem.inputs)
        return cls(np.empty((0, n)), np.empty((0, m)), np.empty(0), np.empty((0, n)), np.empty(0))

    @classmethod
    def of(
        cls,
        violating: np.ndarray,
        actions: np.ndarray,
        slack: np.ndarray,
        deepest: np.ndarray,
        depth: np.ndarray,
    ) -> VisitedStates:
        """Return the most extreme ones of the states of episodes.

        Args:
            violating: where the slack was largest, shape (E, n).
            actions: what was executed there, shape (E, m).
            slack: violation of the worst condition there, 0 where none was, shape (E,).
            deepest: where the smallest h was largest, shape (E, n).
            depth: h there, shape (E,).
        """
        worst, highest = _first(slack), _first(depth)
        worst = worst[slack[worst] > 0.0]
        return cls(violating[worst], actions[worst], slack[worst], deepest[highest], depth[highest])

    def joined(self, other: VisitedStates) -> VisitedStates:
        """Return the most extreme states of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        violating, actions, slack, deepest, depth = (np.concatenate(pair) for pair in pairs)
        worst, highest = _first(slack), _first(depth)
        return VisitedStates(
            violating[worst], actions[worst], slack[worst], deepest[highest], depth[highest]
        )


def _first(values: np.ndarray) -> np.ndarray:
    """Where the largest values are, the largest first."""
    return np.argsort(-values, kind="stable")[:_KEPT]


class StateWatch:
    """Keeps the extreme states of each episode of a batch."""

    def __init__(self, x: Components, h: np.ndarray, inputs: int) -> None:
        self._deepest = np.stack(x)
        self.depth = h.copy()
        """Largest value of the smallest barrier in each episode up to a violation, shape (B,)."""
        self._violating, self._slack = np.zeros_like(self._deepest), np.zeros(len(h))
        self._actions = np.zeros((inputs, len(h)))
        self.lowest = np.stack(x)
        """States (n, B) where an episode that violates has its smallest h."""

    def add(
        self, before: Components, u: Components, slack: np.ndarray | None, counts: np.ndarray
    ) -> None:
        """Look at a step, from the state before it.

        Args:
            before: state before the step.
            u: what was executed.
            slack: violation of the worst condition, shape (B,); None without a filter.
            counts: the episodes without a violation so far.
        """
        if slack is None or not slack.any():
            return
        worse = counts & (slack > self._slack)
        if not worse.any():
            return
        np.copyto(self._slack, slack, where=worse)
        _keep(self._violating, before, worse)
        _keep(self._actions, u, worse)

    def reached(
        self, x: Components, h: np.ndarray, h_min: np.ndarray, alive: np.ndarray, counts: np.ndarray
    ) -> None:
        """Look at the state that a step led to.

        Args:
            x: the state.
            h: its smallest barrier.
            h_min: the smallest of the episode before it.
            alive: the episodes that go on.
            counts: those of them without a violation before.
        """
        higher = counts & (h > self.depth)
        np.copyto(self.depth, h, where=higher)
        _keep(self._deepest, x, higher)
        lower = alive & (h <= 0.0) & (h < h_min)
        if lower.any():
            _keep(self.lowest, x, lower)

    def visited(self, count: int) -> VisitedStates:
        """Return the extreme states of the first `count` episodes."""
        part = slice(count)
        return VisitedStates.of(
            self._violating.T[part],
            self._actions.T[part],
            self._slack[part],
            self._deepest.T[part],
            self.depth[part],
        )


def _keep(kept: np.ndarray, values: Any, where: np.ndarray) -> None:
    for row, value in zip(kept, values, strict=True):
        np.copyto(row, value, where=where)
