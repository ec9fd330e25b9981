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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.filters.certificates.certificate import (
    CheckResult,
    HeldCertificate,
    Plant,
    StatementCheck,
    Word,
    combined,
)
from safe_envs.filters.certificates.held_step import HeldStep, Order
from safe_envs.proofs.guarantees import rounded_up
from safe_envs.proofs.judge import (
    Budget,
    JudgeResult,
    PolynomialPart,
    Statement,
    Supremum,
    judge,
    supremum,
)

_NEAR = 0.05
"""Distance from the edge of C, in half widths of B, within which the slope of psi is of use."""


@dataclass
class HeldStatements:
    """The statements of the theorem for the judge.

    Attributes:
        plant: the system; with a policy its inputs are those of the policy.
        psi: the barrier; B is the box where its scaled variables lie in [-1, 1].
        period: control period in s.
    """

    plant: Plant
    psi: Polynomial
    period: Fraction
    polynomials: dict[sp.Symbol, PolynomialPart] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._names: dict[tuple[int, Order], sp.Symbol] = {}
        self._kept: list[Polynomial] = []
        self.scaled_input: Any = sp.Dummy("v", real=True)
        self.value = self.symbol_of(self.psi, (0,) * self.psi.n)

    @cached_property
    def step(self) -> HeldStep:
        """The step of the env."""
        return HeldStep(self.plant, self.psi, self.period)

    def symbol_of(self, polynomial: Polynomial, order: Order) -> sp.Symbol:
        """Return the symbol of a derivative of a polynomial.

        Args:
            polynomial: whose derivative is taken.
            order: how often in each state.
        """
        key = (id(polynomial), order)
        if key not in self._names:
            self._kept.append(polynomial)  # As long as it lives, its id is its own.
            symbol: Any = sp.Dummy("psi_" + "_".join(map(str, order)), real=True)
            self._names[key] = symbol
            self.polynomials[symbol] = PolynomialPart(polynomial, order)
        return self._names[key]

    @property
    def box(self) -> tuple[tuple[Any, Any], ...]:
        """B."""
        pairs = zip(self.psi.center, self.psi.scale, strict=True)
        return tuple((sp.Rational(c - r), sp.Rational(c + r)) for c, r in pairs)

    @property
    def kept_box(self) -> tuple[tuple[Any, Any], ...]:
        """B inside the workspace."""
        return tuple(
            (sp.Max(low, a), sp.Min(high, b))
            for (low, high), (a, b) in zip(self.box, self.plant.workspace, strict=True)
        )

    def outside(self) -> list[Statement]:
        """Return statements whose regions are B minus S together, and whose claim gives psi <= 0.

        Where h <= 0, psi <= psi - l h for any l >= 0. With l the slope of psi across the edge of C,
        which is chosen on each box, this does not change across the edge.
        """
        states, box, parts = self.plant.states, self.box, self._own
        found = []
        for barrier in self.plant.barriers:
            slope: Any = sp.Dummy("slope", real=True)
            found.append(
                Statement(
                    "psi <= 0 where it is not safe",
                    states,
                    box,
                    slope * barrier - self.value,
                    nonnegative=(-barrier,),
                    polynomials=parts,
                    witnesses=(slope,),
                    witness=_slope_across(self.psi, barrier),
                )
            )
        for i, ((low, high), (a, b)) in enumerate(zip(box, self.plant.workspace, strict=True)):
            for end in ((low, a), (b, high)):
                if end[0] <= end[1]:
                    slab = (*box[:i], end, *box[i + 1 :])
                    name = "psi <= 0 outside the workspace"
                    found.append(Statement(name, states, slab, -self.value, polynomials=parts))
        return found

    def region(
        self,
        name: str,
        claim: Any,
        further: tuple[sp.Symbol, ...] = (),
        polynomials: Mapping[sp.Symbol, PolynomialPart] | None = None,
    ) -> Statement:
        """Return a statement about G, where psi and all h are above 0 in B and in the workspace.

        Args:
            name: in words.
            claim: that is to be at least 0.
            further: symbols that take all values: inputs, or `scaled_input`.
            polynomials: what symbols in the claim stand for, if others than `value` do.
        """
        plant = self.plant
        ends = {self.scaled_input: (sp.Integer(-1), sp.Integer(1))}
        ends |= dict(zip(plant.inputs, plant.bounds, strict=True))
        positive = (self.value, *plant.barriers)
        return Statement(
            name,
            (*plant.states, *further),
            (*self.kept_box, *(ends[symbol] for symbol in further)),
            claim,
            positive=positive,
            polynomials=self._own if polynomials is None else polynomials,
        )

    def step_claims(self, shortfall: Any, sag: Any) -> list[Statement]:
        """Return the statements that the inputs keep E psi(X') >= psi(x) - m.

        Under a policy it is one statement. For every input under the constraint, one says that an
        end of the bounds meets it, the other one that psi sags by no more below the chord between.

        Args:
            shortfall: m of the policy or of the constraint.
            sag: how far the expectation may be below its chord, over (1 - v^2) with the scaled
                input v.
        """
        if self.plant.policy:
            gain = self.step.gain(self.plant.policy, self.symbol_of)
            name = "E psi(X') >= psi - m along the policy"
            return [self.region(name, gain + shortfall, polynomials=self.polynomials)]
        by_input = self.step.gain_by_input(self.symbol_of)
        ends = [sum(c * v**j for j, c in enumerate(by_input)) for v in (-1, 1)]
        v = self.scaled_input
        # Each power but the first two is below its chord by a multiple of 1 - v^2.
        above = -sum(
            c * sum(v ** (2 * k + j % 2) for k in range(j // 2)) for j, c in enumerate(by_input)
        )
        return [
            self.region(
                "E psi(X') >= psi - m at an end of the bounds",
                sp.Max(*ends, evaluate=False) + shortfall,
                polynomials=self.polynomials,
            ),
            self.region(
                "E psi(X') above its chord over the bounds",
                above + sag,
                (v,),
                polynomials=self.polynomials,
            ),
        ]

    def moves(self) -> list[tuple[Statement, Any]]:
        """Return, for each state, a region and how far the mean of X' is from the middle of B."""
        chosen = dict(zip(self.plant.inputs, self.plant.policy, strict=False))
        further = () if self.plant.policy else self.plant.inputs
        found = []
        for state, move, center in zip(
            self.plant.states, self.step.moves, self.psi.center, strict=True
        ):
            away = sp.Abs(state - sp.Rational(center) + move.xreplace(chosen))
            found.append((self.region("the mean of X'", sp.Integer(0), further), away))
        return found

    @property
    def _own(self) -> dict[sp.Symbol, PolynomialPart]:
        return {self.value: self.polynomials[self.value]}


def _slope_across(psi: Polynomial, barrier: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function of states that gives the slope of psi with h on the edge next to them."""
    slopes = [sp.diff(barrier, s) for s in psi.states]
    values = compile_function(psi.states, [sp.N(e, 17) for e in (barrier, *slopes)], "arrays")
    gradient = [psi.derivative(i) for i in range(psi.n)]
    reach = _NEAR * float(min(psi.scale))

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = stacked(values(*np.ascontiguousarray(x.T)), len(x))
        h, slopes = found[:, 0], found[:, 1:]
        return h, slopes, (slopes**2).sum(axis=1) + 1e-300

    def slope(x: np.ndarray) -> np.ndarray:
        h, edge = at(x)[0], x
        # Two steps of Newton's method lead to the edge, where psi and h are near 0 together.
        for _ in range(2):
            level, slopes, square = at(edge)
            edge = edge - slopes * (level / square)[:, None]
        _, slopes, square = at(edge)
        across = sum(p.values(edge) * slopes[:, i] for i, p in enumerate(gradient)) / square
        # Below the edge no more than what keeps psi - l h below 0, and nothing farther away.
        with np.errstate(all="ignore"):
            across = np.where(h < 0.0, np.minimum(across, psi.values(x) / h), across)
        near = np.maximum(0.0, 1.0 - np.abs(h) / np.sqrt(square) / reach)
        return np.nan_to_num(near * np.maximum(across, 0.0), posinf=0.0)[:, None]

    return slope


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


_BUDGET = Budget(seconds=60.0)

_WORDS: dict[str, Word] = {"proved": "checked", "refuted": "refuted", "undecided": "undecided"}


def held_certificate(
    bound: HeldBound, steps: int, env_id: str = "", options: dict[str, object] | None = None
) -> HeldCertificate:
    """Return the certificate of a bound.

    Args:
        bound: that is proved.
        steps: K, control periods of an episode.
        env_id: of the env; empty for other systems.
        options: of the env.

    Raises:
        ConfigurationError: There is no bound.
    """
    if bound.reason:
        raise ConfigurationError(f"there is no bound to certify: {bound.reason}")
    return HeldCertificate(
        env_id,
        options or {},
        bound.plant,
        bound.psi,
        bound.period,
        steps,
        bound.supremum,
        bound.shortfall,
        bound.sag,
        bound.tail,
    )


def stated_bound(certificate: HeldCertificate) -> HeldBound:
    """Return the bound that a certificate states; nothing of it is proved here.

    Args:
        certificate: of held input.
    """
    return HeldBound(
        _clipped(certificate.plant),
        certificate.psi,
        certificate.period,
        certificate.supremum,
        certificate.shortfall,
        certificate.sag,
        certificate.tail,
    )


def check_held(certificate: HeldCertificate, seconds: float) -> CheckResult:
    """Judge the statements of a certificate of held input.

    Args:
        certificate: to check, which may be a stranger's.
        seconds: limit of time of each statement.

    Returns:
        A word for each statement; the bound is proved where all are checked.
    """
    verdicts = stated_bound(certificate).judged(Budget(seconds=seconds))
    return combined([_check_of(name, verdict) for name, verdict in verdicts])


def why_not_proved(certificate: HeldCertificate) -> str:
    """Return why the bound of a certificate is not proved, in words; "" where it is.

    Each certificate is judged once.

    Args:
        certificate: of held input.
    """
    parts = [getattr(certificate, each.name) for each in fields(certificate)[2:]]
    # A dictionary has no hash.
    key = repr([*parts, sorted(certificate.psi.coefficients.items())])
    if key not in _KNOWN:
        verdicts = stated_bound(certificate).judged(_BUDGET)
        reasons = (f"{name}: {v.reason}" for name, v in verdicts if v.word != "proved")
        _KNOWN[key] = next(reasons, "")
    return _KNOWN[key]


_KNOWN: dict[str, str] = {}


def _check_of(name: str, verdict: JudgeResult) -> StatementCheck:
    state = verdict.state
    if state is None and verdict.box is not None:
        state = verdict.box.mean(axis=0)
    return StatementCheck(
        name, _WORDS[verdict.word], verdict.boxes, state=state, reason=verdict.reason
    )


def _clipped(plant: Plant) -> Plant:
    """Return a plant whose policy is within the bounds, as the env clips it."""
    policy: Any = tuple(
        sp.Max(low, sp.Min(high, u))
        for u, (low, high) in zip(plant.policy, plant.bounds, strict=False)
    )
    return replace(plant, policy=policy)
