"""A bound on staying safe in the env's own steps: held input, safety judged at control instants.

Theorem. Let B be a box, W the workspace and S = C & W & B. Let psi be a polynomial with psi <= 0 on
B minus S and psi <= c on S, c > 0. Let G be the part of S where psi > 0, and let, for every x in G
and every input u that the controller may choose there, X' = F(x, u, xi) have

    E psi(X') >= psi(x) - m   and   E [max(psi(X'), 0); X' not in B] <= e.

Then P(X_0, ..., X_K in S) >= (psi(x_0) - K (m + e))/c for every x_0 in B.

Proof. Let p = max(psi, 0) and I_k = 1{X_0, ..., X_k in S}. Where I_k = 1 and X_k is in G, psi <= 0
on B minus S gives E [I_(k+1) p(X')] >= E [psi(X'); X' in S] >= E [psi(X'); X' in B] >= p(X_k) - m -
e, and elsewhere p(X_k) = 0. So E I_(k+1) p(X_(k+1)) >= E I_k p(X_k) - (m + e), and c P(I_K = 1) >=
E I_K p(X_K) >= p(x_0) - K (m + e). A start in B outside S has psi <= 0, and nothing is claimed.

Nothing is said of what the controller does where psi <= 0. It may remember and draw lots, as long
as it does not see the noise ahead. Steps may jump over an edge, which is why psi <= 0 is asked for
on all of B minus S and not only on the edge.

*Leaving the workspace* is a violation here, as it is for tables with leaving = "violation". For
`evaluate` an episode that leaves the workspace in C is safe. Staying is the smaller event, so that
for the same controller, starts and number of steps

    this bound <= probability of a safe episode as `evaluate` counts <= attainable upper bound,

where the last one has to count leaving as `evaluate` does (`evaluation_settings`).

*Every input under a constraint.* With q(u) = E psi(F(x, u, xi)), one input and its bounds, the
constraint is that the chord of q between the bounds be at least psi - m1. It is affine in u, and an
end of the bounds meets it wherever the better end has q >= psi - m1. If moreover q is not below its
chord by more than m2 (1 - v^2), v in [-1, 1] the scaled input, every input that meets the
constraint has E psi(X') >= psi - m1 - m2, and m = m1 + m2. The constraint of continuous time does
not give that: a full input may carry the state past the top of psi within one step.

*Tail.* In scaled variables the mean of X' lies t_i standard deviations inside B, and these are at
most nu_i, so that |z_i'| <= 1 + nu_i |N_i| with standard normals N_i, and |psi(X')| <=
L prod (1 + nu_i |N_i|)^(d_i) with the sum L of absolute coefficients and the degrees d_i. By
Hoelder's inequality, 1 + y <= e^y, E e^(a|N|) <= 2 e^(a^2/2) and P(|N| > t) <= e^(-t^2/2), for
every r > 1,

    e <= L prod_i 2^(1/(r n)) e^(r n nu_i^2 d_i^2/2) sum_j e^(-(1 - 1/r) t_j^2/2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import require_whole
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.certificate_statements import rounded_up
from safe_envs.wrappers.verification.held_statements import HeldStatements
from safe_envs.wrappers.verification.judge import JudgeResult, Supremum, judge, supremum
from safe_envs.wrappers.verification.statements import Statement

_POWERS = (1.5, 2.0, 4.0, 8.0, 16.0, 32.0)
_LARGE = 700.0
_SMALLEST = 1e-15
_SIGNS = "c > 0, dt > 0, and m1, m2 and e >= 0"
_LEAVES = "E max(psi(X'), 0) outside the box of psi <= e"
_ROUNDING = 1e-9
"""Of psi and of a tail, whose floats are exact to much less."""


@dataclass(frozen=True)
class HeldBound:
    """A bound on staying safe in the env's own steps; see the module.

    Attributes:
        plant: the system. With a policy the bound is of this one, else of every policy under the
            constraint `HeldStep.constraint(shortfall)`.
        psi: the barrier.
        period: control period in s.
        supremum: c.
        shortfall: m1, what the policy, or the constraint, lets psi fall in a step.
        sag: m2, 0 under a policy.
        tail: e.
        boxes: number of boxes that the proof took.
        reason: why there is no bound, in words; empty where there is one, which is then proved.
    """

    plant: Plant
    psi: Polynomial
    period: Fraction
    supremum: Fraction = Fraction(0)
    shortfall: Fraction = Fraction(0)
    sag: Fraction = Fraction(0)
    tail: Fraction = Fraction(0)
    boxes: int = 0
    reason: str = ""

    @property
    def loss(self) -> float:
        """What psi may fall in a step, m1 + m2 + e."""
        return float(self.shortfall + self.sag + self.tail)

    def held_bounds_at(self, starts: np.ndarray, steps: int) -> np.ndarray:
        """Return the bound on P(X_0, ..., X_K safe and in the workspace).

        Args:
            starts: states, shape (B, n).
            steps: K, control periods of an episode.

        Returns:
            Values in [0, 1], shape (B,); 0 where there is no bound.
        """
        require_whole("steps", steps, 0)
        if self.reason:
            return np.zeros(len(starts))
        middle, half = (np.array(part, dtype=float) for part in (self.psi.center, self.psi.scale))
        inside = (np.abs(starts - middle) <= half).all(axis=1)
        left = self.psi.values(starts) - _ROUNDING - steps * self.loss
        return np.where(inside, np.clip(left / float(self.supremum), 0.0, 1.0), 0.0)

    def judged(self, budget: Budget | None = None) -> list[tuple[str, JudgeResult]]:
        """Judge the statements of the bound again.

        Args:
            budget: of each.

        Returns:
            The name and the verdict of each; the bound is proved where all are.
        """
        if min(self.shortfall, self.sag, self.tail) < 0 or self.supremum <= 0 or self.period <= 0:
            return [(_SIGNS, JudgeResult("refuted", 0, reason=f"not {_SIGNS}"))]
        parts = HeldStatements(self.plant, self.psi, self.period)
        top = parts.region("psi <= c", sp.Rational(self.supremum) - parts.value)
        numbers = [self.shortfall, self.sag]
        # As their suprema were bounded: the kink decides which sides of boxes are bisected.
        steps = [
            replace(claim, claim=sp.Rational(most) - sp.Max(0, -claim.claim, evaluate=False))
            for claim, most in zip(parts.step_claims(0, 0), numbers, strict=False)
        ]
        statements = [top, *parts.outside(), *steps]
        found = [(statement.name, judge(statement, budget)) for statement in statements]
        return [*found, (_LEAVES, self._judged_tail(parts, budget or Budget()))]

    def _judged_tail(self, parts: HeldStatements, budget: Budget) -> JudgeResult:
        work = _Numbers(budget, self)
        found = _tail(parts, work)
        if work.reason or found > float(self.tail):
            reason = work.reason or f"it is at most {found:.3g}, and not at most e"
            return JudgeResult("undecided", work.boxes, reason=reason)
        return JudgeResult("proved", work.boxes)


def prove_held_bound(
    plant: Plant,
    psi: Polynomial,
    period: Fraction,
    tolerance: float = 2e-5,
    budget: Budget | None = None,
) -> HeldBound:
    """Prove the least numbers of a held bound for a psi, after lowering it where it is not safe.

    Args:
        plant: the system, with a policy or without.
        psi: candidate, of size about 1; B is the box where its scaled variables lie in [-1, 1].
        period: control period in s.
        tolerance: by how much m1 and m2 may be larger than they have to be.
        budget: of each number.

    Returns:
        The bound, or why there is none.

    Raises:
        ConfigurationError: There are several inputs and no policy.
    """
    work = _Numbers(budget or Budget(), HeldBound(plant, psi, period))
    parts = HeldStatements(plant, psi, period)
    excess = max(0.0, *(work.lack(s, 5.0 * tolerance) for s in parts.outside()))
    if work.reason:
        return work.without_bound()
    if excess > 0.0:
        psi = _lowered(psi, _up(excess))
        parts = HeldStatements(plant, psi, period)
    region = parts.region("the region of psi", sp.Integer(0))
    top = work.bound(region, parts.value, 5.0 * tolerance)
    lacks = [work.lack(s, tolerance) for s in parts.step_claims(0, 0)]
    tail = _tail(parts, work)
    if work.reason or not top > 0.0:
        return work.without_bound()
    return replace(
        work.found,
        psi=psi,
        supremum=_up(top),
        shortfall=_up(lacks[0]),
        sag=_up(lacks[1]) if len(lacks) > 1 else Fraction(0),
        tail=_up(tail),
        boxes=work.boxes,
    )


def _up(value: float) -> Fraction:
    """Return a decimal that is not below a number, and not too small for a file."""
    return rounded_up(max(value, _SMALLEST)) if value > 0.0 else Fraction(0)


class _Numbers:
    """Proved suprema, their cost, and why one of them was not found."""

    def __init__(self, budget: Budget, found: HeldBound) -> None:
        self._budget, self.found = budget, found
        self.boxes, self.reason = 0, ""

    def bound(self, statement: Statement, expression: Any, tolerance: float) -> float:
        """Return a proved upper bound of an expression over a region.

        Args:
            statement: whose region is taken.
            expression: of its symbols.
            tolerance: by how much it may be too large.
        """
        if self.reason:
            return math.inf
        known: Supremum = supremum(statement, expression, tolerance, self._budget)
        self.boxes += known.boxes
        if known.upper == math.inf:
            self.reason = known.reason or f"{statement.name}: no bound was found"
        return known.upper

    def lack(self, statement: Statement, tolerance: float) -> float:
        """Return a proved bound of what the claim of a statement is below 0, at least 0.

        Args:
            statement: with the claim.
            tolerance: by how much it may be too large.
        """
        return self.bound(statement, sp.Max(0, -statement.claim, evaluate=False), tolerance)

    def without_bound(self) -> HeldBound:
        """Return a bound that says why there is none."""
        reason = self.reason or "psi is nowhere above 0"
        return replace(self.found, boxes=self.boxes, reason=reason)


def _lowered(psi: Polynomial, excess: Fraction) -> Polynomial:
    origin = (0,) * psi.n
    lowered = psi.coefficients.get(origin, Fraction(0)) - excess
    return replace(psi, coefficients={**psi.coefficients, origin: lowered})


def _tail(parts: HeldStatements, work: _Numbers) -> float:
    """Return a bound of E [max(psi(X'), 0); X' not in B] over G and the inputs."""
    distances, deviations = [], []
    region = parts.region("the noise of a step", sp.Integer(0))
    for i, (moved, away) in enumerate(parts.moves()):
        half = float(parts.psi.scale[i])
        gap = half - work.bound(moved, away, 5e-3 * half)
        variance = work.bound(region, parts.step.covariance[i][i], 1e-9 * half**2)
        if work.reason:
            return math.inf
        deviation = math.sqrt(max(variance, 0.0)) * (1.0 + _ROUNDING)
        if gap < 0.0:
            work.reason = (
                f"a step from where psi > 0 may leave the box of psi along {parts.plant.states[i]}"
                f" by {-gap:.3g}; make the box larger"
            )
            return math.inf
        distances.append(math.inf if deviation == 0.0 else gap / deviation * (1.0 - _ROUNDING))
        deviations.append(deviation / half)
    return tail_bound(parts.psi, deviations, distances)


def tail_bound(psi: Polynomial, deviations: Sequence[float], distances: Sequence[float]) -> float:
    """Return a bound of E [|psi(X')|; X' not in B] for a Gaussian X' with its mean in B.

    Args:
        psi: polynomial; B is the box where its scaled variables lie in [-1, 1].
        deviations: upper bounds of the standard deviations nu_i of the scaled variables.
        distances: lower bounds of the numbers t_i of standard deviations from the mean to the ends
            of B; infinite where there is no noise.
    """
    size = float(sum(abs(c) for c in psi.coefficients.values()))
    degrees = [max((k[i] for k in psi.coefficients), default=0) for i in range(psi.n)]
    found = math.inf
    for r in _POWERS:
        spread = sum((nu * d) ** 2 for nu, d in zip(deviations, degrees, strict=True))
        growth = math.log(2.0) / r + r * psi.n * spread / 2.0
        parts = [growth - (1.0 - 1.0 / r) * t * t / 2.0 for t in distances]
        found = min(found, size * sum(math.exp(min(part, _LARGE)) for part in parts))
    return found * (1.0 + _ROUNDING)
