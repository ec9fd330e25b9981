"""The bound of a promise filter for the env's own steps."""

from __future__ import annotations

from typing import Literal

import numpy as np

from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.promise_memory import ROUNDING
from safe_envs.wrappers.value.promise_tables import (
    promise_filter_for,
    why_not_of_plant,
    why_not_of_safety,
)
from safe_envs.wrappers.value.promise_text import PromiseSettings

COMPUTED = "computed: the table is of floating-point numbers"
"""Note on such a bound."""


class PromiseBound:
    """The guarantee of a promise filter: p_0 = min(p, one step of look-ahead).

    It holds for every policy, up to the horizon, as `safe_envs.wrappers.value.promise_filter`
    proves, where the filter's table is of the plant. With a specification it is of the probability
    of meeting that, P(spec), and a bound of being safe where P(safe) >= P(spec): where no episode
    meets the specification that leaves C. Else there is none.

    Args:
        settings: of the filter.
        problem: what is simulated.
        knowledge: of the filter, "model" or "plant".

    Attributes:
        word: "computed".
        note: why it is no more than that.
        why_none: why there is none at any start; "" where there may be one.
        nowhere: what to say where it is 0 at all starts.
    """

    word: Literal["computed"] = "computed"
    note = COMPUTED
    nowhere = "no start is in the table's safe set"

    def __init__(self, settings: PromiseSettings, problem: SafetyProblem, knowledge: str) -> None:
        self._filter = promise_filter_for(problem, settings, knowledge)
        self.why_none = why_not_of_plant(problem, settings, knowledge) or why_not_of_safety(
            problem, settings
        )

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return p_0 at starts; see `HeldInputBound.at`."""
        return self._filter.start(tuple(np.ascontiguousarray(starts.T)))

    def contradiction(self, visited: VisitedStates) -> str:
        """Return by how much p_k had to be lowered, which a right table never makes necessary.

        Args:
            visited: states of the episodes; their slack is by how much p_k was lowered.
        """
        lost = float(visited.slack.max(initial=0.0))
        if lost <= ROUNDING:
            return ""
        return f"no input kept p_k in a step, which fell by {lost:.2g}: the table is wrong"


def promise_bound(of: FilteredPolicy) -> PromiseBound | None:
    """Return the bound of a promise filter; None for other filters.

    Args:
        of: a policy, which does not matter, and the filter.
    """
    if not isinstance(of.parts, PromiseSettings):
        return None
    return PromiseBound(of.parts, of.problem, of.knowledge)
