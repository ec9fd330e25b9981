"""Barriers for the env's own steps with held input: linear programs, then the proof."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.problem.actuators import require_direct
from safe_envs.wrappers.certificates.certificate import HeldCertificate
from safe_envs.wrappers.certificates.held_step import held_period
from safe_envs.wrappers.certificates.statements import plant_of
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.certify import Named
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.held_program import HeldPrograms, HeldTask
from safe_envs.wrappers.synthesis.held_samples import SampledStep
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
