"""What the episodes of one env and of a batch have had so far."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from safe_envs.envs.info import Info, safety_info


class Episode:
    """Counters of the episode of one env.

    Attributes:
        steps: control periods.
        h_min: smallest barrier value.
        cost: sum of the costs.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin an episode."""
        self.steps, self.h_min, self.cost = 0, math.inf, 0.0

    def count(self, barriers: Sequence[float], h: float) -> Info:
        """Count a state.

        Args:
            barriers: value of each barrier.
            h: the smallest of them.

        Returns:
            What an env reports of it.
        """
        violation = h < 0.0
        cost = 1.0 if violation else 0.0
        self.cost += cost
        if h < self.h_min:
            self.h_min = h
        return safety_info(violation, cost, np.array(barriers), self.h_min, self.cost)


class Episodes:
    """Counters of the episodes of a batch, and which of them end and begin.

    Attributes:
        steps: control periods, int64 (num_envs,).
        h_min: smallest barrier values, (num_envs,).
        cost: sums of the costs, (num_envs,).
        ended: the envs that are still to be reset, bool (num_envs,).
        begun: the envs whose episode began in the last step, bool (num_envs,).
        everywhere: True for each env; not to be written to.
    """

    def __init__(self, num_envs: int) -> None:
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.h_min = np.full(num_envs, np.inf)
        self.cost = np.zeros(num_envs)
        self.ended = np.zeros(num_envs, dtype=bool)
        self.begun = self._nowhere = np.zeros(num_envs, dtype=bool)
        self.everywhere = np.ones(num_envs, dtype=bool)

    def due(self) -> np.ndarray | None:
        """Return the envs that the coming step restarts (next-step autoreset); None without any."""
        due = self.ended.copy() if np.count_nonzero(self.ended) else None
        self.begun = self._nowhere if due is None else due
        return due

    def restart(self, envs: np.ndarray) -> None:
        """Begin the episodes of some envs, given by indices or by a mask."""
        self.steps[envs] = 0
        self.h_min[envs] = np.inf
        self.cost[envs] = 0.0
        self.ended[envs] = False

    def count(self, barriers: np.ndarray, h: np.ndarray, counted: np.ndarray | None = None) -> Info:
        """Count the states of a step.

        Args:
            barriers: values of the barriers, shape (num_envs, k).
            h: the smallest of each env, shape (num_envs,).
            counted: the envs whose states are new; None for all.

        Returns:
            What the envs report of them.
        """
        violation = h < 0.0
        cost = violation.astype(np.float64)
        self.cost += cost if counted is None else cost * counted
        # What was counted before cannot lower the smallest value again.
        np.minimum(self.h_min, h, out=self.h_min)
        return safety_info(violation, cost, barriers, self.h_min.copy(), self.cost.copy())

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return copies of the counters, from which `restore` goes on."""
        return {name: getattr(self, attribute).copy() for name, attribute in _COUNTERS.items()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take the counters from a snapshot."""
        for name, attribute in _COUNTERS.items():
            setattr(self, attribute, np.array(snapshot[name]))


_COUNTERS = {"steps": "steps", "h_min": "h_min", "episode_cost": "cost", "ended": "ended"}
