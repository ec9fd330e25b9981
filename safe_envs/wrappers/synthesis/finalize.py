"""Sound numbers for a barrier: the judge bounds what linear programs saw at sampled states only."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.certificate_statements import CertificateStatements, rounded_up
from safe_envs.wrappers.verification.judge import judge, supremum

_DECIMALS = 9
"""Of the coefficients, which are below 1000."""

_EDGE_MARGIN, _TOP_TOLERANCE, _RATE_TOLERANCE = 1e-3, 5e-4, 1e-3
"""Parts of the bound that gaps between proved and true extrema may cost."""

_RIM, _TRIES = 20_000, 4


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
    rim = psi.values(domain.draw_edge(_RIM, np.random.default_rng(domain.seed)))
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
