"""Episodes that run side by side, and the statistics of many of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.agents.evaluation.rounding import touching
from safe_envs.agents.evaluation.rows import EpisodeResults, EpisodeSummary
from safe_envs.agents.evaluation.running_sum import RunningSum
from safe_envs.agents.evaluation.statistics import rate_interval, safety_curve, share
from safe_envs.agents.evaluation.visited_states import StateWatch, VisitedStates
from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.problem.problem import SafetyProblem

_QUANTILES_OF = 65_536
"""Episodes of which quantiles are taken, the first ones: enough, as they are independent."""


class EpisodeBatch:
    """Counts of episodes that run side by side, an array entry for each.

    Those of ended and of surplus episodes stay as they are.
    """

    def __init__(self, size: int, count: int, h: np.ndarray, x: Components, inputs: int) -> None:
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

    def touching(self, problem: SafetyProblem, count: int) -> int:
        """Count the violations among the first `count` episodes that only touch h = 0.

        Args:
            problem: whose barriers they are.
            count: number of episodes.

        Returns:
            The number of such violations.
        """
        part = slice(count)
        return touching(
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
        touching: number of violations that only touch h = 0.
        visited: states that may contradict a bound.
    """

    results: EpisodeResults
    starts: np.ndarray
    touching: int
    visited: VisitedStates


class EpisodeStatistics:
    """The episodes under one filter, batch by batch.

    Args:
        problem: whose episodes they are.

    Attributes:
        visited: states that may contradict a bound.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._problem = problem
        self._parts: list[EpisodeResults] = []
        self._touching = 0
        self.visited = VisitedStates.nothing(problem)

    def add(self, batch: PlayedBatch) -> None:
        """Add a batch."""
        self._parts.append(batch.results)
        self._touching += batch.touching
        self.visited = self.visited.joined(batch.visited)

    @property
    def results(self) -> EpisodeResults:
        """The results of all episodes."""
        if len(self._parts) > 1:
            self._parts = [EpisodeResults.joined(self._parts)]
        return self._parts[0]

    def summary(self, confidence: float) -> EpisodeSummary:
        """Return statistics with intervals of a confidence; None where no step counts."""
        found, problem = self.results, self._problem
        episodes, safe = len(found.safe), int(found.safe.sum())
        low, high = rate_interval(safe, episodes, confidence)
        p05, median = np.quantile(found.min_h[:_QUANTILES_OF], (0.05, 0.5)).tolist()
        counted = int(found.counted.sum())
        efforts = found.effort[found.counted > 0]
        return EpisodeSummary(
            episodes=episodes,
            safe=safe,
            safety_rate=safe / episodes,
            ci_low=low,
            ci_high=high,
            min_h_median=median,
            min_h_p05=p05,
            violations=episodes - safe,
            touching=self._touching,
            intervention_rate=share(int(found.interventions.sum()), counted),
            infeasible_rate=share(int(found.infeasible.sum()), counted),
            effort_mean=share(RunningSum.of(efforts), len(efforts)),
            return_mean=RunningSum.of(found.returns) / episodes,
            curve=safety_curve(found.first_violation, problem.steps, problem.dt, confidence),
        )
