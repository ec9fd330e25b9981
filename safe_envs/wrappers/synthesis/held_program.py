"""The linear program of a barrier for held input, and the states at which it asks for its claims.

The theorem is in `held_bound`. With one input in its bounds and q(u) = E psi(F(x, u, xi)), psi is
asked for

- q(u) >= psi - m at the better end of the bounds, so that the constraint can be met,
- q at samples of u between the ends not below its chord, so that each input under it may be used,
- psi <= 1 on C inside the workspace, and psi <= 0 on the rest of a box that no step leaves.

Which end is the better one, and where psi > 0, is taken from the psi before.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.held_samples import SampledStep, StatePools
from safe_envs.wrappers.synthesis.settings import SynthesisSettings

_MOST_COEFFICIENT = 60.0
_SECONDS, _TIME_OVER = 20.0, 1

_BETWEEN = (0.04, 0.12, 0.3, 0.5, 0.7, 0.88, 0.96)
"""Where between the ends of its bounds an input is sampled."""

_SLACK, _SLACK_LOST = 3e-5, 5e-3
"""By how much q is asked above its chord, over 4 t (1 - t), where the input acts most: no more than
this, and what costs no more than this part of the bound. With less of it the proof takes long."""

_FEWEST_ROUNDS = 4
_NEAR_ACTIVE, _NEAR_SAG = -0.03, -0.01
"""psi above which the claims about steps are asked: psi of the next program may be above 0."""


@dataclass(frozen=True)
class LinearClaims:
    """LinearClaims of a linear program: matrix @ (coefficients, m) <= limits.

    Attributes:
        matrix: shape (B, K + 1).
        limits: shape (B,).
    """

    matrix: np.ndarray
    limits: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, limit: float | np.ndarray, m: float = 0.0) -> LinearClaims:
        """Return claims with one coefficient of m.

        Args:
            matrix: of the coefficients of psi, shape (B, K).
            limit: of each, or of all.
            m: coefficient of m.
        """
        last = np.full((len(matrix), 1), m)
        return cls(np.hstack([matrix, last]), np.broadcast_to(limit, len(matrix)))


def solve_claims(
    claims: list[LinearClaims], cost: np.ndarray
) -> tuple[np.ndarray, float, float] | None:
    """Return the coefficients, m and the value of a linear program.

    Args:
        claims: that are met.
        cost: that is least, of the coefficients and of m >= 0, shape (K + 1,).

    Returns:
        Coefficients, shape (K,), m and minus the least cost; nothing without a solution.
    """
    from scipy.optimize import linprog

    matrix = np.concatenate([r.matrix for r in claims])
    limits = np.concatenate([r.limits for r in claims])
    sizes = np.maximum(np.abs(matrix).max(axis=1), 1e-9)
    ranges = [(-_MOST_COEFFICIENT, _MOST_COEFFICIENT)] * (len(cost) - 1) + [(0.0, None)]
    found = linprog(
        cost,
        matrix / sizes[:, None],
        limits / sizes,
        bounds=ranges,
        method="highs-ipm",
        options={"time_limit": _SECONDS},
    )
    if found.x is None or found.status == _TIME_OVER or not math.isfinite(found.fun):
        return None
    return found.x[:-1], float(found.x[-1]), -float(found.fun)


@dataclass(frozen=True, eq=False)
class HeldTask:
    """What is asked of a barrier for held input.

    Attributes:
        step: of the env.
        domain: the safe set.
        starts: over which the bound is averaged, shape (B, n).
        steps: K, control periods of an episode.
    """

    step: SampledStep
    domain: Domain
    starts: np.ndarray
    steps: int


class HeldCandidate(NamedTuple):
    """A psi, of which nothing is proved.

    Attributes:
        coefficients: of the basis, shape (K,).
        program: value of the linear program.
        sampled: mean bound by the violations at all sampled states.
    """

    coefficients: np.ndarray
    program: float
    sampled: float


class HeldPrograms:
    """The linear programs of a basis, each with states at which the psi before is violated."""

    def __init__(self, task: HeldTask, basis: ChebyshevBasis, settings: SynthesisSettings) -> None:
        self._basis, self._step, self._domain = basis, task.step, task.domain
        self._steps, self._settings = task.steps, settings
        self._rng = np.random.default_rng(settings.seed)
        self._pools = StatePools.of(task.domain, basis, self._rng)
        self._starts = basis.values(task.starts)
        members, near, pools = len(basis.exponents), self._pools.near, self._pools
        many = 300 + 15 * members
        self._safe = np.concatenate([pools.safe[:many], pools.safe[near : near + 3 * many]])
        self._unsafe = np.concatenate(
            [pools.unsafe[: 2 * many], pools.unsafe[near : near + many], pools.border]
        )
        x = self._safe[::4]
        self._bent = np.tile(x, (len(_BETWEEN), 1))
        self._places = np.repeat(_BETWEEN, len(x))
        self._most = float((self._step.effect(pools.safe) ** 2).sum(axis=1).max())

    def best(self) -> HeldCandidate | None:
        """Return the psi with the largest mean bound at the sampled states."""
        low_end, high_end = self._step.bounds
        basis = self._basis
        raised = self._raised_by_high(self._safe)
        psi_safe, psi_bent = np.ones(len(self._safe)), np.ones(len(self._bent))
        counted = np.ones(len(self._starts), dtype=bool)
        best: HeldCandidate | None = None
        begin = time.monotonic()
        for turn in range(self._settings.rounds):
            active, bent = psi_safe > _NEAR_ACTIVE, psi_bent > _NEAR_SAG
            x = self._safe[active]
            values = basis.values(self._safe)
            ends = np.where(raised[active], high_end, low_end)
            falls = values[active] - self._step.expected(basis, x, ends)
            sags = self._sags(self._bent[bent], self._places[bent])
            claims = [
                LinearClaims.of(falls, 0.0, -1.0),
                LinearClaims.of(values, 1.0),
                LinearClaims.of(basis.values(self._unsafe), 0.0),
                LinearClaims.of(sags, -self._slack(self._bent[bent])),
            ]
            weights = self._starts[counted].sum(axis=0) / len(self._starts)
            found = solve_claims(claims, np.append(-weights, self._steps * counted.mean()))
            if found is None:
                break
            c, m, program = found
            sampled = self._extended(c, m, add=turn > 0)
            if best is None or sampled > best.sampled:
                best = HeldCandidate(c, program, sampled)
            near = program - sampled < self._settings.tolerance / 2.0
            late = time.monotonic() - begin > self._settings.seconds
            if (turn + 1 >= _FEWEST_ROUNDS and near) or late:
                break
            psi_safe, psi_bent = basis.values(self._safe) @ c, basis.values(self._bent) @ c
            raised = np.zeros(len(self._safe), dtype=bool)
            some = psi_safe > _NEAR_ACTIVE
            at_ends = [
                self._step.expected(basis, self._safe[some], np.full(some.sum(), u)) @ c
                for u in (low_end, high_end)
            ]
            raised[some] = at_ends[1] > at_ends[0]
            counted = self._starts @ c - m * self._steps > 0.0
            if not counted.any():
                break
        return best

    def _raised_by_high(self, x: np.ndarray) -> np.ndarray:
        """Return where the upper end of the input leads further inside than the lower one."""
        scale = self._levels(self._domain.bank).max(axis=0)
        after = [
            (self._levels(self._step.means(x, np.full(len(x), u))) / scale).min(axis=1)
            for u in self._step.bounds
        ]
        return after[1] > after[0]

    def _levels(self, x: np.ndarray) -> np.ndarray:
        """Return the smallest h, and the distances to the ends of the workspace."""
        d = self._domain
        return np.column_stack([d.level(x), x - d.low, d.high - x])

    def _sags(self, x: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return how far the members are below their chords, over 4 t (1 - t), shape (B, K)."""
        low, high = self._step.bounds
        at_low, at_high, between = (
            self._step.expected(self._basis, x, u)
            for u in (np.full(len(x), low), np.full(len(x), high), low + t * (high - low))
        )
        part = t[:, None]
        return ((1.0 - part) * at_low + part * at_high - between) / (4.0 * part * (1.0 - part))

    def _slack(self, x: np.ndarray) -> np.ndarray:
        slack = min(_SLACK, _SLACK_LOST / self._steps)
        return slack * (self._step.effect(x) ** 2).sum(axis=1) / max(self._most, 1e-300)

    def _extended(self, c: np.ndarray, m: float, add: bool) -> float:
        """Return the mean bound by the violations at all states, and add the worst of them."""
        basis, rng = self._basis, self._rng
        psi, outer = (basis.values(x) @ c for x in (self._pools.safe, self._pools.unsafe))
        g, value = self._pools.safe[psi > 0.0], psi[psi > 0.0]
        if not len(g):
            return 0.0
        at_low, at_high = (
            self._step.expected(basis, g, np.full(len(g), u)) @ c for u in self._step.bounds
        )
        fall = value - np.maximum(at_low, at_high)
        t = rng.random(len(g))
        ends = rng.random(len(g)) < 0.3
        t[ends] = rng.choice([0.02, 0.05, 0.95, 0.98], size=ends.sum())
        sag = self._sags(g, t) @ c
        below = 4.0 * t * (1.0 - t) * sag
        met = (1.0 - t) * at_low + t * at_high >= value - max(fall.max(), m)
        loss = max(0.0, fall.max()) + max(0.0, np.where(met, below, 0.0).max())
        left = self._starts @ c - self._steps * loss - max(0.0, outer.max())
        if add:
            self._safe = np.concatenate([self._safe, g[self._worst(fall - m, 250, 1e-7)]])
            worst = self._pools.unsafe[self._worst(outer, 500, 1e-7)]
            self._unsafe = np.concatenate([self._unsafe, worst])
            bent = self._worst(sag + self._slack(g), 400, 1e-6)
            self._bent = np.concatenate([self._bent, g[bent]])
            self._places = np.concatenate([self._places, t[bent]])
        return float((left / max(1.0, psi.max())).clip(0.0, 1.0).mean())

    def _worst(self, cost: np.ndarray, most: int, above: float) -> np.ndarray:
        """Return indices of some of the largest costs."""
        order = np.argsort(-cost)[: 6 * most]
        order = order[cost[order] > above]
        return self._rng.permutation(order)[:most]
