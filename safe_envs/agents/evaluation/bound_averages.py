"""The bounds of a filter, for the env's own steps and for continuous control, over starts."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.guarantees import GuaranteeAverager
from safe_envs.agents.evaluation.held_input import HeldAverager, held_averager_of
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.wrappers.conditions.filter_settings import FilterSettings

OF_TRUE_STATES = "it is of filters at the true state"
"""Why conditions at an estimate have no bound for continuous control."""


class BoundAverager:
    """Averages both bounds of a filter over the starts of episodes.

    Args:
        of: the policy and the filter.
        monitoring: where h is checked, "discrete" or "continuous".
        why_not: why not to look for bounds at all, if so.
    """

    def __init__(
        self, of: FilteredPolicy, monitoring: str = "discrete", why_not: str | None = None
    ) -> None:
        self._held: HeldAverager = held_averager_of(of, monitoring, why_not)
        self._continuous: GuaranteeAverager | str
        if isinstance(of.parts, FilterSettings):
            self._continuous = of.parts.only_of_steps
        elif any(c.belief is not None or c.measurement_error for c in of.parts):
            self._continuous = OF_TRUE_STATES
        else:
            self._continuous = GuaranteeAverager(of.parts, of.problem, of.knowledge, why_not)

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        self._held.add(starts)
        if not isinstance(self._continuous, str):
            self._continuous.add(starts)

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the means of the bounds, or why there are none.

        Args:
            visited: states of the episodes; bounds that they contradict are withheld.
        """
        found = (
            BoundSummary(continuous_note=self._continuous)
            if isinstance(self._continuous, str)
            else self._continuous.summary(visited)
        )
        return self._held.put_in(found, visited)
