"""Barriers for the env's own steps with held input: linear programs, then the proof."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import HeldCertificate
from safe_envs.wrappers.certificates.held_step import held_period
from safe_envs.wrappers.certificates.statements import plant_of
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.certify import Named
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.held_program import (
    LinearClaims,
    SampledStep,
    StatePools,
    solve_claims,
)
from safe_envs.wrappers.synthesis.settings import SynthesisSettings
from safe_envs.wrappers.synthesis.synthesize import Progress, degrees_of
from safe_envs.wrappers.value.starts import draw_starts, sampling_margin
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.held_bound import HeldBound, prove_held_bound
from safe_envs.wrappers.verification.held_check import held_certificate

_DEGREES = {1: (8, 16), 2: (6, 12)}
_LAST_DEGREES = (4, 6)
_DECIMALS = 10
_STARTS = 50_000
"""Starts over which the bound of a certificate is averaged."""

_BETWEEN = (0.04, 0.12, 0.3, 0.5, 0.7, 0.88, 0.96)
"""Where between the ends of its bounds an input is sampled."""

_SLACK, _SLACK_LOST = 3e-5, 5e-3
"""By how much q is asked above its chord, over 4 t (1 - t), where the input acts most: no more than
this, and what costs no more than this part of the bound. With less of it the proof takes long."""

_FEWEST_ROUNDS = 4
_NEAR_ACTIVE, _NEAR_SAG = -0.03, -0.01
"""psi above which the claims about steps are asked: psi of the next program may be above 0."""

_LOST, _TOLERANCE = 2e-3, 2e-5
"""What the tolerances of m1 and m2 may cost of the bound, and the largest one."""

_BUDGET = Budget(seconds=20.0)


@dataclass(frozen=True)
class HeldAttempt:
    """What was found with a degree.

    Attributes:
        degree: total degree.
        members: number of coefficients.
        program: value of the linear program; None where it has no solution.
        sampled: mean bound by the violations at all sampled states.
        bound: what is proved, or why it is not; None where it was not tried.
        proved: its mean over the starts of the linear programs.
        seconds: of all.
    """

    degree: int
    members: int
    program: float | None
    sampled: float = 0.0
    bound: HeldBound | None = None
    proved: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True)
class HeldCertification:
    """What was found for a problem.

    Attributes:
        certificate: whose bound is proved; nothing where none was found.
        attempts: of each degree.
        mean: of the bound over the starts; 0 without one.
        starts: that were drawn for it; 1 where all are the same.
        margin: by which the mean over all starts may be lower, at 99.99 % confidence.
        seconds: of all.
    """

    certificate: HeldCertificate | None
    attempts: tuple[HeldAttempt, ...]
    mean: float
    starts: int
    margin: float
    seconds: float


class _Candidate(NamedTuple):
    coefficients: np.ndarray
    program: float
    sampled: float


def certify_held(
    named: Named, settings: SynthesisSettings, progress: Progress | None = None
) -> HeldCertification:
    """Look for a certificate of held input for every policy under its constraint, and prove it.

    Args:
        named: the problem.
        settings: of the search; there are no rates.
        progress: called with the part of the work that is done.

    Raises:
        ConfigurationError: The env takes several steps in a control period or has no noise, or
            there is not one input, or see `Domain` and `degrees_of`.
    """
    begin, problem = time.monotonic(), named.problem
    search = _Search(problem, settings)
    degrees = settings.degrees or _DEGREES.get(len(problem.states), _LAST_DEGREES)
    degrees = degrees_of(search.plant, replace(settings, degrees=degrees))
    attempts: list[HeldAttempt] = []
    for degree in degrees:
        if attempts and time.monotonic() - begin > settings.seconds:
            break
        attempts.append(search.attempt(degree, max((a.proved for a in attempts), default=0.0)))
        if progress is not None:
            progress(len(attempts) / len(degrees))
    best = max(attempts, key=lambda a: a.proved)
    if best.bound is None or best.proved <= 0.0:
        return HeldCertification(None, tuple(attempts), 0.0, 0, 0.0, time.monotonic() - begin)
    certificate = held_certificate(best.bound, problem.steps, named.env_id, dict(named.options))
    # Other starts than those for which psi was chosen.
    x = np.stack(draw_starts(problem, _STARTS, settings.seed + 1), axis=1)
    bounds = best.bound.held_bounds_at(search.domain.wrapped(x), problem.steps)
    numbers = (float(bounds.mean()), len(x), sampling_margin(bounds))
    return HeldCertification(certificate, tuple(attempts), *numbers, time.monotonic() - begin)


class _Search:
    """The search of one problem."""

    def __init__(self, problem: SafetyProblem, settings: SynthesisSettings) -> None:
        self.period: Fraction = held_period(problem)
        self.plant = plant_of(problem)
        self._step = SampledStep(self.plant, float(self.period))
        closed = tuple(not np.isfinite([v.low, v.high]).all() for v in problem.states)
        self.domain = Domain.of(self.plant, closed, settings.seed)
        starts = np.stack(draw_starts(problem, settings.starts, settings.seed), axis=1)
        self._starts = self.domain.wrapped(starts)
        self._steps, self._settings = problem.steps, settings
        self._frame = self._step.frame(self.domain)

    def attempt(self, degree: int, known: float) -> HeldAttempt:
        """Find a psi of a degree, and prove its numbers if they may be better than known ones.

        Args:
            degree: total degree.
            known: mean bound that is proved already.
        """
        begin = time.monotonic()
        basis = ChebyshevBasis(self.plant.states, *self._frame, degree, self.domain.even)
        members = len(basis.exponents)
        found = _Programs(self, basis).best()
        if found is None:
            return HeldAttempt(degree, members, None, seconds=time.monotonic() - begin)
        bound, proved = None, 0.0
        if found.sampled > known:
            psi = basis.polynomial(found.coefficients, _DECIMALS)
            tolerance = min(_TOLERANCE, _LOST / self._steps)
            bound = prove_held_bound(self.plant, psi, self.period, tolerance, _BUDGET)
            proved = float(bound.held_bounds_at(self._starts, self._steps).mean())
        seconds = time.monotonic() - begin
        return HeldAttempt(degree, members, found.program, found.sampled, bound, proved, seconds)


class _Programs:
    """The linear programs of a basis, each with states at which the psi before is violated."""

    def __init__(self, search: _Search, basis: ChebyshevBasis) -> None:
        self._basis, self._step = basis, search._step
        self._steps, self._settings = search._steps, search._settings
        self._rng = np.random.default_rng(search._settings.seed)
        self._pools = StatePools.of(search.domain, basis, self._rng)
        self._starts = basis.values(search._starts)
        self._domain = search.domain
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

    def best(self) -> _Candidate | None:
        """Return the psi with the largest mean bound at the sampled states."""
        low_end, high_end = self._step.bounds
        basis = self._basis
        raised = self._raised_by_high(self._safe)
        psi_safe, psi_bent = np.ones(len(self._safe)), np.ones(len(self._bent))
        counted = np.ones(len(self._starts), dtype=bool)
        best: _Candidate | None = None
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
                best = _Candidate(c, program, sampled)
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
