"""Episodes that run side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.agents.evaluation.estimation import EstimationCounts, EstimationResults
from safe_envs.agents.evaluation.rounding import SlightViolations, slight_violations
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.visited_states import StateWatch, VisitedStates
from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.problem.problem import SafetyProblem


class EpisodeBatch:
    """Counts of episodes that run side by side, an array entry for each.

    Those of ended and of surplus episodes stay as they are.
    """

    def __init__(
        self, size: int, count: int, h: np.ndarray, x: Components, inputs: int, info: Info
    ) -> None:
        self.watch = StateWatch(x, h, inputs)
        self.alive = np.arange(size) < count
        self.safe = h > 0.0
        self.h_min = h.copy()
        self.counted = np.zeros(size, dtype=np.int64)
        self.interventions = np.zeros(size, dtype=np.int64)
        self.infeasible = np.zeros(size, dtype=np.int64)
        self.lengths = np.zeros(size, dtype=np.int64)
        self.effort = np.zeros(size)
        self.returns = np.zeros(size)
        self.estimation = EstimationCounts(size, info) if "nees" in info else None

    def add(
        self,
        h: np.ndarray,
        x: tuple[Components, Components],
        u: Components,
        reward: np.ndarray,
        info: Info,
    ) -> None:
        """Count a step; for the filter only if the episode was safe up to its beginning.

        Args:
            h: smallest barrier value of the step.
            x: the states before and after it.
            u: what was executed.
            reward: of the step.
            info: of the env.
        """
        alive, counts = self.alive, self.alive & self.safe
        if self.estimation is not None:
            self.estimation.add(info, alive)
        self.watch.add(x[0], u, info.get("slack"), counts)
        self.watch.reached(x[1], h, self.h_min, alive, counts)
        self.counted += counts
        self.lengths += alive
        if "intervention" in info:
            self.interventions += counts & info["intervention"]
            self.infeasible += counts & ~info["feasible"]
        square = u[0] * u[0]
        for component in u[1:]:
            square = square + component * component
        self.effort += np.where(counts, square, 0.0)
        self.returns += np.where(alive, reward, 0.0)
        np.copyto(self.h_min, np.minimum(self.h_min, h), where=alive)
        self.safe &= (h > 0.0) | ~alive

    def results(self, count: int) -> EpisodeResults:
        """Return the results of the first `count` episodes."""
        # The steps that count are those up to the first violation, itself included.
        part = slice(count)
        safe, counted = self.safe[part], self.counted[part]
        return EpisodeResults(
            returns=self.returns[part],
            min_h=self.h_min[part],
            first_violation=np.where(safe, -1, counted).astype(np.int32),
            length=self.lengths[part].astype(np.int32),
            interventions=self.interventions[part].astype(np.int32),
            infeasible=self.infeasible[part].astype(np.int32),
            effort=np.where(counted > 0, self.effort[part] / np.maximum(counted, 1), np.nan),
        )

    def slight(self, problem: SafetyProblem, count: int) -> SlightViolations:
        """Return which violations among the first `count` episodes are no more than rounding.

        Args:
            problem: whose barriers they are.
            count: number of episodes.

        Returns:
            Their numbers, and the worst of them.
        """
        part = slice(count)
        return slight_violations(
            problem,
            ~self.safe[part],
            self.h_min[part],
            self.watch.depth[part],
            self.watch.lowest.T[part],
        )


@dataclass(frozen=True)
class PlayedBatch:
    """A batch of episodes that was simulated.

    Attributes:
        results: of each episode that counts.
        starts: their start states, shape (E, n).
        slight: violations that are no more than rounding.
        visited: states that may contradict a bound.
        estimation: sums over the estimates of each episode; None without an estimator.
    """

    results: EpisodeResults
    starts: np.ndarray
    slight: SlightViolations
    visited: VisitedStates
    estimation: EstimationResults | None = None
