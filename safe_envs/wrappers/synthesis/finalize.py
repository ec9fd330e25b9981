"""Sound numbers for a barrier: the judge bounds what linear programs saw at sampled states only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.domain import Domain, at_states
from safe_envs.wrappers.synthesis.generator import Generator
from safe_envs.wrappers.synthesis.candidate import Candidate
from safe_envs.wrappers.verification.judge import Budget, judge, supremum
from safe_envs.wrappers.verification.statement import PolynomialPart, Statement, Witness

_DECIMALS = 9
"""Of the coefficients, which are below 1000."""

_EDGE_TOLERANCE, _TOP_TOLERANCE = 5e-4, 5e-4
_SHORTFALL_TOLERANCE = 1e-3
"""Parts of the bound that the gaps between proved and true extrema may cost."""

_RIM, _TRIES = 20_000, 4


@dataclass(frozen=True)
class Numbers:
    """A barrier with numbers for which all hypotheses of the bound are proved.

    Attributes:
        psi: lowered, so that it is <= 0 on the edge of C.
        shortfall: m.
        supremum: c.
        boxes: that the judge has looked at.
    """

    psi: Polynomial
    shortfall: Fraction
    supremum: Fraction
    boxes: int


@dataclass(frozen=True)
class Failure:
    """Why the numbers of a barrier are not proved.

    Attributes:
        reason: in words.
        boxes: that the judge has looked at.
    """

    reason: str
    boxes: int


def finalize(candidate: Candidate, domain: Domain, seconds: float) -> Numbers | Failure:
    """Return proved numbers for a barrier.

    Args:
        candidate: the barrier, with sampled numbers.
        domain: the safe set.
        seconds: that the judge may take for each of the extrema.
    """
    psi = candidate.basis.polynomial(candidate.coefficients, _DECIMALS)
    budget = Budget(seconds=seconds)
    boxes = 0
    rim = psi.values(domain.draw_edge(_RIM, np.random.default_rng(domain.seed)))
    most = max(0.0, float(rim.max(initial=0.0)))
    for _ in range(_TRIES):
        excess = _above(most + _EDGE_TOLERANCE)
        verdicts = [judge(statement, budget) for statement in _edges(domain, psi, excess)]
        boxes += sum(verdict.boxes for verdict in verdicts)
        states = [v.state for v in verdicts if v.state is not None]
        if not states:
            break
        most = max(most, float(psi.values(np.array(states)).max()) + _EDGE_TOLERANCE)
    open_ = [verdict for verdict in verdicts if verdict.word != "proved"]
    if open_:
        return Failure(open_[0].reason, boxes)
    psi = lowered(psi, excess)
    inside = inside_statement(domain.plant, psi)
    top = supremum(inside, next(iter(inside.polynomials)), _TOP_TOLERANCE, budget)
    boxes += top.boxes
    if not top.upper < math.inf:
        return Failure(f"psi is not bounded: {top.reason}", boxes)
    generator = generator_statement(domain.plant, psi, candidate)
    tolerance = _SHORTFALL_TOLERANCE / candidate.bound.spent
    worst = supremum(generator, -generator.claim, tolerance, budget)
    boxes += worst.boxes
    if not worst.upper < math.inf:
        return Failure(f"the generator of psi is not bounded: {worst.reason}", boxes)
    return Numbers(psi, max(Fraction(0), _above(worst.upper)), _above(top.upper), boxes)


def lowered(psi: Polynomial, by: Fraction) -> Polynomial:
    """Return a polynomial minus a constant."""
    zero = (0,) * psi.n
    coefficients = {**psi.coefficients, zero: psi.coefficients.get(zero, Fraction(0)) - by}
    return replace(psi, coefficients=coefficients)


def _parts(psi: Polynomial) -> tuple[sp.Symbol, dict[sp.Symbol, PolynomialPart]]:
    value = sp.Symbol("psi", real=True)
    return value, {value: PolynomialPart(psi, (0,) * psi.n)}


def inside_statement(plant: Plant, psi: Polynomial) -> Statement:
    """Return a statement of G, where psi and all h are positive; its claim is psi >= 0."""
    value, parts = _parts(psi)
    return Statement(
        "psi on G",
        plant.states,
        plant.workspace,
        claim=value,
        positive=(value, *plant.barriers),
        polynomials=parts,
    )


def _edges(domain: Domain, psi: Polynomial, excess: Fraction) -> list[Statement]:
    """Return the statements that psi is at most some excess on each part of the edge of C."""
    plant = domain.plant
    value, parts = _parts(psi)
    most = sp.Rational(excess)
    found = []
    for i, h in enumerate(plant.barriers):
        others = (*plant.barriers[:i], *plant.barriers[i + 1 :])
        factor = sp.Dummy("factor", real=True)
        found.append(
            Statement(
                f"psi where {h} = 0",
                plant.states,
                plant.workspace,
                claim=most - value + factor * h,
                nonnegative=others,
                zeros=(h,),
                polynomials=parts,
                witnesses=(factor,),
                witness=_slope_across(plant, psi, h),
            )
        )
    for i in np.flatnonzero(domain.closed).tolist():
        for end in plant.workspace[i]:
            ends = (*plant.workspace[:i], (end, end), *plant.workspace[i + 1 :])
            found.append(
                Statement(
                    f"psi at {plant.states[i]} = {end}",
                    plant.states,
                    ends,
                    claim=most - value,
                    positive=plant.barriers,
                    polynomials=parts,
                )
            )
    return found


def _slope_across(plant: Plant, psi: Polynomial, h: sp.Expr) -> Witness:
    """Return the slope of psi per slope of h, at states.

    With it psi - factor h hardly varies across the edge, where it is psi. So boxes may be wide.
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


def generator_statement(plant: Plant, psi: Polynomial, candidate: Candidate) -> Statement:
    """Return the statement that A psi + a psi >= 0 on G, along some input within the bounds."""
    n = len(plant.states)
    value, parts = _parts(psi)
    unit = np.eye(n, dtype=int)

    def part(order: np.ndarray) -> sp.Symbol:
        key = tuple(order.tolist())
        symbol = sp.Symbol("psi_" + "_".join(map(str, key)), real=True)
        parts[symbol] = PolynomialPart(psi, key)
        return symbol

    gradient = [part(unit[i]) for i in range(n)]
    drift = sum(g * f for g, f in zip(gradient, plant.drift, strict=True))
    sigma = sp.Matrix(plant.diffusion)
    covariance = sigma * sigma.T
    for i in range(n):
        for j in range(i + 1):
            entry = covariance[i, j]
            if entry != 0:
                drift += part(unit[i] + unit[j]) * entry * sp.Rational(1 if i != j else 1, 1 if i != j else 2)
    claim = drift + sp.Rational(repr(candidate.bound.rate)) * value
    inputs = tuple(sp.Dummy(f"u_{j}", real=True) for j in range(len(plant.inputs)))
    witness = None
    if plant.policy:
        chosen, inputs = plant.policy, ()
    else:
        chosen = inputs
        generator = Generator(plant)

        def witness(x: np.ndarray) -> np.ndarray:
            jets = candidate.basis.jets(x)
            effect = np.einsum(
                "bnm,bnk,k->bm", generator.fields(x)[1], jets.gradients, candidate.coefficients
            )
            return np.where(effect > 0.0, generator.bounds[:, 1], generator.bounds[:, 0])

    for j, u in enumerate(chosen):
        claim += u * sum(g * row[j] for g, row in zip(gradient, plant.input_matrix, strict=True))
    return Statement(
        "A psi + a psi >= 0 on G",
        plant.states,
        plant.workspace,
        claim=claim,
        positive=(value, *plant.barriers),
        polynomials=parts,
        witnesses=inputs,
        witness=witness,
    )


def _above(value: float, decimals: int = 7) -> Fraction:
    """Return a short decimal that is not below a number."""
    return Fraction(math.ceil(Fraction(value) * 10**decimals), 10**decimals)
