"""The statements of a barrier certificate for the judge, and the least numbers that it proves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.dynamics.tables import tabulated
from safe_envs.wrappers.certificates.certificate import BarrierCertificate, Plant
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.input_terms import largest_input_term, not_polynomial
from safe_envs.wrappers.verification.judge import JudgeResult, judge
from safe_envs.wrappers.verification.statements import PolynomialPart, Statement, Witness

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

    def edges(self, excess: Fraction = Fraction(0)) -> list[Statement]:
        """Return the statements that psi is at most 0 on the edge of C, and where an angle jumps.

        The edge of C is where an h_i is 0 and no other is below. An angle jumps at the ends of its
        period, where a polynomial would too.

        Args:
            excess: that psi may have there, in place of 0.
        """
        most = sp.Rational(excess) - self.value
        return [*self._jumps(most), *self._rims(most)]

    def _rims(self, most: Any) -> list[Statement]:
        found, plant = [], self.plant
        for i, barrier in enumerate(plant.barriers):
            # Where psi is h_i itself there is nothing to show.
            if sp.expand(self.psi.expression - barrier) == 0:
                continue
            # On h_i = 0 a multiple of it changes nothing, and lets boxes be wide across the edge.
            multiple = sp.Dummy("multiple", real=True)
            found.append(
                Statement(
                    "psi <= 0 on the edge of C",
                    plant.states,
                    plant.workspace,
                    most + multiple * barrier,
                    nonnegative=plant.barriers[:i] + plant.barriers[i + 1 :],
                    zeros=(barrier,),
                    polynomials=self.polynomials,
                    witnesses=(multiple,),
                    witness=_slope_across(plant, self.psi, barrier),
                )
            )
        return found

    def _jumps(self, most: Any) -> list[Statement]:
        plant, keys = self.plant, [key for key, value in self.psi.coefficients.items() if value]
        ends = [
            (i, end)
            for i, angle in enumerate(plant.angles)
            if angle and any(key[i] for key in keys)
            for end in plant.workspace[i]
        ]
        return [
            Statement(
                "psi <= 0 where an angle jumps",
                plant.states,
                (*plant.workspace[:i], (end, end), *plant.workspace[i + 1 :]),
                most,
                positive=plant.barriers,
                polynomials=self.polynomials,
            )
            for i, end in ends
        ]


def _slope_across(plant: Plant, psi: Polynomial, barrier: Any) -> Witness:
    """Return the slope of psi per slope of h across its edge, at states; 0 where it jumps."""
    derivatives = [sp.diff(barrier, s) for s in plant.states]
    if any(d.has(sp.Derivative, sp.DiracDelta, sp.Subs) for d in derivatives):
        return lambda x: np.zeros((len(x), 1))
    slopes = tabulated(plant.states, derivatives)
    gradient = [psi.derivative(i) for i in range(psi.n)]

    def multiples(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            across = slopes(x)
            own = np.stack([part.values(x) for part in gradient], axis=1)
            found = (own * across).sum(axis=1) / (across**2).sum(axis=1)
        return np.where(np.isfinite(found), found, 0.0)[:, None]

    return multiples


def _order(n: int, *states: int) -> tuple[int, ...]:
    return tuple(states.count(i) for i in range(n))


def judged(
    certificate: BarrierCertificate, budget: Budget | None = None
) -> list[tuple[str, JudgeResult]]:
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
        return [(name, JudgeResult("refuted", 0, reason=f"not {name}"))]
    parts = CertificateStatements(certificate.plant, certificate.psi, certificate.rate)
    c, m = sp.Rational(certificate.supremum), sp.Rational(certificate.shortfall)
    statements = [
        parts.statement("psi <= c", c - parts.value),
        parts.statement("A psi >= -a psi - m", parts.generator + m),
        *parts.edges(),
        parts.coefficients(),
    ]
    return [(statement.name, judge(statement, budget)) for statement in statements]


def rounded_up(value: float, digits: int = _DIGITS) -> Fraction:
    """Return a decimal of few digits that is not below a number.

    Args:
        value: finite.
        digits: that count.
    """
    step = Fraction(10) ** (math.floor(math.log10(abs(value))) + 1 - digits) if value else 1
    return Fraction(math.ceil(Fraction(value) / step)) * step
