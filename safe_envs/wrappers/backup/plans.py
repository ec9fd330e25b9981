"""Plans: a system under backup laws, simulated period by period until a terminal set is reached."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, filled
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.wrappers.backup.closed_part import closed_part
from safe_envs.wrappers.filter_qp.component_filter import NO_VALUE

_CHUNK = 2048
"""States that are simulated at once: more of them no longer fit into a processor's cache."""


@dataclass(frozen=True)
class PlannedLaw:
    """A backup law with its terminal set.

    Attributes:
        name: of the law.
        law: an expression for each input.
        terminal: >= 0 in the terminal set.
    """

    name: str
    law: tuple[sp.Expr, ...]
    terminal: sp.Expr


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


class Plans:
    """Simulates the plans of backup laws.

    A period is one of the env with every random number 0: classical Runge-Kutta for a system
    without noise, whose plans are thereby those of the env; and Euler for one with noise. Inputs
    are evaluated at control instants, clipped to the input bounds, and held.

    Args:
        system: that is known.
        barriers: h of each barrier.
        laws: at least one.
        bounds: lower and upper bounds of the inputs.
        dt: control period in s.
        substeps: integration steps in it.
        periods: after which a plan has to be in its terminal set.

    Attributes:
        laws: as given.
        periods: as given.
        bounds: as given.
        ends: lower and upper bound of each input.
        count: number of barriers.
    """

    def __init__(
        self,
        system: ControlAffineSDE,
        barriers: Iterable[sp.Expr],
        laws: Sequence[PlannedLaw],
        bounds: tuple[Sequence[float], Sequence[float]],
        dt: float,
        substeps: int,
        periods: int,
    ) -> None:
        self.laws, self.periods = tuple(laws), periods
        self.bounds, self._barriers = bounds, tuple(barriers)
        self.ends = [(np.array(a), np.array(b)) for a, b in zip(*bounds, strict=True)]
        self._middle = [0.5 * a + 0.5 * b for a, b in zip(*bounds, strict=True)]
        self.count = len(self._barriers)
        wanted = [*self._barriers, *(e for law in laws for e in (law.terminal, *law.law))]
        self._system, self._places = closed_part(system, wanted)
        self._steps = {f: Integrator(self._system, dt, substeps, f) for f in _FLAVOURS}
        self._readings = {f: [self._compile(law, f) for law in laws] for f in _FLAVOURS}
        self._still = [0.0] * self._steps["floats"].channels
        self._still_arrays = [np.array(0.0)] * len(self._still)

    def _compile(self, law: PlannedLaw, flavour: Flavour) -> Any:
        """Compile the barriers, the terminal expression and the inputs of a law."""
        wanted = (*self._barriers, law.terminal, *law.law)
        numbers = [self._system.numeric(e) for e in wanted]
        return compile_function(self._system.states, numbers, flavour)

    def part(self, x: Sequence[Any]) -> Components:
        """Return those components of a state, or of states, that plans need.

        All other methods take states as these p components.

        Args:
            x: n components.
        """
        return tuple([x[i] for i in self._places])

    # One state, in floats.

    def inputs_of_one(self, x: Sequence[float]) -> list[list[float]]:
        """Return what each law executes at a state.

        Args:
            x: p components.
        """
        found = []
        for reading in self._readings["floats"]:
            try:
                found.append(self._clipped(reading(*x)))
            except NO_VALUE:
                found.append(list(self._middle))
        return found

    def _clipped(self, values: Sequence[float]) -> list[float]:
        """Return the inputs among readings within their bounds; the middle where there is none."""
        wanted = values[self.count + 1 :]
        limits = zip(wanted, *self.bounds, self._middle, strict=True)
        return [c if u != u else min(max(u, a), b) for u, a, b, c in limits]

    def kept_after_one(self, x: Sequence[float], u: Sequence[float], floor: float) -> Kept:
        """Return whether some law keeps the state that an input leads to; see `kept_after`.

        Args:
            x: p components of the state.
            u: m components of the input.
            floor: which no barrier may be below.
        """
        first: Kept | None = None
        try:
            reached = self._steps["floats"].step(tuple(x), u, self._still)
        except NO_VALUE:
            return Kept(False, -np.inf, -1)
        for reading in self._readings["floats"]:
            found = self._followed_by_one(reading, reached, floor)
            if found.kept:
                return found
            first = first or found
        assert first is not None
        return first

    def _followed_by_one(self, reading: Any, x: Components, floor: float) -> Kept:
        step, count, lowest = self._steps["floats"].step, self.count, np.inf
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
                    x = step(x, self._clipped(values), self._still)
            except NO_VALUE:
                return Kept(False, -np.inf, -1)
        return Kept(False, lowest, -1)

    # A batch.

    def inputs(self, x: Components) -> list[Components]:
        """Return what each law executes at states.

        Args:
            x: p components (B,).

        Returns:
            For each law m components (B,).
        """
        return [self._clipped_arrays(reading(*x), x) for reading in self._readings["arrays"]]

    def _clipped_arrays(self, values: Components, x: Components) -> Components:
        shape, wanted = x[0].shape, values[self.count + 1 :]
        found = []
        for u, (low, high), middle in zip(wanted, self.ends, self._middle, strict=True):
            clipped = np.minimum(np.maximum(filled(u, shape), low), high)
            missing = np.isnan(clipped)
            found.append(np.where(missing, middle, clipped) if missing.any() else clipped)
        return tuple(found)

    def barriers(self, x: Components) -> Components:
        """Return the barriers at states, k components.

        Args:
            x: p components (B,).
        """
        with np.errstate(all="ignore"):
            return self._readings["arrays"][0](*x)[: self.count]

    def advanced(self, x: Components, u: Components) -> Components:
        """Return the states one period later.

        Args:
            x: p components (B,) of the states.
            u: m components (B,) of the inputs.
        """
        shape = x[0].shape
        step = self._steps["arrays"].step
        return tuple([filled(c, shape) for c in step(x, u, self._still_arrays)])

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
        first, *others = self._readings["arrays"]
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
            u = self._clipped_arrays(values, x)
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
        reading, count = self._readings["arrays"][law], self.count
        entered, lows = np.zeros(len(x[0]), dtype=bool), np.full((count, len(x[0])), np.inf)
        for k in range(self.periods + 1):
            x = self.advanced(x, u)
            values = reading(*x)
            h = np.array([filled(v, x[0].shape) for v in values[:count]])
            lows = np.where(entered, lows, np.minimum(lows, h))
            entered |= filled(values[count], x[0].shape) >= 0.0
            if k == self.periods or entered.all():
                break
            u = self._clipped_arrays(values, x)
        return entered, np.where(np.isnan(lows), -np.inf, lows)


_FLAVOURS: tuple[Flavour, ...] = ("floats", "arrays")


def _at(components: Components, rows: Any) -> Components:
    return tuple([c[rows] for c in components])
