"""The statements of a barrier certificate for the judge, and the least numbers that it proves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.certificates.certificate import BarrierCertificate, Plant
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.input_terms import largest_input_term, not_polynomial
from safe_envs.wrappers.verification.judge import Verdict, judge, supremum
from safe_envs.wrappers.verification.statement import PolynomialPart, Statement

_DIGITS = 9


@dataclass(frozen=True)
class CertificateStatements:
    """The statements that make psi a barrier certificate of a system.

    Attributes:
        plant: the system.
        psi: the barrier.
        rate: a in 1/s.
    """

    plant: Plant
    psi: Polynomial
    rate: Fraction

    @cached_property
    def _parts(self) -> tuple[sp.Symbol, list[sp.Symbol], dict[tuple[int, int], sp.Symbol]]:
        """Symbols of psi, of its gradient and of its second derivatives."""
        n = len(self.plant.states)
        value: Any = sp.Dummy("psi", real=True)
        slopes: Any = [sp.Dummy(f"psi_{i}", real=True) for i in range(n)]
        curves: Any = {
            (i, j): sp.Dummy(f"psi_{i}{j}", real=True)
            for i, j in itertools.combinations_with_replacement(range(n), 2)
        }
        return value, slopes, curves

    @cached_property
    def polynomials(self) -> Mapping[sp.Symbol, PolynomialPart]:
        """What the symbols stand for."""
        value, slopes, curves = self._parts
        n = len(slopes)
        found = {value: PolynomialPart(self.psi, (0,) * n)}
        for i, symbol in enumerate(slopes):
            found[symbol] = PolynomialPart(self.psi, _order(n, i))
        for (i, j), symbol in curves.items():
            found[symbol] = PolynomialPart(self.psi, _order(n, i, j))
        return found

    @cached_property
    def generator(self) -> sp.Expr:
        """A psi + a psi along the policy or, without one, along the best input in the bounds."""
        plant = self.plant
        value, slopes, curves = self._parts
        found: Any = sp.Rational(self.rate) * value
        found += sum(f * p for f, p in zip(plant.drift, slopes, strict=True))
        moved: list[Any] = [
            sum(row[j] * p for row, p in zip(plant.input_matrix, slopes, strict=True))
            for j in range(len(plant.bounds))
        ]
        if plant.policy:
            # What is applied: an input beyond its bounds is cut to them.
            applied = [
                sp.Max(low, sp.Min(high, u))
                for u, (low, high) in zip(plant.policy, plant.bounds, strict=True)
            ]
            found += sum(u * a for u, a in zip(applied, moved, strict=True))
        else:
            found += largest_input_term(moved, plant.bounds)
        for (i, j), symbol in curves.items():
            covariance: Any = sum(
                a * b for a, b in zip(plant.diffusion[i], plant.diffusion[j], strict=True)
            )
            found += covariance * symbol * (sp.Rational(1, 2) if i == j else 1)
        return found

    def statement(self, name: str, claim: Any) -> Statement:
        """Return a statement about G, where psi and all h_i are above 0.

        Args:
            name: in words.
            claim: that is to be at least 0.
        """
        positive = (self._parts[0], *self.plant.barriers)
        return Statement(
            name,
            self.plant.states,
            self.plant.workspace,
            claim,
            positive=positive,
            polynomials=self.polynomials,
        )

    def coefficients(self) -> Statement:
        """Return the statement that f, g and sigma are continuous on G."""
        plant = self.plant
        entries = (*plant.drift, *itertools.chain(*plant.input_matrix, *plant.diffusion))
        statement = self.statement("f, g and sigma are continuous on G", sp.Integer(1))
        return replace(statement, continuous=not_polynomial(entries, plant.states))

    @property
    def value(self) -> sp.Symbol:
        """The symbol of psi."""
        return self._parts[0]

    def edges(self) -> list[Statement]:
        """Return the statements that psi is not above 0 on the edge of C, and where an angle jumps.

        The edge of C is where an h_i is 0 and no other is below. An angle jumps at the ends of its
        period, where a polynomial would too.
        """
        found = self._jumps()
        for i, barrier in enumerate(self.plant.barriers):
            # Where psi is h_i itself there is nothing to show.
            if sp.expand(self.psi.expression - barrier) == 0:
                continue
            others = self.plant.barriers[:i] + self.plant.barriers[i + 1 :]
            found.append(
                Statement(
                    "psi <= 0 on the edge of C",
                    self.plant.states,
                    self.plant.workspace,
                    -self.value,
                    nonnegative=others,
                    zeros=(barrier,),
                    polynomials=self.polynomials,
                )
            )
        return found

    def _jumps(self) -> list[Statement]:
        found = []
        for i, angle in enumerate(self.plant.angles):
            if not angle or not any(
                key[i] for key, value in self.psi.coefficients.items() if value
            ):
                continue
            for end in self.plant.workspace[i]:
                box = (*self.plant.workspace[:i], (end, end), *self.plant.workspace[i + 1 :])
                found.append(
                    Statement(
                        "psi <= 0 where an angle jumps",
                        self.plant.states,
                        box,
                        -self.value,
                        positive=self.plant.barriers,
                        polynomials=self.polynomials,
                    )
                )
        return found


def _order(n: int, *states: int) -> tuple[int, ...]:
    return tuple(states.count(i) for i in range(n))


def judged(
    certificate: BarrierCertificate, budget: Budget | None = None
) -> list[tuple[str, Verdict]]:
    """Judge the statements of a certificate.

    Args:
        certificate: to be judged.
        budget: of each statement.

    Returns:
        The name and the verdict of each; it is a proof where all are proved.
    """
    name = "a >= 0, m >= 0 and c > 0"
    if min(certificate.rate, certificate.shortfall) < 0 or certificate.supremum <= 0:
        # With a < 0 an end of the episode, at the edge of the workspace, would be worth too much.
        return [(name, Verdict("refuted", 0, reason=f"not {name}"))]
    parts = CertificateStatements(certificate.plant, certificate.psi, certificate.rate)
    c, m = sp.Rational(certificate.supremum), sp.Rational(certificate.shortfall)
    statements = [
        parts.statement("psi <= c", c - parts.value),
        parts.statement("A psi >= -a psi - m", parts.generator + m),
        *parts.edges(),
        parts.coefficients(),
    ]
    return [(statement.name, judge(statement, budget)) for statement in statements]


class ProvedNumbers(NamedTuple):
    """The numbers of a certificate that the judge proves for a psi.

    Attributes:
        psi: lowered so that it is not above 0 on the edge of C.
        supremum: c.
        shortfall: m.
        worst: states where the generator inequality is least slack or fails, shape (B, n).
        boxes: number of boxes that were looked at.
        reason: why there is no proof, in words; empty where there is one.
    """

    psi: Polynomial
    supremum: Fraction
    shortfall: Fraction
    worst: np.ndarray
    boxes: int
    reason: str = ""


def proved_numbers(
    plant: Plant,
    psi: Polynomial,
    rate: Fraction,
    tolerance: float = 1e-4,
    budget: Budget | None = None,
) -> ProvedNumbers:
    """Prove the least numbers c and m for a psi, after lowering it on the edge of C.

    Args:
        plant: the system.
        psi: candidate, of size about 1.
        rate: a.
        tolerance: by how much the numbers may be larger than they have to be.
        budget: of each of them.
    """
    none, boxes = np.empty((0, len(plant.states))), 0
    parts = CertificateStatements(plant, psi, rate)
    excess, reason = 0.0, ""
    for edge in parts.edges():
        found = supremum(edge, parts.value, tolerance, budget)
        boxes += found.boxes
        excess, reason = max(excess, found.upper), reason or found.reason
    if not math.isfinite(excess):
        return ProvedNumbers(psi, Fraction(0), Fraction(0), none, boxes, reason)
    if excess > 0.0:
        origin = (0,) * psi.n
        lowered = psi.coefficients.get(origin, Fraction(0)) - rounded_up(excess)
        psi = replace(psi, coefficients={**psi.coefficients, origin: lowered})
        parts = CertificateStatements(plant, psi, rate)
    region = parts.statement("the region of psi", sp.Integer(0))
    top = supremum(region, parts.value, tolerance, budget)
    lack = supremum(region, -parts.generator, tolerance, budget)
    boxes += top.boxes + lack.boxes
    worst = none if lack.state is None else lack.state[None]
    if not top.upper > 0.0:
        return ProvedNumbers(psi, Fraction(0), Fraction(0), none, boxes, "psi is nowhere above 0")
    for bound in (top, lack):
        if not math.isfinite(bound.upper) and bound.upper > 0.0:
            return ProvedNumbers(psi, Fraction(0), Fraction(0), worst, boxes, bound.reason)
    return ProvedNumbers(psi, rounded_up(top.upper), rounded_up(max(lack.upper, 0.0)), worst, boxes)


def rounded_up(value: float) -> Fraction:
    """Return a decimal of few digits that is not below a number."""
    step = Fraction(10) ** (math.floor(math.log10(abs(value))) + 1 - _DIGITS) if value else 1
    return Fraction(math.ceil(Fraction(value) / step)) * step
