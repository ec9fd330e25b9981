"""Plans: a system under backup laws, simulated period by period until a terminal set is reached."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components, filled
from safe_envs.dynamics.defined import NO_VALUE
from safe_envs.wrappers.backup.planned_system import PlannedSystem

_CHUNK = 2048
"""States that are simulated at once: more of them no longer fit into a processor's cache."""


class PlanVerdict(NamedTuple):
    """Whether plans stay safe until they enter a terminal set; arrays (M,) or of one plan.

    Attributes:
        allowed: whether one of the laws does.
        height: smallest barrier on the plan that does; with none, on that of the first law up to
            where it fails.
        failed: the barrier that the first law violates first, -1 where it merely takes too long.
    """

    allowed: Any
    height: Any
    failed: Any


class Plans(PlannedSystem):
    """Simulates the plans of backup laws, of one state in floats and of batches."""

    def kept_after_one(self, x: Sequence[float], u: Sequence[float], floor: float) -> PlanVerdict:
        """Return whether some law keeps the state that an input leads to; see `kept_after`.

        Args:
            x: p components of the state.
            u: m components of the input.
            floor: which no barrier may be below.
        """
        first: PlanVerdict | None = None
        try:
            reached = self.steps["floats"].step(tuple(x), u, self.still)
        except NO_VALUE:
            return PlanVerdict(False, -np.inf, -1)
        for reading in self.compiled["floats"]:
            found = self._followed_by_one(reading, reached, floor)
            if found.allowed:
                return found
            first = first or found
        assert first is not None
        return first

    def _followed_by_one(self, reading: Any, x: Components, floor: float) -> PlanVerdict:
        step, count, lowest = self.steps["floats"].step, self.count, np.inf
        for k in range(self.periods + 1):
            try:
                values = reading(*x)
                h, total = min(values[:count]), sum(values[:count])
                if not h >= floor or total != total:
                    return PlanVerdict(False, min(lowest, h), values.index(h))
                lowest = min(lowest, h)
                if values[count] >= 0.0:
                    return PlanVerdict(True, lowest, -1)
                if k < self.periods:
                    x = step(x, self.clipped(values), self.still)
            except NO_VALUE:
                return PlanVerdict(False, -np.inf, -1)
        return PlanVerdict(False, lowest, -1)

    def kept_after(self, x: Components, u: Components, floor: float) -> PlanVerdict:
        """Return whether some law keeps the states that inputs lead to.

        That is whether no barrier is below the floor there, nor at any later control instant of the
        plan, until the plan is in the terminal set of its law, within so many `periods`.

        Args:
            x: p components (M,) of the states.
            u: m components (M,) of the inputs.
            floor: which no barrier may be below.
        """
        size = len(x[0])
        if size > _CHUNK:
            parts = [slice(i, i + _CHUNK) for i in range(0, size, _CHUNK)]
            found = [self.kept_after(_at(x, part), _at(u, part), floor) for part in parts]
            return PlanVerdict(*[np.concatenate(each) for each in zip(*found, strict=True)])
        reached = self.advanced(x, u)
        first, *others = self.compiled["arrays"]
        kept, lowest, failed = self._followed(first, reached, floor)
        for reading in others:
            rows = np.flatnonzero(~kept)
            if not rows.size:
                break
            found = self._followed(reading, _at(reached, rows), floor)
            now = rows[found.allowed]
            kept[now], lowest[now] = True, found.height[found.allowed]
        failed[kept] = -1
        return PlanVerdict(kept, lowest, failed)

    def _followed(self, reading: Any, x: Components, floor: float) -> PlanVerdict:
        """Follow a law from states, each as long as it is neither lost nor in the terminal set."""
        size, count = len(x[0]), self.count
        kept, lowest = np.zeros(size, dtype=bool), np.empty(size)
        failed, rows = np.full(size, -1), np.arange(size)
        low = np.full(size, np.inf)
        for k in range(self.periods + 1):
            values = reading(*x)
            h = filled(values[0], x[0].shape)
            for other in values[1:count]:
                h = np.minimum(h, other)
            low = np.minimum(low, h)
            above = h >= floor
            entered = above & (filled(values[count], h.shape) >= 0.0)
            open_ = above & ~entered
            over = np.flatnonzero(~open_)
            if over.size:
                done = rows[over]
                kept[done], lowest[done] = entered[over], low[over]
                lost = np.flatnonzero(~above)
                if lost.size:
                    worst = np.array([filled(v, h.shape)[lost] for v in values[:count]])
                    failed[rows[lost]] = worst.argmin(axis=0)
            if k == self.periods or over.size == len(rows):
                lowest[rows[open_]] = low[open_]
                break
            u = self.clipped_arrays(values, x)
            if over.size:
                on = np.flatnonzero(open_)
                rows, low, x, u = rows[on], low[on], _at(x, on), _at(u, on)
            x = self.advanced(x, u)
        return PlanVerdict(kept, lowest, failed)

    def whole(self, law: int, x: Components, u: Components) -> tuple[np.ndarray, np.ndarray]:
        """Follow a law to its terminal set, or to the last period, whatever it violates.

        Args:
            law: its index.
            x: p components (M,) of the states.
            u: m components (M,) of the first inputs.

        Returns:
            Whether the terminal set is reached, (M,), and each barrier's smallest value, (k, M).
        """
        reading, count, size = self.compiled["arrays"][law], self.count, len(x[0])
        entered, lows = np.zeros(size, dtype=bool), np.empty((count, size))
        rows, low = np.arange(size), np.full((count, size), np.inf)
        for k in range(self.periods + 1):
            x = self.advanced(x, u)
            values, shape = reading(*x), x[0].shape
            low = np.minimum(low, np.array([filled(v, shape) for v in values[:count]]))
            there = filled(values[count], shape) >= 0.0
            over = np.flatnonzero(there)
            entered[rows[over]], lows[:, rows[over]] = True, low[:, over]
            if k == self.periods or over.size == rows.size:
                lows[:, rows[~there]] = low[:, ~there]
                break
            u = self.clipped_arrays(values, x)
            if over.size:
                on = np.flatnonzero(~there)
                rows, low, x, u = rows[on], low[:, on], _at(x, on), _at(u, on)
        return entered, np.where(np.isnan(lows), -np.inf, lows)


def _at(components: Components, rows: Any) -> Components:
    return tuple([c[rows] for c in components])
