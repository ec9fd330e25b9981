"""Plans: a system under backup laws, simulated period by period until a terminal set is reached.

A filter takes T_j, as far as it is safe, for a set that law j never leaves. Who states T_j answers
for that. Here states of it are drawn, in its interior and at its edge, where a set is left first,
and one period of the law is simulated from each. What is found is refused; where nothing is found,
nothing is proved.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, filled
from safe_envs.dynamics.defined import NO_VALUE, defined_arrays
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError


def closed_part(
    system: ControlAffineSDE, expressions: Iterable[sp.Expr]
) -> tuple[ControlAffineSDE, tuple[int, ...]]:
    """Return the smallest part of a system that moves by itself and holds expressions.

    The position of a vehicle, say, need not be simulated where its altitude is to be kept.

    Args:
        system: whose states are looked at. With noise it is returned as it is, for the noise of
            one state decides how all are integrated.
        expressions: of the states.

    Returns:
        The part, and the indices of its states.
    """
    drift, effect = sp.Matrix(system.drift), sp.Matrix(system.input_matrix)
    both: Any = drift.row_join(effect).tolist()
    rates = [set[Any]().union(*(sp.sympify(e).free_symbols for e in row)) for row in both]
    needed: set[Any] = set().union(*(e.free_symbols for e in expressions))
    chosen: set[int] = set()
    while True:
        new = {i for i, s in enumerate(system.states) if s in needed} - chosen
        if not new:
            break
        chosen |= new
        needed = set().union(*(rates[i] for i in new))
    if system.noisy or not chosen or len(chosen) == system.n:
        return system, tuple(range(system.n))
    places = sorted(chosen)
    part = ControlAffineSDE(
        states=tuple(system.states[i] for i in places),
        inputs=system.inputs,
        drift=drift.extract(places, [0]),
        input_matrix=effect.extract(places, list(range(system.m))),
        diffusion=sp.zeros(len(places), 1),
        parameters=system.parameters,
    )
    return part, tuple(places)


_FLAVOURS: tuple[Flavour, ...] = ("floats", "arrays")

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


class Plans:
    """Simulates the plans of backup laws, of one state in floats and of batches.

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
        middle: of the bounds, which stands for an input without a value.
        count: number of barriers.
        system, places: the part of the system that is simulated, and the indices of its states.
        readings: of each law the barriers, the terminal expression and its inputs.
        compiled: the readings as functions of p components, by flavour.
        steps: the integrators by flavour.
        still, still_arrays: what they take for noise, zeros.
        substeps: as given.
        step_size: of the integration, in s.
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
        self.bounds, heights = bounds, tuple(barriers)
        self.ends = [(np.array(a), np.array(b)) for a, b in zip(*bounds, strict=True)]
        self.middle = [0.5 * a + 0.5 * b for a, b in zip(*bounds, strict=True)]
        self.count = len(heights)
        wanted = [*heights, *(e for law in laws for e in (law.terminal, *law.law))]
        self.system, self.places = closed_part(system, wanted)
        self.steps = {f: Integrator(self.system, dt, substeps, f) for f in _FLAVOURS}
        self.substeps, self.step_size = substeps, dt / substeps
        self.readings = [
            tuple(self.system.numeric(e) for e in (*heights, law.terminal, *law.law))
            for law in laws
        ]
        self.compiled = {f: [self._compile(each, f) for each in self.readings] for f in _FLAVOURS}
        self.still = [0.0] * self.steps["floats"].channels
        self.still_arrays = [np.array(0.0)] * len(self.still)

    def _compile(self, reading: Sequence[sp.Expr], flavour: Flavour) -> Any:
        return compile_function(self.system.states, reading, flavour)

    def part(self, x: Sequence[Any]) -> Components:
        """Return those components of a state, or of states, that plans need.

        All other methods take states as these p components.

        Args:
            x: n components.
        """
        return tuple([x[i] for i in self.places])

    def inputs_of_one(self, x: Sequence[float]) -> list[list[float]]:
        """Return what each law executes at a state.

        Args:
            x: p components.
        """
        found = []
        for reading in self.compiled["floats"]:
            try:
                found.append(self.clipped(reading(*x)))
            except NO_VALUE:
                found.append(list(self.middle))
        return found

    def clipped(self, values: Sequence[float]) -> list[float]:
        """Return the inputs among readings within their bounds; the middle where there is none.

        Args:
            values: the barriers, the terminal expression and the inputs of a law.
        """
        wanted = values[self.count + 1 :]
        limits = zip(wanted, *self.bounds, self.middle, strict=True)
        return [c if u != u else min(max(u, a), b) for u, a, b, c in limits]

    def inputs(self, x: Components) -> list[Components]:
        """Return what each law executes at states.

        Args:
            x: p components (B,).

        Returns:
            For each law m components (B,).
        """
        return [self.clipped_arrays(reading(*x), x) for reading in self.compiled["arrays"]]

    def clipped_arrays(self, values: Components, x: Components) -> Components:
        """Return the inputs among readings of a batch; see `clipped`.

        Args:
            values: the readings.
            x: p components (B,) of the states that they are of.
        """
        shape, wanted = x[0].shape, values[self.count + 1 :]
        found = []
        for u, (low, high), middle in zip(wanted, self.ends, self.middle, strict=True):
            clipped = np.minimum(np.maximum(filled(u, shape), low), high)
            missing = np.isnan(clipped)
            found.append(np.where(missing, middle, clipped) if missing.any() else clipped)
        return tuple(found)

    def barriers(self, x: Components) -> Components:
        """Return the barriers at states, k components, -inf where one has no value.

        Args:
            x: p components (B,).
        """
        with np.errstate(all="ignore"):
            return defined_arrays(self.compiled["arrays"][0](*x)[: self.count])

    def advanced(self, x: Components, u: Components) -> Components:
        """Return the states one period later.

        Args:
            x: p components (B,) of the states.
            u: m components (B,) of the inputs.
        """
        shape = x[0].shape
        step = self.steps["arrays"].step
        return tuple([filled(c, shape) for c in step(x, u, self.still_arrays)])

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
            found = [self.kept_after(at_rows(x, part), at_rows(u, part), floor) for part in parts]
            return PlanVerdict(*[np.concatenate(each) for each in zip(*found, strict=True)])
        reached = self.advanced(x, u)
        first, *others = self.compiled["arrays"]
        kept, lowest, failed = self._followed(first, reached, floor)
        for reading in others:
            rows = np.flatnonzero(~kept)
            if not rows.size:
                break
            found = self._followed(reading, at_rows(reached, rows), floor)
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
                rows, low, x, u = rows[on], low[on], at_rows(x, on), at_rows(u, on)
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
                rows, low, x, u = rows[on], low[:, on], at_rows(x, on), at_rows(u, on)
        return entered, np.where(np.isnan(lows), -np.inf, lows)


def at_rows(components: Components, rows: Any) -> Components:
    """Return rows of a batch."""
    return tuple([c[rows] for c in components])


_COUNT = 2000
_FOLLOWED = 20
"""Control periods for which the law is followed from the samples, to see more of its set."""
_HALVINGS = 30
_ROUNDING = 1e-7
"""Of the median size of an expression: what rounding may take away."""


def sampled_states(problem: Any) -> np.ndarray:
    """Return states of a problem's workspace and starts, shape (B, n); the same ones every time.

    Args:
        problem: a `SafetyProblem`; where its workspace has no end, the region from which it is
            learned stands for it, or what is around its starts.
    """
    rng = np.random.default_rng(0)
    starts = problem.starts[problem.start].proposals(_COUNT // 4)
    regions = problem.sampling.region or ((-np.inf, np.inf),) * len(problem.states)
    ends = []
    for at, state, region in zip(starts.T, problem.states, regions, strict=True):
        low, high = (state.low, state.high) if np.isfinite(state.high - state.low) else region
        if not np.isfinite(high - low):
            width = max(np.ptp(at), np.pi if state.unit == "rad" else 1.0)
            low, high = at.min() - width, at.max() + width
        ends.append((low, high))
    low, high = np.array(ends).T
    return np.concatenate([starts, rng.uniform(low, high, (_COUNT, len(low)))])


def require_kept(
    plans: Plans, laws: Iterable[int], states: np.ndarray, margin: float = 0.0
) -> None:
    """Raise SystemDefinitionError where a law leaves its terminal set at a sampled state.

    With noise a period is not that of the env, so that only the law's numbers are looked at.

    Args:
        plans: of the laws.
        laws: indices of those that are sampled.
        states: shape (B, n).
        margin: of the filter.

    Raises:
        ConfigurationError: No state of a set keeps the margin.
    """
    x = np.array(plans.part(tuple(states.T)))
    with np.errstate(all="ignore"):
        for j in laws:
            _require_kept(plans, j, x, margin)


class _Read:
    """Readings of a law at states: the safe height, the terminal expression and the inputs."""

    def __init__(self, plans: Plans, j: int, x: np.ndarray) -> None:
        at = tuple(x)
        values = plans.compiled["arrays"][j](*at)
        rows = [filled(v, x.shape[1:]) for v in values]
        self.height = np.min(rows[: plans.count], axis=0)
        self.terminal = rows[plans.count]
        self.law = np.array(rows[plans.count + 1 :])
        self.inside = (self.height >= 0.0) & (self.terminal >= 0.0)
        self._plans, self._at, self._values = plans, at, values

    def advanced(self) -> np.ndarray:
        """Return the states one period later."""
        u = self._plans.clipped_arrays(self._values, self._at)
        return np.array(self._plans.advanced(self._at, u))


def _require_kept(plans: Plans, j: int, x: np.ndarray, margin: float) -> None:
    found, outside = [], x
    read = _Read(plans, j, x)
    sizes = [np.nanmedian(np.abs(e)) for e in (read.terminal, read.height)]
    for _ in range(_FOLLOWED):
        found.append(x[:, read.inside])
        x = read.advanced()
        read = _Read(plans, j, x)
    inside = np.concatenate(found, axis=1)
    if not inside.size:
        return
    outside = outside[:, ~_Read(plans, j, outside).inside]
    inside = np.concatenate([inside, _at_edge(plans, j, inside, outside)], axis=1)
    read = _Read(plans, j, inside)
    if read.height.max() < margin:
        raise ConfigurationError(
            f"margin = {margin:g} of the backup filter: on the terminal set of backup law"
            f" {plans.laws[j].name} the smallest barrier is {read.height.max():.3g} at most, of"
            f" {read.height.size} sampled states; give a smaller margin"
        )
    lost = ~np.isfinite(read.law).all(axis=0)
    what = "the law gives no finite input"
    if not lost.any() and not plans.system.noisy:
        after = _Read(plans, j, read.advanced())
        lost = ~(after.terminal >= -_ROUNDING * sizes[0])
        what = "the law leaves it within a control period"
        if not lost.any():
            lost = ~(after.height >= -_ROUNDING * sizes[1])
            what = "the law leads to an unsafe state within a control period"
    if lost.any():
        names = [s.name for s in plans.system.states]
        at = inside[:, lost.argmax()]
        where = ", ".join(f"{n} = {c:.6g}" for n, c in zip(names, at, strict=True))
        raise SystemDefinitionError(
            f"terminal set of backup law {plans.laws[j].name}: at {where}, which is in it, {what};"
            " state a set that the law keeps for good, or an equilibrium, from which one is"
            " derived and proved"
        )


def _at_edge(plans: Plans, j: int, inside: np.ndarray, outside: np.ndarray) -> Any:
    """Return states of the set between others in it and out of it, by bisection."""
    if not outside.size:
        return inside[:, :0]
    rng = np.random.default_rng(1)
    a, b = (e[:, rng.integers(e.shape[1], size=_COUNT)] for e in (inside, outside))
    for _ in range(_HALVINGS):
        middle = 0.5 * a + 0.5 * b
        kept = _Read(plans, j, middle).inside
        a, b = np.where(kept, middle, a), np.where(kept, b, middle)
    return a
