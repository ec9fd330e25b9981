"""Barriers for the env's own steps with held input: linear programs, then the proof.

The theorem is in `safe_envs.proofs.held`. With one input in its bounds and q(u) = E psi(F(x, u,
xi)), psi is asked for

- q(u) >= psi - m at the better end of the bounds, so that the constraint can be met,
- q at samples of u between the ends not below its chord, so that each input under it may be used,
- psi <= 1 on C inside the workspace, and psi <= 0 on the rest of a box that no step leaves.

Which end is the better one, and where psi > 0, is taken from the psi before.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import HeldCertificate, Plant
from safe_envs.filters.certificates.held_step import held_period
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.problem.actuators import require_direct
from safe_envs.proofs.certify import Named, Progress, SynthesisSettings, degrees_of
from safe_envs.proofs.held import HeldBound, held_certificate, prove_held_bound
from safe_envs.proofs.judge import Budget
from safe_envs.proofs.linear_program import ChebyshevBasis, Domain, at_states
from safe_envs.values.look_ahead import draw_starts, sampling_margin

_DEVIATIONS = 9.0
"""How far the noise of a step is followed, in standard deviations."""

_POOL, _BORDER, _HALVINGS = 30_000, 250, 45
_WIDENED = 1.005


@dataclass(frozen=True, eq=False)
class SampledStep:
    """One step of the env at states, for one input.

    Attributes:
        plant: the system, without a policy.
        period: control period in s.

    Raises:
        ConfigurationError: There is not one input, or one noise acts on several states.
    """

    plant: Plant
    period: float

    def __post_init__(self) -> None:
        count, rows = len(self.plant.inputs), self.plant.diffusion
        if count != 1:
            raise ConfigurationError(
                f"the system has {count} inputs; a barrier for held input is looked for with one"
                " input. Leave --held out"
            )
        if any(sum(entry != 0 for entry in column) > 1 for column in zip(*rows, strict=True)):
            raise ConfigurationError(
                "the same noise acts on several states; a barrier for held input is looked for"
                " where each noise acts on one state. Leave --held out"
            )

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """The bounds of the input."""
        ((low, high),) = self.plant.bounds
        return float(low), float(high)

    @cached_property
    def _functions(self) -> tuple:
        p = self.plant
        variances = [sum(e**2 for e in row) for row in p.diffusion]
        parts = (p.drift, [row[0] for row in p.input_matrix], variances)
        return tuple(compile_function(p.states, tuple(part), "arrays") for part in parts)

    def effect(self, x: np.ndarray) -> np.ndarray:
        """Return g at states (B, n), shape (B, n)."""
        return at_states(self._functions[1], x)

    def means(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the mean of X'.

        Args:
            x: states, shape (B, n).
            u: inputs, shape (B,).

        Returns:
            Shape (B, n).
        """
        return x + self.period * (at_states(self._functions[0], x) + self.effect(x) * u[:, None])

    def deviations(self, x: np.ndarray) -> np.ndarray:
        """Return the standard deviations of X' at states (B, n), shape (B, n)."""
        return np.sqrt(self.period * at_states(self._functions[2], x))

    def expected(self, basis: ChebyshevBasis, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the expectations of the members of a basis after a step, exactly.

        Args:
            basis: of polynomials.
            x: states, shape (B, n).
            u: inputs, shape (B,).

        Returns:
            Shape (B, K).
        """
        nodes, weights = np.polynomial.hermite_e.hermegauss(basis.degree // 2 + 1)
        weights = weights / weights.sum()
        mean, spread = self.means(x, u), self.deviations(x)
        found = np.ones((len(x), len(basis.exponents)))
        for i in range(x.shape[1]):
            moved = mean[:, i, None] + spread[:, i, None] * nodes
            z = (moved - float(basis.center[i])) / float(basis.scale[i])
            along = np.polynomial.chebyshev.chebvander(z, basis.degree)
            found *= np.einsum("bqk,q->bk", along, weights)[:, basis.exponents[:, i]]
        return found

    def frame(self, domain: Domain) -> tuple[tuple[Fraction, ...], tuple[Fraction, ...]]:
        """Return the center and half widths of a box that no step from C leaves, n of each.

        Args:
            domain: the safe set.
        """
        x = domain.bank
        spread = _DEVIATIONS * self.deviations(x)
        ends = [x]
        for u in self.bounds:
            mean = self.means(x, np.full(len(x), u))
            ends += [mean - spread, mean + spread]
        low, high = (np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1)))
        if domain.even:
            high = np.maximum(high, -low)
            low = -high
        center, half = (low + high) / 2.0, _WIDENED * (high - low) / 2.0
        return (
            tuple(Fraction(f"{c:.6g}") for c in center.tolist()),
            tuple(Fraction(f"{r:.6g}") for r in half.tolist()),
        )


@dataclass(frozen=True, eq=False)
class StatePools:
    """States of the range of psi at which psi is looked at.

    Attributes:
        safe: of C inside the workspace, the ones next to its edge first, shape (B, n).
        unsafe: the others, the ones next to the edge first, shape (D, n).
        border: unsafe ones on the border of the range of psi and in its corners, shape (E, n).
        near: number of states next to the edge that both begin with.
    """

    safe: np.ndarray
    unsafe: np.ndarray
    border: np.ndarray
    near: int

    @classmethod
    def of(cls, domain: Domain, basis: ChebyshevBasis, rng: np.random.Generator) -> StatePools:
        """Return states of the range of a basis.

        Args:
            domain: the safe set.
            basis: whose scaled variables are in [-1, 1] there.
            rng: of the draws.
        """
        n = len(basis.states)
        center, half = (np.array(p, dtype=float) for p in (basis.center, basis.scale))
        box = center + half * (2.0 * rng.random((_POOL, n)) - 1.0)
        inside = domain.inside(box)
        safe, unsafe = np.concatenate([domain.bank, box[inside]]), box[~inside]
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * n), axis=-1).reshape(-1, n)
        faces = [corners]
        for i in range(n if n > 1 else 0):
            for end in (-1.0, 1.0):
                z = np.cos(np.pi * rng.random((_BORDER, n)))
                z[:, i] = end
                faces.append(z)
        border = center + half * np.concatenate(faces)
        border = border[~domain.inside(border)]
        unsafe = np.concatenate([unsafe, border])
        a = safe[rng.integers(len(safe), size=_POOL // 3)]
        b = unsafe[rng.integers(len(unsafe), size=_POOL // 3)]
        for _ in range(_HALVINGS):
            middle = (a + b) / 2.0
            within = domain.inside(middle)[:, None]
            a, b = np.where(within, middle, a), np.where(within, b, middle)
        layer = a + (safe.mean(axis=0) - a) * 0.15 * rng.random((len(a), 1)) ** 2
        safe = rng.permutation(np.concatenate([layer[domain.inside(layer)], safe]))
        unsafe = np.concatenate([b, rng.permutation(unsafe)])
        return cls(np.concatenate([a, safe]), unsafe, border, len(a))


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


_DEGREES = {1: (8, 16), 2: (6, 12)}
_LAST_DEGREES = (4, 6)
_DECIMALS = 10
_STARTS = 50_000
"""Starts over which the bound of a certificate is averaged."""

_LOST, _TOLERANCE = 2e-3, 2e-5
"""What the tolerances of m1 and m2 may cost of the bound, and the largest one."""

_SEARCHED = 0.6
"""Part of the work that is the linear programs', for the progress."""

_BUDGET = Budget(seconds=20.0)


@dataclass(frozen=True)
class HeldAttempt:
    """What was found with a degree.

    Attributes:
        degree: total degree.
        members: number of coefficients.
        program: value of the linear program; None where it has no solution.
        sampled: mean bound by the violations at all sampled states.
        psi: the polynomial; None without a solution.
        bound: what is proved, or why it is not; None where it was not tried.
        proved: its mean over the starts of the linear programs.
        seconds: of all.
    """

    degree: int
    members: int
    program: float | None
    sampled: float = 0.0
    psi: Polynomial | None = None
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
    require_direct(problem, "certificates")
    degrees_of(problem.plant, settings)  # What is too large is refused before it takes time.
    period, plant = held_period(problem), plant_of(problem)
    step = SampledStep(plant, float(period))
    closed = tuple(not np.isfinite([v.low, v.high]).all() for v in problem.states)
    domain = Domain.of(plant, closed, settings.seed)
    starts = np.stack(draw_starts(problem, settings.starts, settings.seed), axis=1)
    task = HeldTask(step, domain, domain.wrapped(starts), problem.steps)
    attempts = _attempts(task, settings, progress)
    attempts = _proved(task, attempts, period)
    if progress is not None:
        progress(1.0)
    best = max(attempts, key=lambda a: a.proved)
    if best.bound is None or best.proved <= 0.0:
        return HeldCertification(None, attempts, 0.0, 0, 0.0, time.monotonic() - begin)
    certificate = held_certificate(best.bound, problem.steps, named.env_id, dict(named.options))
    # Other starts than those for which psi was chosen.
    x = np.stack(draw_starts(problem, _STARTS, settings.seed + 1), axis=1)
    bounds = best.bound.held_bounds_at(domain.wrapped(x), problem.steps)
    numbers = (float(bounds.mean()), len(x), sampling_margin(bounds))
    return HeldCertification(certificate, attempts, *numbers, time.monotonic() - begin)


def _attempts(
    task: HeldTask, settings: SynthesisSettings, progress: Progress | None
) -> tuple[HeldAttempt, ...]:
    """Find a psi of each degree, until the time is over."""
    begin, plant = time.monotonic(), task.step.plant
    wanted = settings.degrees or _DEGREES.get(len(plant.states), _LAST_DEGREES)
    degrees = degrees_of(plant, replace(settings, degrees=wanted))
    frame, found = task.step.frame(task.domain), []
    for degree in degrees:
        since = time.monotonic()
        if found and since - begin > settings.seconds:
            break
        basis = ChebyshevBasis(plant.states, *frame, degree, task.domain.even)
        best, members = HeldPrograms(task, basis, settings).best(), len(basis.exponents)
        attempt = HeldAttempt(degree, members, None)
        if best is not None:
            psi = basis.polynomial(best.coefficients, _DECIMALS)
            attempt = HeldAttempt(degree, members, best.program, best.sampled, psi)
        if found and found[-1].sampled > attempt.sampled:
            # What is of a lower degree is of this one too.
            attempt = replace(found[-1], degree=degree, members=members)
        found.append(replace(attempt, seconds=time.monotonic() - since))
        if progress is not None:
            progress(_SEARCHED * len(found) / len(degrees))
    return tuple(found)


def _proved(
    task: HeldTask, attempts: tuple[HeldAttempt, ...], period: Fraction
) -> tuple[HeldAttempt, ...]:
    """Prove the numbers of each psi, the best one first, until no other can have a larger bound."""
    found, best = list(attempts), 0.0
    tolerance = min(_TOLERANCE, _LOST / task.steps)
    for i in sorted(range(len(found)), key=lambda k: -found[k].sampled):
        attempt, begin = found[i], time.monotonic()
        before = found[i - 1] if i else None
        if before is not None and before.psi is attempt.psi:
            found[i] = replace(attempt, bound=before.bound, proved=before.proved)
            continue
        if attempt.psi is None or attempt.sampled <= best:
            continue
        bound = prove_held_bound(task.step.plant, attempt.psi, period, tolerance, _BUDGET)
        mean = float(bound.held_bounds_at(task.starts, task.steps).mean())
        seconds = attempt.seconds + time.monotonic() - begin
        found[i] = replace(attempt, bound=bound, proved=mean, seconds=seconds)
        best = max(best, mean)
    return tuple(found)
