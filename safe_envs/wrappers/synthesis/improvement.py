"""Linear programs in turn with better inputs, and with the states at which the last one failed."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.generator import Generator, Samples
from safe_envs.wrappers.synthesis.linear_program import Claims, MeanBound, solve
from safe_envs.wrappers.synthesis.reference import AskedClaims, Reference, worst
from safe_envs.wrappers.synthesis.settings import SynthesisSettings
from safe_envs.wrappers.synthesis.witnesses import Witness

_POOL, _RIM = 20_000, 4000
"""States of C, and of its edge, at which each barrier is looked at."""

_SHIFTS = (0.0, 0.003, 0.01, 0.03, 0.1)
"""By how much psi may be lowered, so that states where it is small count no more."""

_SIZES, _TRIALS = (0.02, 0.01, 0.005, 0.002, 0.001), 8
"""Steps, for the width of C 2, with which worse states are looked for, and the tries of each."""

_BANDS = (0.2, 0.1, 0.05, 0.02)
"""Bands of the given inputs, one after the other, for a horizon of 1 s."""

_MOST_CUTS = 5
"""Linear programs with the same given inputs."""

_FEWEST = 4
"""Linear programs of a degree, with time or without: the first ones know too few states."""

_NEAR_ONE = 0.7
"""Part of the supremum from which states may become the largest."""


@dataclass(frozen=True, eq=False)
class Improvement:
    """What is the same for all barriers of a problem.

    Attributes:
        domain: the safe set.
        generator: of the plant.
        starts: initial states, shape (B, n).
        settings: of the synthesis.
        extra: states at which the inequalities are asked besides those drawn, shape (B, n).
    """

    domain: Domain
    generator: Generator
    starts: np.ndarray
    settings: SynthesisSettings
    extra: np.ndarray | None = None


class CuttingPlanes:
    """The linear programs of a basis, each with more states.

    Args:
        improvement: what is the same for all.
        basis: of the barrier.
        bound: to maximise.
        first: inputs for the first linear program, or a barrier that they are to raise most.

    Attributes:
        best: the best barrier so far; None where no linear program has a solution.
        references: number of inputs that were given so far.
    """

    def __init__(
        self,
        improvement: Improvement,
        basis: ChebyshevBasis,
        bound: MeanBound,
        first: Witness | BarrierCandidate,
    ) -> None:
        self._all, self._basis, self._bound = improvement, basis, bound
        self._rng = np.random.default_rng([improvement.settings.seed, basis.degree])
        members, draw = len(basis.exponents), improvement.domain
        x = draw.draw(500 + 6 * members, self._rng)
        if improvement.extra is not None:
            x = np.concatenate([x, improvement.extra])
        self._points = improvement.generator.samples(basis, x)
        self._edge = basis.values(draw.draw_edge(200 + 2 * members, self._rng))
        self._starts = basis.values(improvement.starts)
        self._weights = self._starts.mean(axis=0)
        self._last: np.ndarray | None = None
        self.best: BarrierCandidate | None = None
        self.references, self._cuts, self._done = 0, 0, 0
        self._next: tuple[BarrierCandidate, np.ndarray] | None = None
        self._refer(first, x)

    def improve(
        self, rounds: int, deadline: float = math.inf, least: float = -math.inf
    ) -> BarrierCandidate | None:
        """Solve linear programs.

        Args:
            rounds: linear programs at most, those before counted too.
            deadline: time, as of `time.monotonic`, after which few more are begun.
            least: mean bound below which the value of a linear program ends the rounds.

        Returns:
            The best barrier so far; nothing where no linear program has a solution.
        """
        tolerance = self._all.settings.tolerance
        while self._done < rounds:
            candidate = self._solved()
            if candidate is None:
                break
            if self.best is None or candidate.mean > self.best.mean:
                self.best = candidate
            if candidate.program < least:
                break
            if time.monotonic() > deadline and self._done >= _FEWEST:
                break
            referred = self.references > 1 or self._next is not None
            if referred and self.best.program - self.best.mean < tolerance:
                break
        return self.best

    def _refer(self, given: Witness | BarrierCandidate, states: np.ndarray) -> None:
        """Take other inputs as given."""
        band = _BANDS[min(self.references, len(_BANDS) - 1)] / self._bound.spent
        self._reference = Reference(self._all.generator, self._all.domain, given, band)
        near = self._reference.sign_changes(states)
        self._points = self._points.joined(self._all.generator.samples(self._basis, near))
        self._asked = self._reference.asked(self._basis, self._points)
        self.references, self._cuts, self._next = self.references + 1, 0, None

    def _solved(self) -> BarrierCandidate | None:
        """Solve a linear program, and add what it does not meet; nothing without a solution."""
        self._done += 1
        if self._next is not None:
            self._refer(*self._next)
        asked, points, bound = self._asked.generator, self._points, self._bound
        high = np.ones(len(asked), dtype=bool)
        if self._last is not None:
            high = points.values @ self._last > _NEAR_ONE
        part = points.only(asked)
        claims = Claims(
            part.along(self._asked.inputs[asked]) + bound.rate * part.values,
            points.values[asked & high],
            np.concatenate([self._edge, points.values[~asked]]),
        )
        solution = solve(claims, bound, self._weights)
        if solution is None:
            return None
        c, m = self._last, _ = solution
        value = bound.mean(self._starts @ c, m, 1.0)
        raw = BarrierCandidate(self._basis, c, bound, m, 1.0, 0.0, value, self._done)
        pool = self._all.generator.samples(self._basis, self._all.domain.draw(_POOL, self._rng))
        rim = self._basis.values(self._all.domain.draw_edge(_RIM, self._rng))
        bad, bad_asked, cost = self._sharpened(pool, c, m)
        found = self._measured(
            raw, pool.joined(points).joined(bad), np.concatenate([rim, self._edge])
        )
        self._add_edge(rim, c)
        tolerance = self._all.settings.tolerance
        new = cost > 0.3 * tolerance
        self._points = points.joined(bad.only(new))
        self._cuts += 1
        if self._cuts == _MOST_CUTS or cost.max(initial=0.0) < 2.0 * tolerance:
            self._next = (raw, pool.states)
        else:
            self._asked = self._asked.joined(bad_asked.only(new))
        counts = self._starts @ c * bound.decay > m * bound.spent
        if counts.any():
            # Starts without a bound lose nothing where psi gets smaller still.
            self._weights = (self._starts * counts[:, None]).mean(axis=0)
        return found

    def _add_edge(self, rim: np.ndarray, c: np.ndarray) -> None:
        """Add the states of the edge where psi is largest, if it is above 0."""
        excess = rim @ c
        order = np.argsort(-excess)[: 2 * len(c)]
        above = order[excess[order] > 0.1 * self._all.settings.tolerance]
        self._edge = np.concatenate([self._edge, rim[above]])

    def _cost(self, samples: Samples, asked: AskedClaims, c: np.ndarray, m: float) -> np.ndarray:
        """Return the part of the bound that violations at states cost, shape (B,)."""
        psi, effect = samples.values @ c, samples.inputs @ c
        rate = samples.drift @ c + (asked.inputs * effect).sum(axis=1) + self._bound.rate * psi
        cost = np.where(asked.generator, -(rate + m) * self._bound.spent, psi)
        return np.maximum(cost, psi - 1.0)

    def _sharpened(
        self, pool: Samples, c: np.ndarray, m: float
    ) -> tuple[Samples, AskedClaims, np.ndarray]:
        """Return the worst states of many, moved to worse ones near them, and their costs."""
        domain, generator, basis = self._all.domain, self._all.generator, self._basis
        asked = self._reference.asked(basis, pool)
        cost = self._cost(pool, asked, c, m)
        cells = domain.cells(pool.states, 10 * len(c))
        chosen = worst(cost, cells, np.isfinite(cost), 100 + 2 * len(c))
        found, asked, cost = pool.only(chosen), asked.only(chosen), cost[chosen]
        scale = np.array([float(s) for s in domain.frame[1]])
        for size in _SIZES:
            before = np.repeat(found.states, _TRIALS, axis=0)
            x = before + size * scale * self._rng.standard_normal(before.shape)
            x = np.where(domain.inside(x)[:, None], x, before)
            tried = generator.samples(basis, x)
            tried_asked = self._reference.asked(basis, tried)
            costs = self._cost(tried, tried_asked, c, m).reshape(-1, _TRIALS)
            better = costs.max(axis=1) > cost
            best = (costs.argmax(axis=1) + _TRIALS * np.arange(len(costs)))[better]
            found = found.only(~better).joined(tried.only(best))
            asked = asked.only(~better).joined(tried_asked.only(best))
            cost = np.concatenate([cost[~better], costs.ravel()[best]])
        return found, asked, cost

    def _measured(
        self, given: BarrierCandidate, pool: Samples, edge: np.ndarray
    ) -> BarrierCandidate:
        """Return a barrier lowered so that its bound at many states is largest."""
        c, bound = given.coefficients, given.bound
        psi = pool.values @ c
        rate = self._all.generator.largest_rate(pool, c) + bound.rate * psi
        least = max(0.0, float((edge @ c).max(initial=0.0)))
        starts, best = self._starts @ c, None
        for shift in _SHIFTS:
            shift += least
            counts = psi > shift
            supremum = float(psi.max()) - shift
            if not counts.any() or supremum <= 0.0:
                break
            m = max(0.0, float((bound.rate * shift - rate[counts]).max()))
            mean = bound.mean(starts - shift, m, supremum)
            if best is None or mean > best.mean:
                lowered = np.append(c[0] - shift, c[1:])
                best = replace(
                    given, coefficients=lowered, shortfall=m, supremum=supremum, mean=mean
                )
        return best if best is not None else given
