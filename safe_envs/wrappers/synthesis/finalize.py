"""Sound numbers for a barrier: the judge bounds what linear programs saw at sampled states only."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.domain import Domain, at_states
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.certificate_statements import CertificateStatements
from safe_envs.wrappers.verification.judge import judge, supremum
from safe_envs.wrappers.verification.statement import Statement, Witness

_DECIMALS = 9
"""Of the coefficients, which are below 1000."""

_EDGE_MARGIN, _TOP_TOLERANCE, _RATE_TOLERANCE = 1e-3, 5e-4, 1e-3
"""Parts of the bound that gaps between proved and true extrema may cost."""

_RIM, _TRIES = 20_000, 4
_THIN = sp.Rational(1, 10**6)


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
    m, c = _above(max(lack.upper, 0.0)), _above(top.upper)
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
    excess = Fraction(0)
    for _ in range(_TRIES):
        excess = _above(most + _EDGE_MARGIN)
        verdicts = [judge(s, budget) for s in _edges(domain, psi, rate, excess)]
        boxes += sum(verdict.boxes for verdict in verdicts)
        states = [v.state for v in verdicts if v.state is not None]
        reason = next((v.reason for v in verdicts if v.word != "proved"), "")
        if not states:
            break
        most = max(most, float(psi.values(np.array(states)).max()) + _EDGE_MARGIN)
    return excess, boxes, reason


def _edges(domain: Domain, psi: Polynomial, rate: Fraction, excess: Fraction) -> list[Statement]:
    """Return the statements that psi is at most some excess on each part of the edge of C."""
    plant = domain.plant
    parts = CertificateStatements(plant, psi, rate)
    most = sp.Rational(excess.numerator, excess.denominator) - parts.value
    found = []
    for edge in parts.edges():
        (h,), factor = edge.zeros, sp.Dummy("factor", real=True)
        found.append(
            replace(
                edge,
                claim=most + factor * h,
                witnesses=(factor,),
                witness=_slope_across(plant, psi, h),
            )
        )
    for i in np.flatnonzero(domain.closed).tolist():
        for end in plant.workspace[i]:
            # A little wider than the end, which no box of floats is exactly.
            ends = (end - _THIN, end + _THIN)
            within = (*plant.workspace[:i], ends, *plant.workspace[i + 1 :])
            found.append(
                Statement(
                    f"psi <= 0 at {plant.states[i]} = {end}",
                    plant.states,
                    within,
                    most,
                    positive=plant.barriers,
                    polynomials=parts.polynomials,
                )
            )
    return found


def _slope_across(plant: Plant, psi: Polynomial, h: sp.Expr) -> Witness:
    """Return the slope of psi per slope of h, at states.

    With it psi - factor h, which is psi on the edge, hardly varies across it: boxes may be wide.
    """
    slopes = compile_function(plant.states, [sp.diff(h, s) for s in plant.states], "arrays")
    gradient = [psi.derivative(i) for i in range(psi.n)]

    def factors(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            across = at_states(slopes, x)
            own = np.stack([part.values(x) for part in gradient], axis=1)
            found = (own * across).sum(axis=1) / (across**2).sum(axis=1)
        return np.where(np.isfinite(found), found, 0.0)[:, None]

    return factors


def _above(value: float, decimals: int = 7) -> Fraction:
    """Return a short decimal that is not below a number."""
    return Fraction(math.ceil(Fraction(value) * 10**decimals), 10**decimals)
