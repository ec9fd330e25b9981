"""Barrier certificates of problems: synthesis, then the judge."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.certificates.statements import plant_of
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.finalize import ProofNumbers, exact_decimal, finalize
from safe_envs.wrappers.synthesis.settings import SynthesisSettings
from safe_envs.wrappers.synthesis.synthesize import (
    Attempt,
    Progress,
    Synthesis,
    Task,
    degrees_of,
)
from safe_envs.wrappers.value.starts import draw_starts, sampling_margin
from safe_envs.wrappers.verification.branch_and_bound import Budget

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
    for law, (low, high) in zip(problem.nominal, problem.box, strict=True):
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
