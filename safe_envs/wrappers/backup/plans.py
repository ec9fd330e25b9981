"""Plans: a system under backup laws, simulated period by period until a terminal set is reached."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components, filled
from safe_envs.wrappers.backup.planned_system import PlannedSystem
from safe_envs.wrappers.filter_qp.component_filter import NO_VALUE

_CHUNK = 2048
"""States that are simulated at once: more of them no longer fit into a processor's cache."""


class Kept(NamedTuple):
    """Whether plans stay safe until they enter a terminal set; arrays (M,) or of one plan.

    Attributes:
        kept: whether one of the laws does.
        lowest: smallest barrier on the plan that does; with none, on that of the first law up to
            where it fails.
        failed: the barrier that the first law violates first, -1 where it merely takes too long.
    """

    kept: Any
    lowest: Any
    failed: Any


class Plans(PlannedSystem):
    """Simulates the plans of backup laws, of one state in floats and of batches."""

    def kept_after_one(self, x: Sequence[float], u: Sequence[float], floor: float) -> Kept:
        """Return whether some law keeps the state that an input leads to; see `kept_after`.

        Args:
            x: p components of the state.
            u: m components of the input.
            floor: which no barrier may be below.
        """
        first: Kept | None = None
        try:
            reached = self.steps["floats"].step(tuple(x), u, self.still)
        except NO_VALUE:
            return Kept(False, -np.inf, -1)
        for reading in self.compiled["floats"]:
            found = self._followed_by_one(reading, reached, floor)
            if found.kept:
                return found
            first = first or found
        assert first is not None
        return first

    def _followed_by_one(self, reading: Any, x: Components, floor: float) -> Kept:
        step, count, lowest = self.steps["floats"].step, self.count, np.inf
        for k in range(self.periods + 1):
            try:
                values = reading(*x)
                h, total = min(values[:count]), sum(values[:count])
                if not h >= floor or total != total:
                    return Kept(False, min(lowest, h), values.index(h))
                lowest = min(lowest, h)
                if values[count] >= 0.0:
                    return Kept(True, lowest, -1)
                if k < self.periods:
                    x = step(x, self.clipped(values), self.still)
            except NO_VALUE:
                return Kept(False, -np.inf, -1)
        return Kept(False, lowest, -1)

    def kept_after(self, x: Components, u: Components, floor: float) -> Kept:
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
            return Kept(*[np.concatenate(each) for each in zip(*found, strict=True)])
        reached = self.advanced(x, u)
        first, *others = self.compiled["arrays"]
        kept, lowest, failed = self._followed(first, reached, floor)
        for reading in others:
            rows = np.flatnonzero(~kept)
            if not rows.size:
                break
            found = self._followed(reading, _at(reached, rows), floor)
            now = rows[found.kept]
            kept[now], lowest[now] = True, found.lowest[found.kept]
        failed[kept] = -1
        return Kept(kept, lowest, failed)

    def _followed(self, reading: Any, x: Components, floor: float) -> Kept:
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
        return Kept(kept, lowest, failed)

    def whole(self, law: int, x: Components, u: Components) -> tuple[np.ndarray, np.ndarray]:
        """Follow a law to its terminal set, or to the last period, whatever it violates.

        Args:
            law: its index.
            x: p components (M,) of the states.
            u: m components (M,) of the first inputs.

        Returns:
            Whether the terminal set is reached, (M,), and each barrier's smallest value, (k, M).
        """
        reading, count = self.compiled["arrays"][law], self.count
        entered, lows = np.zeros(len(x[0]), dtype=bool), np.full((count, len(x[0])), np.inf)
        for k in range(self.periods + 1):
            x = self.advanced(x, u)
            values = reading(*x)
            h = np.array([filled(v, x[0].shape) for v in values[:count]])
            lows = np.where(entered, lows, np.minimum(lows, h))
            entered |= filled(values[count], x[0].shape) >= 0.0
            if k == self.periods or entered.all():
                break
            u = self.clipped_arrays(values, x)
        return entered, np.where(np.isnan(lows), -np.inf, lows)


def _at(components: Components, rows: Any) -> Components:
    return tuple([c[rows] for c in components])
