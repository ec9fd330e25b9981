"""The bound of a backup filter for the env's own steps."""

from __future__ import annotations

from typing import Literal

import numpy as np

from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.backup import BackupFilter, BackupSettings

COMPUTED = "1 where a backup law keeps the start safe; plans are of floating-point numbers"
"""Note on such a bound."""

STATED = "; that {} keep the terminal sets that are stated is assumed, but for samples"
"""What is added to it where terminal sets were not derived."""


class BackupBound:
    """The guarantee of a backup filter: no violation from where a law keeps the system safe.

    It holds for every policy and horizon, as `safe_envs.wrappers.backup.backup_filter` proves, for
    a plant without noise that is the filter's system.

    Args:
        settings: of the filter.
        problem: what is simulated.
        knowledge: of the filter, "model" or "plant".

    Attributes:
        word: "computed".
        note: what it is of.
        why_none: why there is none at any start; "" where there may be one.
        nowhere: what to say where it is 0 at all starts.
    """

    word: Literal["computed"] = "computed"
    nowhere = "no backup law keeps any of the starts safe"

    def __init__(self, settings: BackupSettings, problem: SafetyProblem, knowledge: str) -> None:
        self._filter = BackupFilter.for_problem(problem, settings, knowledge)
        stated = ", ".join(self._filter.stated)
        self.note = COMPUTED + (STATED.format(stated) if stated else "")
        self.why_none = self._filter.why_not(problem.plant)

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound at starts, 0 or 1; see `HeldInputBound.at`."""
        x = tuple(np.ascontiguousarray(starts.T))
        plans = self._filter.plans
        h = np.array([np.broadcast_to(c, len(starts)) for c in plans.barriers(plans.part(x))])
        return (self._filter.domain(x) & (h > 0.0).all(axis=0)).astype(float)

    def contradiction(self, visited: VisitedStates) -> str:
        """Return "": what no state of an episode could show, its rate does.

        Args:
            visited: states of the episodes.
        """
        return ""


def backup_bound(of: FilteredPolicy) -> BackupBound | None:
    """Return the bound of a backup filter; None for other filters.

    Args:
        of: a policy, which does not matter, and the filter.
    """
    if not isinstance(of.parts, BackupSettings):
        return None
    return BackupBound(of.parts, of.problem, of.knowledge)
