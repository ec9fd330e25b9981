"""Bounds for the env's own steps: the input is held, and safety is judged at control instants.

Each is a lower bound on the probability of a safe episode of a policy under a filter, or of every
policy under it, and is made by one of `MAKERS`: from the table of a promise filter, say. What makes
a new kind of bound is added there, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np

from safe_envs.agents.evaluation.backup_bound import backup_bound
from safe_envs.agents.evaluation.closed_loop_bound import closed_loop_bound
from safe_envs.agents.evaluation.contradiction import without_held
from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.held_certificate_bound import held_certificate_bound
from safe_envs.agents.evaluation.promise_bound import promise_bound
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.running_sum import RunningMean
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.actuators import why_not_direct


class HeldInputBound(Protocol):
    """A lower bound on the probability of a safe episode, in the env's own steps."""

    @property
    def word(self) -> Literal["proved", "certified", "computed"]:
        """What it is worth; see `safe_envs.agents.evaluation.rows.HeldWord`."""
        ...

    @property
    def note(self) -> str:
        """What it is of, in words."""
        ...

    @property
    def why_none(self) -> str:
        """Why there is none at any start; "" where there may be one."""
        ...

    @property
    def nowhere(self) -> str:
        """What to say where it is 0 at all starts."""
        ...

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound up to the problem's horizon at starts (B, n): values in [0, 1], (B,)."""
        ...

    def contradiction(self, visited: VisitedStates) -> str:
        """Return how states of episodes contradict it; "" if they do not."""
        ...


Maker = Callable[[FilteredPolicy], HeldInputBound | None]
"""From a policy under a filter to its bound; None where such a bound is not for such filters."""

MAKERS: tuple[Maker, ...] = (closed_loop_bound, held_certificate_bound, promise_bound, backup_bound)
"""All that makes such bounds, the best one first."""

NO_FILTER = "there is no filter"
NO_MAKER = "neither a table nor a certificate of the env's own step is known for it"
_BETWEEN = "it is of control instants, not of the time between them"


def held_bound_of(
    of: FilteredPolicy, makers: Sequence[Maker] | None = None
) -> HeldInputBound | str:
    """Return the bound of a policy under a filter for the env's own steps, or why there is none.

    Args:
        of: the policy and the filter.
        makers: of bounds; by default all.
    """
    why_not = why_not_direct(of.problem, "bounds of a filter")
    if why_not:
        return why_not
    made = (make(of) for make in (MAKERS if makers is None else makers))
    found = [bound for bound in made if bound is not None]
    if not found:
        return NO_MAKER if of.parts else NO_FILTER
    best = next((bound for bound in found if not bound.why_none), found[0])
    return best.why_none or best


class HeldAverager:
    """Averages the bound of a filter for the env's own steps over the starts of episodes.

    Args:
        bound: of the filter, or why there is none.
    """

    def __init__(self, bound: HeldInputBound | str) -> None:
        self._bound = bound
        self._values = RunningMean()

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        if not isinstance(self._bound, str):
            self._values.add(self._bound.at(starts))

    def put_in(self, summary: BoundSummary, visited: VisitedStates) -> BoundSummary:
        """Return a summary with the mean of the bound, or with why there is none.

        Args:
            summary: of the other bounds.
            visited: states of the episodes; where they contradict the bound, it is withheld.
        """
        bound = self._bound
        if isinstance(bound, str):
            return replace(summary, held_note=bound)
        mean = self._values.mean
        if not mean:
            return replace(summary, held_note=bound.nowhere)
        reason = bound.contradiction(visited)
        if reason:
            return without_held(summary, reason)
        return replace(
            summary,
            held_bound=mean,
            held_word=bound.word,
            held_note=bound.note,
            held_error=self._values.error,
        )


def held_averager_of(of: FilteredPolicy, monitoring: str, why_not: str | None) -> HeldAverager:
    """Return what averages the bound of a policy under a filter for the env's own steps.

    Args:
        of: the policy and the filter.
        monitoring: where h is checked, "discrete" or "continuous".
        why_not: why not to look for a bound at all, if so.
    """
    if monitoring == "continuous":
        why_not = why_not or _BETWEEN
    if why_not:
        return HeldAverager(why_not if of.parts else NO_FILTER)
    return HeldAverager(held_bound_of(of))
