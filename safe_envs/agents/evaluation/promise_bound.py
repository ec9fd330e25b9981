"""The bound of a filter averaged over starts, whatever the filter is made of."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from safe_envs.agents.evaluation.contradiction import COMPUTED, withheld
from safe_envs.agents.evaluation.guarantees import GuaranteeAverager
from safe_envs.agents.evaluation.resolved import FilterParts
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.running_sum import RunningSum
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.evaluation.statistics import share
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.promise_memory import ROUNDING
from safe_envs.wrappers.value.promise_tables import (
    promise_filter_for,
    why_not_of_plant,
    why_not_of_safety,
)
from safe_envs.wrappers.value.promise_text import PromiseSettings


class Averager(Protocol):
    """Averages the bound of a filter over the starts of episodes."""

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        ...

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the mean of the bound, or why there is none, given states of the episodes."""
        ...


class PromiseAverager:
    """The guarantee of a promise filter: the mean of p_0 = min(p, one step of look-ahead).

    It holds for every policy, up to the horizon, as `safe_envs.wrappers.value.promise_filter`
    proves, where the filter's table is of the plant. With a specification it is of the probability
    of meeting that, P(spec), and a bound of being safe where P(safe) >= P(spec): where no episode
    meets the specification that leaves C. Else there is none.

    Args:
        settings: of the filter.
        problem: what is simulated.
        spec: what is asked for.
        why_not: why not to look for a bound at all, if so.
    """

    def __init__(
        self,
        settings: PromiseSettings,
        problem: SafetyProblem,
        spec: EvaluationSpec,
        why_not: str | None = None,
    ) -> None:
        if spec.monitoring == "continuous":
            why_not = "it is of control instants, not of the time between them"
        self._filter = promise_filter_for(problem, settings, spec.knowledge)
        self._why_none = (
            why_not
            or why_not_of_plant(problem, settings, spec.knowledge)
            or why_not_of_safety(problem, settings)
        )
        self._total, self._count = RunningSum(), 0

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        if not self._why_none:
            self._total.add(self._filter.start(tuple(np.ascontiguousarray(starts.T))))
            self._count += len(starts)

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the mean of p_0, or why there is none.

        It is withheld where p_k had to be lowered in an episode, which a right table never makes
        necessary.

        Args:
            visited: states of the episodes; their slack is by how much p_k was lowered.
        """
        mean = share(self._total.total, self._count)
        if self._why_none or not mean:
            return BoundSummary(bound_note=self._why_none or "no start is in the table's safe set")
        lost = float(visited.slack.max(initial=0.0))
        if lost > ROUNDING:
            reason = f"no input kept p_k in a step, which fell by {lost:.2g}: the table is wrong"
            return withheld(BoundSummary(), reason)
        return BoundSummary(estimated_bound=mean, bound_note=COMPUTED)


def averager_of(
    parts: FilterParts, problem: SafetyProblem, spec: EvaluationSpec, why_not: str | None
) -> Averager:
    """Return what averages the bound of a filter.

    Args:
        parts: of the filter.
        problem: what is simulated.
        spec: what is asked for.
        why_not: why not to look for a bound at all, if so.
    """
    if isinstance(parts, PromiseSettings):
        return PromiseAverager(parts, problem, spec, why_not)
    return GuaranteeAverager(parts, problem, spec.knowledge, why_not)
