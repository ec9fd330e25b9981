"""The bound of one controller for the env's own steps: of a certified table of its closed loop."""

from __future__ import annotations

from typing import Literal

import numpy as np

from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.errors import ConfigurationError, SafeEnvsError, shown
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.value.closed_loop import ClosedLoop, ClosedLoopTable
from safe_envs.wrappers.value.closed_loop_cache import closed_loop_for

_FORMULAS = ("nominal", "zero")
"""Policies that are formulas of the state."""


class ClosedLoopBound:
    """What a table of a closed loop says of a controller, or of every policy under a filter.

    It holds up to the horizon of the problem, as proposition 9 of the page on values proves.

    Args:
        table: of the closed loop; None where there is none.
        note: what it is of, or why there is none.

    Attributes:
        word: "certified".
        note: what it is of.
        why_none: why there is no table; "" where there is one.
        nowhere: what to say where it is 0 at all starts.
    """

    word: Literal["certified"] = "certified"
    nowhere = (
        "the table of the closed loop has 0 at these starts: a step moves states by too little for"
        " its cells"
    )

    def __init__(self, table: ClosedLoopTable | None, note: str) -> None:
        self._table = table
        self.note = note
        self.why_none = "" if table is not None else note

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound at starts; see `HeldInputBound.at`."""
        if self._table is None:
            return np.zeros(len(starts))
        if len(starts) and (starts == starts[0]).all():
            one = self._table.start_bounds(starts[0][:, None])
            return np.repeat(one, len(starts))
        return self._table.start_bounds(tuple(np.ascontiguousarray(starts.T)))

    def contradiction(self, visited: VisitedStates) -> str:
        """Return "": what no state of an episode could show, its rate does.

        Args:
            visited: states of the episodes.
        """
        return ""


def closed_loop_bound(of: FilteredPolicy) -> ClosedLoopBound | None:
    """Return the bound of a table, which is computed if need be, or why there is none.

    Args:
        of: the policy and the filter, or the policy alone.

    Returns:
        None for a filter that acts by itself, and where no table was asked for.
    """
    if not of.closed_loop or isinstance(of.parts, FilterSettings):
        return None
    try:
        table = closed_loop_for(_loop_of(of))
    except SafeEnvsError as error:
        return ClosedLoopBound(None, str(error))
    cells = " x ".join(map(str, table.grid.shape))
    whose = "of this policy" if of.policy in _FORMULAS else "of every policy under the filter"
    return ClosedLoopBound(table, f"by a table {whose}, {cells} cells")


def compute_closed_loop(
    of: FilteredPolicy, progress: Progress | None = None
) -> ClosedLoopTable | None:
    """Have the table computed that `closed_loop_bound` reads.

    Args:
        of: the policy and the filter, or the policy alone.
        progress: called with the part of the work that is done.

    Returns:
        The table, which is there as long as it is in use, also without a cache; None where there
        is none, as `closed_loop_bound` says.
    """
    table = None
    if not isinstance(of.parts, FilterSettings):
        try:
            table = closed_loop_for(_loop_of(of), progress)
        except SafeEnvsError:
            table = None
    if progress is not None:
        progress(1.0)
    return table


def _loop_of(of: FilteredPolicy) -> ClosedLoop:
    """Return the closed loop of a policy under a filter; raise SafeEnvsError if it is not one."""
    assert not isinstance(of.parts, FilterSettings)
    policy = of.policy if of.policy in _FORMULAS else "any"
    if not of.parts and policy == "any":
        raise ConfigurationError(
            f"the policy {shown(of.policy)} is no formula of the state; without a filter, tables"
            f" are of {' and '.join(_FORMULAS)}"
            if of.policy
            else "the policy is no formula of the state"
        )
    if of.parts and of.objective != "nearest":
        raise ConfigurationError(
            f"objective = {of.objective}: tables are of filters that take the nearest input"
        )
    return ClosedLoop(of.problem, of.parts[0] if of.parts else None, policy, of.knowledge)
