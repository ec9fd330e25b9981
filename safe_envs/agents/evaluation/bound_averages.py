"""The bounds of a filter, for the env's own steps and for continuous control, over starts."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.guarantees import GuaranteeAverager
from safe_envs.agents.evaluation.held_bound import HeldAverager, held_averager_of
from safe_envs.agents.evaluation.resolved import FilterParts
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.promise_text import PromiseSettings

STEPS_ONLY = "its table is of the env's own steps"
"""Why a promise filter has no bound for continuous control."""


class BoundAverager:
    """Averages both bounds of a filter over the starts of episodes.

    Args:
        parts: of the filter.
        problem: what is simulated.
        spec: what is asked for.
        why_not: why not to look for bounds at all, if so.
    """

    def __init__(
        self,
        parts: FilterParts,
        problem: SafetyProblem,
        spec: EvaluationSpec,
        why_not: str | None = None,
    ) -> None:
        self._held: HeldAverager = held_averager_of(parts, problem, spec, why_not)
        self._continuous: GuaranteeAverager | None = None
        if not isinstance(parts, PromiseSettings):
            self._continuous = GuaranteeAverager(parts, problem, spec.knowledge, why_not)

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        self._held.add(starts)
        if self._continuous is not None:
            self._continuous.add(starts)

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the means of the bounds, or why there are none.

        Args:
            visited: states of the episodes; bounds that they contradict are withheld.
        """
        found = (
            BoundSummary(continuous_note=STEPS_ONLY)
            if self._continuous is None
            else self._continuous.summary(visited)
        )
        return self._held.put_in(found, visited)
