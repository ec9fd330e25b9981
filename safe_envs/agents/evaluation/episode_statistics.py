"""Statistics of the episodes under one filter, batch by batch."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.episode_batch import PlayedBatch
from safe_envs.agents.evaluation.estimation import EstimationResults
from safe_envs.agents.evaluation.rounding import SlightViolations
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.running_sum import RunningSum
from safe_envs.agents.evaluation.safe_flags import SafeFlags
from safe_envs.agents.evaluation.safety_curve import CurveCounts
from safe_envs.agents.evaluation.statistics import rate_interval, share
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem

_QUANTILES_OF = 65_536
"""Episodes of which quantiles are taken, the first ones: enough, as they are independent."""


class EpisodeStatistics:
    """The episodes under one filter, batch by batch.

    They need one bit for each episode, and are the same, to the last bit, however the episodes are
    divided into batches.

    Args:
        problem: whose episodes they are.

    Attributes:
        safe: which episodes are safe.
        steps: control periods of all episodes.
        visited: states that may contradict a bound.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._problem = problem
        self.safe = SafeFlags()
        self.steps = 0
        self.visited = VisitedStates.nothing(problem)
        self._slight = SlightViolations(0, 0, 0.0)
        self._curve = CurveCounts(problem.steps)
        self._min_h = np.empty(_QUANTILES_OF)
        self._safe = self._counted = self._interventions = self._infeasible = 0
        self._returns, self._efforts, self._with_effort = RunningSum(), RunningSum(), 0
        self._estimation: list[EstimationResults] = []

    def add(self, batch: PlayedBatch) -> None:
        """Add a batch."""
        found = batch.results
        counted, begun = found.counted, len(self.safe)
        moved = counted > 0
        if begun < _QUANTILES_OF:
            part = self._min_h[begun : begun + len(counted)]
            part[:] = found.min_h[: len(part)]
        self.safe.add(found.safe)
        self.steps += int(found.length.sum())
        self.visited = self.visited.joined(batch.visited)
        self._slight = self._slight.joined(batch.slight)
        self._curve.add(found.first_violation)
        self._safe += int(np.count_nonzero(found.safe))
        self._counted += int(counted.sum())
        self._interventions += int(found.interventions.sum())
        self._infeasible += int(found.infeasible.sum())
        self._returns.add(found.returns)
        self._efforts.add(found.effort[moved])
        self._with_effort += int(np.count_nonzero(moved))
        if batch.estimation is not None:
            self._estimation.append(batch.estimation)

    @property
    def estimation(self) -> EstimationResults | None:
        """Sums over the estimates of each episode; None without an estimator."""
        return EstimationResults.joined(self._estimation) if self._estimation else None

    def summary(self, confidence: float) -> EpisodeSummary:
        """Return statistics with intervals of a confidence; None where no step counts."""
        episodes, safe = len(self.safe), self._safe
        low, high = rate_interval(safe, episodes, confidence)
        h = self._min_h[:episodes]
        # Between -inf and a number there is nothing.
        method = "linear" if np.isfinite(h).all() else "lower"
        p05, median = np.quantile(h, (0.05, 0.5), method=method).tolist()
        return EpisodeSummary(
            episodes=episodes,
            safe=safe,
            safety_rate=safe / episodes,
            ci_low=low,
            ci_high=high,
            min_h_median=median,
            min_h_p05=p05,
            violations=episodes - safe,
            touching=self._slight.touching,
            below_rounding=self._slight.below,
            worst_below_rounding=self._slight.worst,
            intervention_rate=share(self._interventions, self._counted),
            infeasible_rate=share(self._infeasible, self._counted),
            effort_mean=share(self._efforts.total, self._with_effort),
            return_mean=self._returns.total / episodes,
            curve=self._curve.curve(self._problem.dt, confidence),
        )
