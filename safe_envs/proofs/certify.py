"""Barrier certificates of problems: linear programs find psi, and the judge proves its numbers."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.proofs.guarantees import CertificateStatements, rounded_up
from safe_envs.proofs.judge import Budget, judge, supremum
from safe_envs.proofs.linear_program import (
    AskedClaims,
    BarrierCandidate,
    ChebyshevBasis,
    Claims,
    Domain,
    Generator,
    MeanBound,
    Reference,
    Samples,
    Witness,
    solve,
    witnesses_of,
    worst,
)
from safe_envs.values.look_ahead import draw_starts, sampling_margin

_MOST_DEGREE = 20


@dataclass(frozen=True)
class SynthesisSettings:
    """How a polynomial barrier is looked for.

    Attributes:
        degrees: total degrees of psi that are tried, in increasing order, after the lower ones of
            those that suit the number of states; () for these, as long as each is better.
        rates: a of the bound, each >= 0, in 1/s; () for 0 and some in proportion to 1/T.
        rounds: linear programs of a degree, at most, each with the states added at which the one
            before is violated.
        starts: initial states over which the bound is averaged in the linear programs.
        tolerance: part of the bound that violations between the sampled states may cost.
        seconds: after which no other degree is begun.
        seed: of all draws.

    Raises:
        ConfigurationError: A degree, a rate or a number is out of range.
    """

    degrees: tuple[int, ...] = ()
    rates: tuple[float, ...] = ()
    rounds: int = 16
    starts: int = 4000
    tolerance: float = 2e-3
    seconds: float = 25.0
    seed: int = 0

    def __post_init__(self) -> None:
        for degree in self.degrees:
            require_whole("degree", degree, 1)
            if degree > _MOST_DEGREE:
                raise ConfigurationError(
                    f"degree = {degree}; polynomials up to degree {_MOST_DEGREE} are looked for:"
                    " linear programs of higher ones are too ill-conditioned"
                )
        for rate in self.rates:
            if not 0.0 <= rate < math.inf:
                raise ConfigurationError(
                    f"rate = {shown(rate)} 1/s; give a finite number of at least 0, since a bound"
                    " does not hold for a negative one"
                )
        require_whole("rounds", self.rounds, 1)
        require_whole("starts", self.starts, 1)
        require_whole("seed", self.seed, 0)
        if not 0.0 < self.tolerance < 1.0 or not self.seconds > 0.0:
            raise ConfigurationError(
                f"tolerance = {shown(self.tolerance)} and seconds = {shown(self.seconds)}; the"
                " tolerance is in (0, 1), the seconds are above 0"
            )


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


Progress = Callable[[float], None]

_DEGREES = {1: (8, 14, 20), 2: (6, 10, 14, 16), 3: (4, 6, 8), 4: (2, 4)}
_LAST_DEGREES = (2,)
_MOST_STATES = 6
"""With more states neither the search nor the proof, which bisects along all, ends in minutes."""

_MOST_MEMBERS = 800
"""Members of a basis up to which linear programs are fast enough."""

_RATES = (0.0, 0.1, 0.5, 1.0)
"""Rates that are tried, for 1/T."""

_FIRST_ROUNDS = 3
_NOTHING = 1e-3
"""Mean bound from which a barrier is one."""

_NEAR, _STEP = 64, 0.01
"""States drawn near one where the inequality fails, and how far, for the width of C 2."""


@dataclass(frozen=True)
class Task:
    """What is asked for: a barrier for starts up to a horizon.

    Attributes:
        plant: the system.
        horizon: T in s.
        starts: initial states over which the bound is averaged, shape (B, n).
        closed: states of which the workspace holds one period, where episodes do not end, n flags.
        nominal: laws of the nominal controller, of the states; () where they are unknown.
    """

    plant: Plant
    horizon: float
    starts: np.ndarray
    closed: tuple[bool, ...]
    nominal: tuple[sp.Expr, ...] = ()


@dataclass(frozen=True)
class Attempt:
    """The best barrier of a degree.

    Attributes:
        degree: total degree.
        members: coefficients that the linear programs find.
        candidate: the barrier; nothing where none was found with a bound above 0.
        inputs: what the first linear program took for the input.
        seconds: of computing.
        carried: whether the barrier is that of the degree before, than which none is better.
    """

    degree: int
    members: int
    candidate: BarrierCandidate | None
    inputs: str
    seconds: float
    carried: bool = False


class Synthesis:
    """Barriers of a task by linear programs, whose numbers hold where states were sampled.

    The input, for which a linear program needs a formula, is the one that raises the barrier of the
    program before it most: so each program can keep the last barrier, but for the states added.

    Args:
        task: what is asked for.
        settings: of the search.

    Attributes:
        domain: the safe set.
        starts: those of the task that are in it, their angles within the period.

    Raises:
        ConfigurationError: There are too many states, or no state of C was found, or no start is in
            it, or the workspace is unbounded.
        NumericalError: The system has no finite value at a state of C.
    """

    def __init__(self, task: Task, settings: SynthesisSettings) -> None:
        self._task, self._settings = task, settings
        self._degrees = _climbed(degrees_of(task.plant, settings), len(task.plant.states))
        self.domain = Domain.of(task.plant, task.closed, settings.seed)
        generator = Generator(task.plant)
        starts = self.domain.wrapped(task.starts)
        self.starts = starts[self.domain.inside(starts)]
        if not len(self.starts):
            raise ConfigurationError("no start is in the safe set and in the workspace")
        self._improvement = Improvement(self.domain, generator, self.starts, settings)
        self._laws = witnesses_of(generator, self.domain, task.nominal)
        rates = settings.rates or [float(f"{r / task.horizon:.6g}") for r in _RATES]
        self._bounds = [MeanBound(rate, task.horizon) for rate in rates]

    def attempts(self, progress: Progress | None = None) -> tuple[Attempt, ...]:
        """Return the best barrier of each degree, which is never worse than that of a lower one.

        Args:
            progress: called with the part of the work that is done.

        Returns:
            Attempts of increasing degree. Where the settings list none, a degree that is no better
            than the one before, or nothing to gain, ends them. Where the time is over only the
            lowest degree of the settings is begun.
        """
        deadline = time.monotonic() + self._settings.seconds
        lowest = min(self._settings.degrees, default=None)
        found, last, first, name = list[Attempt](), None, None, ""
        for k, degree in enumerate(self._degrees):
            started = time.monotonic()
            if found and started > deadline and degree != lowest:
                continue
            basis = ChebyshevBasis(
                self._task.plant.states, *self.domain.frame, degree, self.domain.even
            )
            before = None if last is None else last.embedded(basis)
            if first is None:
                planes, name = self._begun(basis)
                # The next degree starts from the first rounds: more of them fix the inputs and
                # the set where psi > 0, and end lower, as measured for CubicSDE and Pendulum.
                first = planes and planes.best
                own = planes and planes.improve(self._settings.rounds, deadline)
            else:
                planes = CuttingPlanes(self._improvement, basis, first.bound, first)
                own = planes.improve(self._settings.rounds, deadline)
                first = own if _mean(own) > _NOTHING else first
            last = max(before, own, key=_mean)
            carried = last is not None and last is before
            seconds = time.monotonic() - started
            found.append(Attempt(degree, len(basis.exponents), last, name, seconds, carried))
            if progress is not None:
                progress((k + 1) / len(self._degrees))
            gain = 0.0 if carried else 1.0 - _mean(last)
            if last is not None and not self._settings.degrees and gain < self._settings.tolerance:
                break
        return tuple(found)

    def repaired(self, candidate: BarrierCandidate, worst: np.ndarray) -> BarrierCandidate | None:
        """Return a better barrier, where the inequality is asked near a state too.

        Args:
            candidate: the barrier.
            worst: state where its inequality fails, shape (n,).
        """
        rng = np.random.default_rng(self._settings.seed)
        scale = np.array([float(s) for s in self.domain.frame[1]])
        near = worst + _STEP * scale * rng.standard_normal((_NEAR, len(worst)))
        if self.domain.even:
            near = np.concatenate([near, -near])
        extra = np.concatenate([worst[None], near[self.domain.inside(near)]])
        improvement = replace(self._improvement, extra=extra)
        planes = CuttingPlanes(improvement, candidate.basis, candidate.bound, candidate)
        return planes.improve(self._settings.rounds, time.monotonic())

    def _begun(self, basis: ChebyshevBasis) -> tuple[CuttingPlanes | None, str]:
        """Return the best begun programs over all rates and first inputs, and the latter's name."""
        best, name, most = None, "", _NOTHING
        for bound in self._bounds:
            for law, inputs in self._laws.items():
                planes = CuttingPlanes(self._improvement, basis, bound, inputs)
                mean = _mean(planes.improve(_FIRST_ROUNDS, least=most))
                if mean > most:
                    best, name, most = planes, law, mean
        return best, name


def degrees_of(plant: Plant | ControlAffineSDE, settings: SynthesisSettings) -> tuple[int, ...]:
    """Return the degrees that are tried, increasing.

    Args:
        plant: the system.
        settings: of the search.

    Raises:
        ConfigurationError: There are too many states, or a polynomial of a degree has too many
            coefficients.
    """
    n = len(plant.states)
    if n > _MOST_STATES:
        raise ConfigurationError(
            f"the system has {n} states, and certificates are looked for with up to {_MOST_STATES}:"
            " each state multiplies the coefficients of psi and the boxes of its proof; give a"
            " system of the states that the barriers need"
        )
    degrees = tuple(sorted(set(settings.degrees))) or _DEGREES.get(n, _LAST_DEGREES)
    members = sp.binomial(n + degrees[-1], n)
    if members > _MOST_MEMBERS:
        raise ConfigurationError(
            f"a polynomial of {n} states and degree {degrees[-1]} has {members} coefficients;"
            f" linear programs up to {_MOST_MEMBERS} are solved: give a lower degree"
        )
    return degrees


def _climbed(degrees: tuple[int, ...], n: int) -> tuple[int, ...]:
    """Return degrees after the lower ones of `_DEGREES`, whose first linear programs are fast."""
    lower = (d for d in _DEGREES.get(n, _LAST_DEGREES) if d < degrees[0])
    return (*lower, *degrees)


def _mean(candidate: BarrierCandidate | None) -> float:
    return -1.0 if candidate is None else candidate.mean


_DECIMALS = 9
"""Of the coefficients, which are below 1000."""

_EDGE_MARGIN, _TOP_TOLERANCE, _RATE_TOLERANCE = 1e-3, 5e-4, 1e-3
"""Parts of the bound that gaps between proved and true extrema may cost."""

_MOST_RIM_STATES, _TRIES = 20_000, 4


@dataclass(frozen=True)
class ProofNumbers:
    """What the judge makes of a barrier.

    Attributes:
        psi: lowered, so that it is <= 0 on the edge of C.
        shortfall: m.
        supremum: c.
        worst: state where the generator inequality takes m, shape (n,), if one was met.
        boxes: that the judge has looked at.
        reason: why there is no proof, in words; empty where there is one.
        note: why its numbers may be larger than they have to be, in words; empty where they are
            not by much.
    """

    psi: Polynomial
    shortfall: Fraction
    supremum: Fraction
    worst: np.ndarray | None
    boxes: int
    reason: str = ""
    note: str = ""


def finalize(
    candidate: BarrierCandidate, domain: Domain, budget: Budget | None = None
) -> ProofNumbers:
    """Return proved numbers for a barrier.

    Args:
        candidate: the barrier, with sampled numbers.
        domain: the safe set.
        budget: of each statement.
    """
    psi = candidate.basis.polynomial(candidate.coefficients, _DECIMALS)
    rate = exact_decimal(candidate.bound.rate)
    excess, boxes, reason = _edge_excess(domain, psi, rate, budget)
    zero = Fraction(0)
    if reason:
        return ProofNumbers(psi, zero, zero, None, boxes, reason)
    origin = (0,) * psi.n
    constant = psi.coefficients.get(origin, zero) - excess
    psi = replace(psi, coefficients={**psi.coefficients, origin: constant})
    parts = CertificateStatements(domain.plant, psi, rate)
    region = parts.statement("psi and its generator on G", sp.Integer(0))
    top = supremum(region, parts.value, _TOP_TOLERANCE, budget)
    tolerance = _RATE_TOLERANCE / candidate.bound.spent
    lack = supremum(region, -parts.generator, tolerance, budget)
    boxes += top.boxes + lack.boxes
    failed = next((s.reason for s in (top, lack) if not math.isfinite(s.upper)), "")
    if failed or not top.upper > 0.0:
        return ProofNumbers(psi, zero, zero, lack.state, boxes, failed or "psi is nowhere above 0")
    m, c = rounded_up(max(lack.upper, 0.0)), rounded_up(top.upper)
    note = top.reason or lack.reason
    return ProofNumbers(psi, m, c, lack.state, boxes, note=note)


def exact_decimal(value: float) -> Fraction:
    """Return the decimal number as which a float is written."""
    return Fraction(repr(float(value)))


def _edge_excess(
    domain: Domain, psi: Polynomial, rate: Fraction, budget: Budget | None
) -> tuple[Fraction, int, str]:
    """Return a number that psi does not exceed on the edge of C, boxes, and why there is none."""
    rim = psi.values(domain.draw_edge(_MOST_RIM_STATES, np.random.default_rng(domain.seed)))
    most, boxes, reason = max(0.0, float(rim.max(initial=0.0))), 0, ""
    excess, parts = Fraction(0), CertificateStatements(domain.plant, psi, rate)
    for _ in range(_TRIES):
        excess = rounded_up(most + _EDGE_MARGIN)
        verdicts = [judge(s, budget) for s in parts.edges(excess)]
        boxes += sum(verdict.boxes for verdict in verdicts)
        states = [v.state for v in verdicts if v.state is not None]
        reason = next((v.reason for v in verdicts if v.word != "proved"), "")
        if not states:
            break
        most = max(most, float(psi.values(np.array(states)).max()) + _EDGE_MARGIN)
    return excess, boxes, reason


_STARTS = 50_000
"""Starts over which the bound of a certificate is averaged."""

_SEARCHED = 0.8
"""Part of the work that is the synthesis', for the progress."""

_LOST = 5e-3
"""Part of the bound above which the judge's state is worth another linear program."""

_BUDGET = Budget(boxes=1_000_000, seconds=20.0)


@dataclass(frozen=True)
class BarrierProof:
    """What the judge makes of the barrier of a degree.

    Attributes:
        degree: total degree.
        numbers: proved, or the reason why not.
        mean: of the proved bound over the starts of the linear programs; 0 without a proof.
        seconds: of the judge.
    """

    degree: int
    numbers: ProofNumbers
    mean: float
    seconds: float


@dataclass(frozen=True)
class Certification:
    """What was found for a problem.

    Attributes:
        certificate: whose hypotheses are proved; nothing where none was found.
        attempts: the best barrier of each degree, as sampled.
        judgements: of those that were judged.
        mean: of the certificate's bound over the starts; 0 without one.
        starts: that were drawn for it; 1 where all are the same.
        margin: by which the mean over all starts may be lower, at 99.99 % confidence.
        seconds: of all.
    """

    certificate: BarrierCertificate | None
    attempts: tuple[Attempt, ...]
    judgements: tuple[BarrierProof, ...]
    mean: float
    starts: int
    margin: float
    seconds: float


@dataclass(frozen=True)
class Named:
    """A problem with the name of its env.

    Attributes:
        problem: with the starts and the horizon.
        env_id: registered id; empty for other systems.
        options: of the env.
    """

    problem: SafetyProblem
    env_id: str = ""
    options: dict[str, Any] = field(default_factory=dict)


def certify(
    named: Named,
    settings: SynthesisSettings,
    policy: bool = False,
    progress: Progress | None = None,
) -> Certification:
    """Look for a barrier certificate of a problem, and prove it.

    Args:
        named: the problem.
        settings: of the search.
        policy: whether it is of the nominal controller, in place of every input that meets its
            constraint.
        progress: called with the part of the work that is done.

    Raises:
        ConfigurationError: The nominal controller depends on the time, or see `Synthesis`.
    """
    begin, problem = time.monotonic(), named.problem
    require_direct(problem, "certificates")
    degrees_of(problem.plant, settings)  # What is too large is refused before it takes time.
    laws = nominal_laws(problem)
    if policy and not laws:
        raise ConfigurationError(
            f"the nominal controller of {problem.name} depends on the time, a certificate is of"
            " laws of the state; leave --policy out"
        )
    plant = plant_of(problem, policy=laws if policy else ())
    horizon = exact_decimal(problem.dt) * problem.steps
    starts = np.stack(draw_starts(problem, settings.starts, settings.seed), axis=1)
    closed = tuple(not np.isfinite([v.low, v.high]).all() for v in problem.states)
    task = Task(plant, float(horizon), starts, closed, () if policy else laws)
    synthesis = Synthesis(task, settings)
    attempts = synthesis.attempts(progress and (lambda done: progress(_SEARCHED * done)))
    judgements = _judged(synthesis, attempts)
    if progress is not None:
        progress(1.0)
    best = max(judgements, key=lambda each: each.mean, default=None)
    if best is None or best.mean <= 0.0:
        return Certification(None, attempts, judgements, 0.0, 0, 0.0, time.monotonic() - begin)
    rate = next(a.candidate.bound.rate for a in attempts if a.degree == best.degree and a.candidate)
    numbers = best.numbers
    certificate = BarrierCertificate(
        named.env_id,
        dict(named.options),
        plant,
        numbers.psi,
        exact_decimal(rate),
        numbers.shortfall,
        numbers.supremum,
        horizon,
    )
    # Other starts than those for which psi was chosen.
    x = np.stack(draw_starts(problem, _STARTS, settings.seed + 1), axis=1)
    x = synthesis.domain.wrapped(x)
    # psi says nothing outside of C and of the workspace.
    bounds = np.where(synthesis.domain.inside(x), certificate.bounds_at(x), 0.0)
    return Certification(
        certificate,
        attempts,
        judgements,
        float(bounds.mean()),
        len(x),
        sampling_margin(bounds),
        time.monotonic() - begin,
    )


def nominal_laws(problem: SafetyProblem) -> tuple[sp.Expr, ...]:
    """Return the nominal controller's laws of the states, clipped to the bounds of the inputs.

    Args:
        problem: whose nominal controller it is.

    Returns:
        An expression for each input; () where one depends on the time.
    """
    features: Any = {f.symbol: f.expression for f in problem.features}
    found = []
    for law, (low, high) in zip(problem.nominal, problem.input_bounds, strict=True):
        of_states = problem.model.exact(law.subs(features, simultaneous=True))
        if TIME in of_states.free_symbols:
            return ()
        lower, upper = (sp.Rational(repr(float(end))) for end in (low, high))
        found.append(sp.Min(sp.Max(of_states, lower), upper))
    return tuple(found)


def _judged(synthesis: Synthesis, attempts: tuple[Attempt, ...]) -> tuple[BarrierProof, ...]:
    """Judge the barriers, the best one first, until no other can have a larger bound."""
    order = sorted(
        (a for a in attempts if a.candidate is not None and not a.carried),
        key=lambda a: -_sampled(a.candidate),
    )
    found: list[BarrierProof] = []
    for attempt in order:
        candidate = attempt.candidate
        if candidate is None or any(done.mean >= candidate.mean for done in found):
            break
        judgement = _judgement(synthesis, attempt.degree, candidate)
        worst = judgement.numbers.worst
        if candidate.mean - judgement.mean > _LOST and worst is not None:
            again = synthesis.repaired(candidate, worst)
            if again is not None and again.mean > judgement.mean:
                second = _judgement(synthesis, attempt.degree, again)
                judgement = max(judgement, second, key=lambda each: each.mean)
        found.append(judgement)
    by_degree = {each.degree: each for each in found}
    for before, attempt in itertools.pairwise(attempts):
        if attempt.carried and before.degree in by_degree:
            # The same psi has the same proof.
            own = replace(by_degree[before.degree], degree=attempt.degree, seconds=0.0)
            by_degree[attempt.degree] = own
    return tuple(by_degree.values())


def _judgement(synthesis: Synthesis, degree: int, candidate: BarrierCandidate) -> BarrierProof:
    begin = time.monotonic()
    numbers = finalize(candidate, synthesis.domain, _BUDGET)
    mean = 0.0
    if not numbers.reason:
        psi = numbers.psi.values(synthesis.starts)
        m, c = float(numbers.shortfall), float(numbers.supremum)
        if psi.max() > c:
            reason = f"psi is {psi.max():.6g} at a start, which contradicts c = {c:.6g}"
            numbers = replace(numbers, reason=reason)
        else:
            mean = candidate.bound.mean(psi, m, c)
    return BarrierProof(degree, numbers, mean, time.monotonic() - begin)


def _sampled(candidate: BarrierCandidate | None) -> float:
    return 0.0 if candidate is None else candidate.mean
