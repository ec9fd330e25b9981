"""Decisions by plans, in components: floats of one state, or arrays of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.wrappers.backup.plans import Plans
from safe_envs.wrappers.backup.search import Search
from safe_envs.wrappers.filter_qp import FilterDecision

ROUNDING = 1e-9
"""Below which no barrier falls on the plan of an input that is executed in place of a backup."""


class PlanFilter:
    """Decides whether inputs are allowed, and which are executed in place of others.

    Args:
        plans: that are simulated.
        floor: below which no barrier may be on a plan.

    Attributes:
        plans: as given.
        floor: as given.
    """

    def __init__(self, plans: Plans, floor: float) -> None:
        self.plans, self.floor = plans, floor
        self._search = Search(plans, floor)

    def domain(self, x: Components) -> np.ndarray:
        """Return whether the input of some law is allowed at states, bool (B,).

        Args:
            x: n components (B,).
        """
        with np.errstate(all="ignore"):
            return self._search.last_resort(self.plans.part(x)).good

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one state.

        Args:
            x: n finite components of the state.
            u: m finite components of the proposed input.

        Returns:
            The decision in components.
        """
        x = self.plans.part(x)
        wanted = [min(max(c, a), b) for c, a, b in zip(u, *self.plans.bounds, strict=True)]
        given = self.plans.kept_after_one(x, wanted, self.floor)
        count = self.plans.count
        if given.kept:
            action = list(u) if wanted == list(u) else wanted
            none = [0.0] * count
            return FilterDecision(action, [given.lowest] * count, [False], True, none, -1, u)
        found = self._search.of_one(x, wanted)
        if found is not None:
            action, lowest = found
            margin, none = [lowest] * count, [0.0] * count
            return FilterDecision(action, margin, [True], True, none, given.failed, u)
        with np.errstate(all="ignore"):
            last = self._search.last_resort(tuple([np.array([c]) for c in x]))
        action, lowest, slack = [[c.item() for c in part] for part in last[:3]]
        return FilterDecision(action, lowest, [True], last.good.item(), slack, given.failed, u)

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for a batch; as `decide_floats`, with an array (B,) for each component.

        Args:
            x: n components of the states.
            u: m components of the proposed inputs.

        Returns:
            The decisions in components.
        """
        with np.errstate(all="ignore"):
            return self._decide(self.plans.part(x), u)

    def _decide(self, x: Components, u: Components) -> FilterDecision:
        wanted = tuple([np.clip(c, *ends) for c, ends in zip(u, self.plans.ends, strict=True)])
        kept, lowest, failed = self.plans.kept_after(x, wanted, self.floor)
        count, size = self.plans.count, len(kept)
        rows = np.flatnonzero(~kept)
        none = np.zeros(size)
        if not rows.size:
            return FilterDecision(
                wanted, (lowest,) * count, (~kept,), kept, (none,) * count, failed, u
            )
        action = tuple([c.copy() for c in wanted])
        margin = tuple([lowest.copy() for _ in range(count)])
        slack = tuple([none.copy() for _ in range(count)])
        feasible = np.ones(size, dtype=bool)
        at, goal = [tuple([c[rows] for c in part]) for part in (x, wanted)]
        points, lowest, found = self._search.of_batch(at, goal)
        _put((*action, *margin), rows, (*points, *(lowest,) * count))
        lost = np.flatnonzero(~found)
        if lost.size:
            last, rows = self._search.last_resort(tuple([c[lost] for c in at])), rows[lost]
            _put((*action, *margin, *slack), rows, (*last.action, *last.lowest, *last.slack))
            feasible[rows] = last.good
        return FilterDecision(action, margin, (~kept,), feasible, slack, failed, u)


def _put(parts: Sequence[np.ndarray], rows: np.ndarray, values: Sequence[np.ndarray]) -> None:
    for part, value in zip(parts, values, strict=True):
        part[rows] = value
