"""Lower bounds on the probability of staying safe: what suits conditions, and what it is worth.

All of them are of continuous time, with the condition met at every instant: an input that is held
for a control period meets it at its beginning only. They follow from one inequality. Let G be the
set where b_0, ..., b_(r-1) are positive, cut to the inside of the workspace where leaving that ends
an episode. Let b be twice continuously differentiable in G, continuous on its closure and at most
c. Let X be stopped when it leaves G, at the time tau, and let A b >= -a b - m up to then, with a, m
>= 0. Then

    e^(a t) b(X_t) + m (e^(a t) - 1)/a     (m t in place of the last term where a = 0)

is a submartingale up to tau, so that b(x_0) is at most its expectation at min(tau, T), which is at
most e^(a T) c P(b is not 0 at min(tau, T)) + m (e^(a T) - 1)/a. That gives `stage_bound`. All
others follow from it. An episode that has left the workspace before is at an end, and safe until
then: so c and m are taken over G alone. For that a >= 0 is needed, since tau may come before T.

These are theorems about the numbers they are given. A bound with c and m from a search is an
estimate: a larger c or m that the search did not find would make it smaller.

Every function broadcasts over arrays of starts, and returns values in [0, 1]. A value of 0
guarantees nothing, and so does an infinite c.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from safe_envs.dynamics.codegen import tabulated
from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.kinks import edges
from safe_envs.dynamics.lie import has_kinks
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.filters.certificates.matching import system_differences
from safe_envs.filters.conditions.base import AffineConstraint, Condition
from safe_envs.filters.conditions.certified import Certified
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.analysis import SafeSetAnalysis
from safe_envs.proofs.judge import (
    Budget,
    JudgeResult,
    PolynomialPart,
    Statement,
    Witness,
    Word,
    exact_number,
    judge,
    largest_input_term,
    not_polynomial,
    supremum,
)
from safe_envs.proofs.safe_set import (
    NOT_ESTABLISHED,
    Formulas,
    draw_starts,
    in_workspace,
    workspace_of,
)
from safe_envs.text import number_at_least, number_at_most

_FOREVER = math.inf


def stage_bound(
    b: ArrayLike, c: ArrayLike, horizon: float = _FOREVER, rate: float = 0.0, shortfall: float = 0.0
) -> np.ndarray:
    """Return [b e^(-a T) - m (1 - e^(-a T))/a]/c: a bound on P(X does not leave by b = 0 up to T).

    Hypotheses: A b >= -a b - m wherever X is before it leaves the set; b is positive at the start;
        b <= c there.

    Args:
        b: value at the start.
        c: supremum of b over the set.
        horizon: T in s; infinite for ever.
        rate: a >= 0 in 1/s.
        shortfall: m >= 0 in the units of b per s.

    Source: Doob's optional stopping; for m = 0 thesis Prop. 4.2.8, and Prop. 4.2.5 without the
        misprint of Eq. (4.16), which has e^(-c T), false for a > c.
    """
    b, c = np.asarray(b, dtype=np.float64), np.asarray(c, dtype=np.float64)
    # (1 - e^(-a T))/a without the loss of digits at small a T; T itself in the limit.
    spent = -math.expm1(-rate * horizon) / rate if rate else horizon
    lost = shortfall * spent if shortfall else 0.0
    left = b * (math.exp(-rate * horizon) if rate else 1.0) - lost
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where((b > 0.0) & (c > 0.0) & np.isfinite(c), left / c, 0.0)
    return np.clip(bound, 0.0, 1.0)


def union_bound(
    b: ArrayLike,
    c: ArrayLike,
    horizon: float = _FOREVER,
    rates: Sequence[float] | None = None,
    shortfalls: Sequence[float] | None = None,
) -> np.ndarray:
    """Return max(0, sum of the stages' bounds - (r - 1)): the valid form of Thm. 4.2.10.

    X leaves the set through some b_j: each of these events has at most the probability that its
    `stage_bound` leaves, and together at most their sum. No independence is needed.

    Hypotheses: A b_j >= -a_j b_j - m_j for each j while all of b_0..b_(r-1) are positive. For j < r
        - 1 that holds by the definition b_(j+1) = A b_j + a_j b_j, with m_j = 0; for the last one
        it is the condition. All b_j are positive at the start, and each c_j = sup b_j over the
        intersection of the {b_j >= 0} is finite. Stages of several barriers may be put together if
        one action meets all conditions up to the m_j.

    Args:
        b: b_0..b_(r-1) at the starts, shape (..., r).
        c: c_0..c_(r-1), shape (r,).
        horizon: T in s; infinite for ever.
        rates: a_1..a_r in 1/s; zeros by default.
        shortfalls: m_j of each stage; zeros by default.

    Returns:
        Bounds, shape (...).

    Source: union bound over the exits of the b_j. The product of the b_j/c_j, thesis Thm. 4.2.10,
        has no valid proof for r >= 2: Eq. (4.23) conditions on the future, and simulated systems
        fall below the product.
    """
    values, suprema = np.asarray(b, dtype=np.float64), np.asarray(c, dtype=np.float64)
    count = values.shape[-1]
    numbers = zip(rates or (0.0,) * count, shortfalls or (0.0,) * count, strict=True)
    kept = (
        stage_bound(values[..., j], suprema[j], horizon, a, m) for j, (a, m) in enumerate(numbers)
    )
    return np.clip(sum(kept) - (count - 1), 0.0, 1.0)


Status = Literal[
    "proved", "estimated", "withheld", "hypothesis fails", "no bound", "not established"
]
"""What a bound is worth: the judge proved all hypotheses and numbers; a search found none that
fails, and the judge left one undecided; episodes contradicted it; one fails; there is none; or an
assumption is known to be false or was not looked at."""

RELATIVE = 1e-6
"""Error that a search and rounding may leave, in parts of the number itself."""

HOLDING: tuple[Status, ...] = ("proved", "estimated")
"""Of a bound whose hypotheses are not known to fail."""


class Extremum(NamedTuple):
    """The largest value of a function on a set: what a search met, and what the judge proved.

    Attributes:
        found: largest value that the search met, below the supremum or equal to it.
        proved: upper bound that the judge proved; infinite without one.
    """

    found: float
    proved: float = math.inf

    @property
    def is_proved(self) -> bool:
        """Whether there is a proved upper bound."""
        return math.isfinite(self.proved)

    @property
    def value(self) -> float:
        """The proved bound or, without one, what the search met."""
        return self.proved if self.is_proved else self.found

    def text(self, below: str = "at most", above: str = "at least", digits: int = 4) -> str:
        """Return the number and on which side of it the supremum is.

        Args:
            below: says that the supremum is not above a number that is proved.
            above: says that it is not below a number that a search met.
            digits: of the number.
        """
        if self.is_proved:
            return f"{below} {number_at_most(self.proved, digits)}"
        return f"{above} {number_at_least(self.found * (1.0 + RELATIVE), digits)}, found by search"


@dataclass(frozen=True)
class Bound:
    """A lower bound on the probability of staying safe.

    Attributes:
        name: of the result.
        value: at the start, or its mean over several; None if there is none.
        error: standard error of that mean as the mean over all starts; 0 for one start.
        status: what it is worth.
        reason: why, in words; may be empty where it is proved.
        forever: whether it is of all times, not only up to the horizon.
    """

    name: str
    value: float | None
    status: Status
    reason: str
    forever: bool = False
    error: float = 0.0

    def without(self, reason: str) -> Bound:
        """Return the bound as withheld for a reason, if it is one and there is a reason."""
        if not reason or self.status not in HOLDING:
            return self
        return replace(self, value=None, error=0.0, status="withheld", reason=reason)


class Stages(NamedTuple):
    """The chains of all barriers, with what the bounds need of them.

    Attributes:
        rates: of each stage, in 1/s; NaN where a chain has none.
        suprema: c_j of each.
        shortfalls: m_j of each, 0 except for the last one of a barrier.
        barriers: how many there are.
    """

    rates: tuple[float, ...]
    suprema: tuple[float, ...]
    shortfalls: tuple[float, ...]
    barriers: int = 1


def stages_of(formulas: Formulas, suprema: Sequence[float] | None, shortfall: float) -> Stages:
    """Return the stages of conditions.

    Args:
        formulas: of the conditions.
        suprema: of the chain functions; None where every path is safe, so that none matters.
        shortfall: by which any of them may be violated.
    """
    rates: list[float] = []
    shortfalls: list[float] = []
    for condition, stage in zip(formulas.conditions, formulas.stages, strict=True):
        degree = stage.stop - stage.start
        rates += condition.chain_rates(degree) or (math.nan,) * degree
        shortfalls += [*[0.0] * (degree - 1), shortfall]
    numbers = tuple(suprema or (1.0,) * len(rates))
    return Stages(tuple(rates), numbers, tuple(shortfalls), len(formulas.stages))


class Candidate(NamedTuple):
    """A result that suits the conditions.

    Attributes:
        name: of it.
        values: at the starts, shape (B,).
        forever: whether it is of all times.
        allows_shortfall: whether the conditions may be violated somewhere.
    """

    name: str
    values: np.ndarray
    forever: bool = False
    allows_shortfall: bool = False


def without_shortfall(b: np.ndarray, stages: Stages, horizon: float) -> Candidate:
    """Return the result for conditions that can be met everywhere, under noise.

    Args:
        b: values of all chain functions at the starts, shape (B, sum of the r).
        stages: of all barriers.
        horizon: T in s.
    """
    forever, several = not any(stages.rates), stages.barriers > 1
    values = union_bound(b, stages.suprema, math.inf if forever else horizon, stages.rates)
    if len(stages.rates) == 1:
        corrected = "Prop. 4.2.5, corrected: (h/c) e^(-k T)"
        return Candidate("Prop. 4.2.8: h/c, for ever" if forever else corrected, values, forever)
    length = "for ever" if forever else "up to T"
    name = f"union over the stages{' of all barriers' * several}, {length}"
    return Candidate(name, values, forever)


def holds_up_to_a_time(formulas: Formulas, stages: Stages) -> bool:
    """Return whether a shortfall, if there is one, is known not to matter up to some time.

    Args:
        formulas: of conditions that no path leaves.
        stages: of all barriers.
    """
    noisy = formulas.noisy or any(map(math.isnan, stages.rates))
    return not (any(stages.shortfalls) and noisy)


def candidates_for(
    formulas: Formulas, b: np.ndarray, stages: Stages, horizon: float, shortfall: Extremum
) -> list[Candidate]:
    """Return the results that suit conditions; the last one has the weakest hypotheses.

    One that needs the conditions to be met everywhere is left out where they cannot be, if another
    result allows for that.

    Args:
        formulas: of the conditions.
        b: values of all chain functions at the starts, shape (B, sum of the r).
        stages: of all barriers.
        horizon: T in s.
        shortfall: m.
    """
    repaired: list[Candidate] = []
    if not formulas.certain:
        plain = without_shortfall(b, stages, horizon)
        if any(stages.shortfalls):
            values = union_bound(b, stages.suprema, horizon, stages.rates, stages.shortfalls)
            name = f"repaired for the shortfall m {shortfall.text('=', '>=')}, up to T"
            repaired = [Candidate(name, values, allows_shortfall=True)]
    else:
        sure = "Prop. 4.2.2: safe with probability 1"
        name = sure if formulas.noisy else "no noise: no path leaves"
        plain = Candidate(name, (b > 0.0).all(axis=1).astype(float), True)
        if any(stages.shortfalls) and holds_up_to_a_time(formulas, stages):
            name = "no noise, in spite of the shortfall: safe up to T"
            values = surely_safe(stages, b, horizon)
            repaired = [Candidate(name, values, allows_shortfall=True)]
    return repaired if repaired and shortfall.found else [plain, *repaired]


def surely_safe(stages: Stages, b: np.ndarray, horizon: float) -> np.ndarray:
    """Return 1 for starts from which no path leaves up to T, and 0 elsewhere, shape (B,).

    Without noise b is at least what `stage_bound` subtracts from, so that a positive one is enough.

    Args:
        stages: of all barriers.
        b: values of all chain functions at the starts, shape (B, sum of the r).
        horizon: T in s.
    """
    safe = [
        (stage_bound(b[:, j], 1.0 + abs(b[:, j]), horizon, rate, m) > 0.0 if m else b[:, j] > 0.0)
        for j, (rate, m) in enumerate(zip(stages.rates, stages.shortfalls, strict=True))
    ]
    return np.all(safe, axis=0).astype(float)


def no_bound(formulas: Formulas) -> str:
    """Say why there is no bound whatever the numbers are; "" if there may be one."""
    if any(isinstance(condition, Certified) for condition in formulas.conditions):
        return "its bound is that of the certificate, and not one of the chain of h"
    if not formulas.noisy:
        return ""
    for condition, stage in zip(formulas.conditions, formulas.stages, strict=True):
        if not condition.stochastic:
            return f"{condition.name} ignores the noise"
        rates = condition.chain_rates(stage.stop - stage.start)
        if rates is None and not condition.almost_sure:
            return f"{condition.name} has no chain of rates, as the bounds need under noise"
    if not formulas.certain and any(c.almost_sure for c in formulas.conditions):
        return "the barriers have conditions of different kinds"
    functions = zip(formulas.names, formulas.chain_expressions, strict=True)
    return next(filter(None, (kinked(name, function) for name, function in functions)), "")


def kinked(name: str, function: Any) -> str:
    """Say that a function has a kink, where noise adds a local time to its generator; "" if not.

    Args:
        name: of the function.
        function: expression of the states.

    Returns:
        A text.
    """
    asked = "is not twice differentiable, which Ito's formula asks for"
    symbols = sorted(function.free_symbols, key=str)
    return f"{name} {asked}" if has_kinks(function) and edges(function, symbols, 2) else ""


def mismatch(formulas: Formulas) -> str:
    """Say in what the system that the conditions know differs from the plant; "" if in nothing."""
    plant, known = formulas.problem.plant, formulas.system
    theirs, ours = (
        {
            "drift": s.exact(s.drift),
            "input_matrix": s.exact(s.input_matrix),
            # Noises with the same covariance are the same.
            "diffusion": s.exact(s.diffusion * s.diffusion.T),
        }
        for s in (plant, known)
    )
    parts = [n for n, part in theirs.items() if not all(map(is_zero, part - ours[n]))]
    names = [p.name for p, value in plant.parameters.items() if known.parameters.get(p) != value]
    return f"the model differs from the plant in {', '.join(names or parts)}" if parts else ""


def failures(analysis: SafeSetAnalysis) -> list[str]:
    """Return the hypotheses that fail, apart from the shortfall, in words."""
    rough = "" if nearly_rough(analysis) else analysis.rough
    found = [mismatch(analysis.formulas), _undefined(analysis), rough]
    if analysis.runaway:
        found.append("it asks for unbounded control towards the edge")
    return [reason for reason in found if reason]


def nearly_rough(analysis: SafeSetAnalysis) -> str:
    """Say which function comes so near to a pole or kink that a search cannot tell; "" if none."""
    return analysis.rough if analysis.rough.startswith(NOT_ESTABLISHED) else ""


JOINT = "the shortfall of several conditions together is not established"
"""What is not known where conditions share the inputs and cannot all be met."""


def _undefined(analysis: SafeSetAnalysis) -> str:
    if not len(analysis.undefined):
        return ""
    states = zip(analysis.formulas.problem.states, analysis.undefined[0].tolist(), strict=True)
    return (
        "the condition has no finite value at"
        f" {', '.join(f'{s.symbol} = {value:.3g}' for s, value in states)}"
    )


def outside(formulas: Formulas, b: np.ndarray) -> str:
    """Say where the start is outside, by the value that is lowest.

    Args:
        formulas: of the chains.
        b: values of all b_j at the starts, shape (B, sum of the r).

    Returns:
        A text.
    """
    if (b > 0.0).any(axis=0).all():
        return "no start lies in all C_j at once"
    j = int(b.max(axis=0).argmin())
    stage = j - next(s.start for s in formulas.stages if s.start <= j < s.stop)
    return f"the start is outside C_{stage}: {formulas.names[j]} = {b[:, j].max():.4g}" + (
        " at most" if len(b) > 1 else ""
    )


def amount(shortfall: Extremum) -> str:
    """Say by how much a condition is violated at most or, where that is not proved, at least."""
    return shortfall.text("by up to", "by at least")


def missed_somewhere(shortfall: Extremum, negligible: float) -> str:
    """Say that the conditions cannot be met somewhere, or that this is not excluded; may be empty.

    Args:
        shortfall: of the conditions.
        negligible: below this a proved one is not worth a word.

    Returns:
        A text.
    """
    if shortfall.found:
        return f"no action meets the condition somewhere, {amount(shortfall)}"
    if not shortfall.is_proved or shortfall.proved <= negligible:
        return ""
    return (
        "that an action meets the condition everywhere is not proved, but that the best one misses"
        f" it by {shortfall.text()}"
    )


def infeasible(analysis: SafeSetAnalysis, shortfall: Extremum) -> str:
    """Say on which part of the invariant set the conditions cannot be met; "" if on none.

    Args:
        analysis: of the safe set.
        shortfall: of the conditions.

    Returns:
        A text.
    """
    formulas, part = analysis.formulas, analysis.infeasible
    if not shortfall.found:
        return ""
    share = f"about {100 * part:.2g} % of" if part else "a thin part of"
    where = "C" if formulas.first_order else "the intersection of the C_j"
    conditions = "the condition" if len(formulas.conditions) == 1 else "all conditions"
    return f"no action meets {conditions} on {share} {where}, {amount(shortfall)}"


def unbounded(analysis: SafeSetAnalysis) -> str:
    """Say which supremum is infinite, where one matters; "" if none is."""
    if analysis.formulas.certain or not np.isinf(analysis.suprema).any():
        return ""
    j = int(np.isinf(analysis.suprema).argmax())
    return f"sup {analysis.formulas.names[j]} {analysis.how_infinite(j)}"


def above_suprema(formulas: Formulas, suprema: Sequence[Extremum], x: np.ndarray) -> str:
    """Say which b_j is above its c_j at a state of the invariant set; "" if none is.

    Args:
        formulas: of the chains.
        suprema: of each chain function.
        x: states (B, n), those outside the set or the workspace among them.

    Returns:
        A text.
    """
    if formulas.certain:
        return ""  # No supremum matters there.
    b = formulas.chain(x[_inside(formulas, x)])
    most = np.array([each.value for each in suprema])
    for j in np.flatnonzero((b > most * (1.0 + RELATIVE)).any(axis=0)).tolist():
        return reaches(formulas.names[j], float(b[:, j].max()), suprema[j])
    return ""


def above_shortfall(formulas: Formulas, shortfall: Extremum, x: np.ndarray, u: np.ndarray) -> str:
    """Say by how much actions violate the conditions, if by more than was found; "" if not.

    Args:
        formulas: of the conditions.
        shortfall: the largest one.
        x: states (E, n); those outside the invariant set do not count.
        u: actions (E, m).

    Returns:
        A text.
    """
    inside = _inside(formulas, x)
    if not inside.any():
        return ""
    a, b = formulas.constraints_at(x[inside])
    moved = np.einsum("eki,ei->ek", a, u[inside])
    # Where a condition has no finite value nothing can be said of by how much it is violated.
    most = shortfall.value
    more = np.nan_to_num(-(moved + b) - most, nan=0.0) > RELATIVE * (most + abs(moved) + abs(b))
    return violated_by(float(np.where(more, -(moved + b), 0.0).max()), shortfall) * bool(more.any())


def reaches(name: str, value: float, supremum: Extremum) -> str:
    """Say that a function is above its supremum.

    Args:
        name: of the function.
        value: that it has.
        supremum: of the function.

    Returns:
        A text.
    """
    return f"{name} reaches {value:.4g}, above the supremum of {_sourced(supremum)}"


def violated_by(most: float, shortfall: Extremum) -> str:
    """Say that a filter violated its condition by more than the shortfall.

    Args:
        most: by how much, in the units of b_(r-1) per s.
        shortfall: of the condition.

    Returns:
        A text.
    """
    return (
        f"the filter violated the condition by {most:.4g}, more than the shortfall of"
        f" {_sourced(shortfall)}"
    )


def _sourced(number: Extremum) -> str:
    source = "is proved" if number.is_proved else "the search found"
    return f"{number.value:.4g} that {source}"


def _inside(formulas: Formulas, x: np.ndarray) -> np.ndarray:
    """Return which states are in the invariant set and in the workspace, shape (B,)."""
    return np.all(formulas.chain(x) > 0.0, axis=1) & in_workspace(x, workspace_of(formulas.problem))


BUDGET = Budget(boxes=300_000, seconds=60.0)
"""Of each statement of a bound: a second or two where there are few states and barriers, and
counted in boxes, so that its numbers do not depend on the machine."""

Verdict = TypeVar("Verdict")

_RELATIVE = 1e-3
_SMALL = 1e-7
_QUICK = 0.3
_SHOWN = 6
_WIDTHS = (1e1, 1e2, 1e4, 1e6)


class JudgedNumber(NamedTuple):
    """A number of a bound: a supremum, or a shortfall.

    Attributes:
        name: of the number.
        value: proved upper bound; infinite where there is none.
        verdict: that the number is at most this.
    """

    name: str
    value: float
    verdict: JudgeResult


class ChainProof:
    """What the judge proves of chains b_0, ..., b_(r-1) and their conditions.

    The region G of all statements is where all b_j are positive, in the workspace.

    Args:
        formulas: the chains and conditions.
        suprema: of the b_j, as a search found them.
        shortfall: the largest one, as a search found it.
        hints: states where the conditions may fail, shape (B, n).
        seconds: for all statements together; None for as long as each takes.
        budget: of each statement.
    """

    def __init__(
        self,
        formulas: Formulas,
        suprema: Sequence[float],
        shortfall: float,
        hints: np.ndarray,
        seconds: float | None = None,
        budget: Budget = BUDGET,
    ) -> None:
        self._formulas, self._found, self._lack = formulas, suprema, shortfall
        self._hints, self._budget, self._seconds = hints, budget, seconds
        exact, system = formulas.system.exact, formulas.system
        self._chain = tuple(exact(e) for e in formulas.chain_expressions)
        self._region = Statement(
            "G", system.states, self._workspace(), sp.Integer(1), positive=self._chain
        )

    def _workspace(self) -> tuple[tuple[Any, Any], ...]:
        """Return the exact ends of the workspace, of a whole period for an angle."""
        periodic = self._formulas.region.periodic.tolist()
        return tuple(
            (-sp.pi, sp.pi) if angle else (exact_number(v.low), exact_number(v.high))
            for v, angle in zip(self._formulas.problem.states, periodic, strict=True)
        )

    def _within(self, decide: Callable[[Budget], Verdict], part: float = 1.0) -> Verdict:
        """Let the judge decide something with a part of its boxes, in the time that is left."""
        budget, begun = self._budget, time.process_time()
        seconds = budget.seconds if self._seconds is None else min(self._seconds, budget.seconds)
        found = decide(Budget(round(part * budget.boxes), max(seconds, 0.0)))
        if self._seconds is not None:
            self._seconds -= time.process_time() - begun
        return found

    @cached_property
    def bounded(self) -> JudgeResult:
        """Whether G is bounded."""
        ends = [np.array(end, dtype=float) for end in zip(*self._region.box, strict=True)]
        open_ = [i for i in range(len(ends[0])) if np.isinf([ends[0][i], ends[1][i]]).any()]
        verdict = JudgeResult("proved", 0)
        for i in open_:
            for width in _WIDTHS:
                verdict = self._empty_beyond(i, width)
                if verdict.word == "proved":
                    break
            else:
                return verdict
        return verdict

    def _empty_beyond(self, i: int, width: float) -> JudgeResult:
        """Judge whether G has no state where x_i is beyond a number."""
        verdict = JudgeResult("proved", 0)
        for side in (-1, 1):
            beyond = (width, sp.oo) if side > 0 else (-sp.oo, -width)
            low, high = self._region.box[i]
            if (side > 0 and high != sp.oo) or (side < 0 and low != -sp.oo):
                continue
            box = (*self._region.box[:i], beyond, *self._region.box[i + 1 :])
            name = f"C is bounded in {self._region.states[i]}"
            empty = replace(self._region, name=name, box=box, claim=sp.Integer(-1))
            verdict = self._within(lambda budget, s=empty: judge(s, budget), _QUICK)
            if verdict.word != "proved":
                reason = f"{name} is not established"
                return JudgeResult("undecided", verdict.boxes, box=verdict.box, reason=reason)
        return verdict

    @cached_property
    def smooth(self) -> JudgeResult:
        """Whether all b_j are twice continuously differentiable on G."""
        statement = replace(self._region, name="the barrier on G", smooth=self._chain)
        return self._within(lambda budget: judge(statement, budget))

    @cached_property
    def continuous(self) -> JudgeResult:
        """Whether f, g and sigma are continuous on G."""
        system = self._formulas.system
        entries = [
            e for part in (system.drift, system.input_matrix, system.diffusion) for e in part
        ]
        asked = not_polynomial([system.exact(e) for e in entries], system.states)
        statement = replace(self._region, name="the system on G", continuous=asked)
        return self._within(lambda budget: judge(statement, budget))

    @property
    def regular(self) -> bool:
        """Whether the chains and the system are proved to be as smooth on G as bounds require."""
        return self.smooth.word == self.continuous.word == "proved"

    @cached_property
    def suprema(self) -> tuple[JudgedNumber, ...]:
        """Proved upper bounds of the b_j on G."""
        names = self._formulas.names
        return tuple(
            self._number(f"sup {name}", b, found, supremum_hints=True)
            for name, b, found in zip(names, self._chain, self._found, strict=True)
        )

    def _number(
        self, name: str, expression: Any, found: float, supremum_hints: bool = False
    ) -> JudgedNumber:
        """Prove an upper bound of an expression on G that is near what a search found."""
        wanted = max(_RELATIVE * abs(found) if math.isfinite(found) else 0.0, self.negligible)
        statement, hints = replace(self._region, name=name), None if supremum_hints else self._hints
        result = self._within(lambda budget: supremum(statement, expression, wanted, budget, hints))
        upper = max(result.upper, 0.0) if not math.isnan(result.upper) else math.inf
        if math.isfinite(upper):
            return JudgedNumber(name, upper, JudgeResult("proved", result.boxes))
        reason = result.reason or f"{name} is infinite"
        return JudgedNumber(name, math.inf, JudgeResult("undecided", result.boxes, reason=reason))

    @property
    def negligible(self) -> float:
        """A rate that over the horizon costs a bound nothing that matters."""
        size = min((c for c in self._found if math.isfinite(c) and c > 0.0), default=1.0)
        return _SMALL * size / self._formulas.problem.duration

    @cached_property
    def feasible(self) -> JudgeResult:
        """Whether some input within the bounds meets all conditions everywhere on G."""
        rows = self._rows
        if isinstance(rows, str):
            return JudgeResult("undecided", 0, reason=rows)
        name = "the condition can be met everywhere on G"
        if self._formulas.independent:
            best = sp.Min(*[self._best(row) for row in rows], evaluate=False)
            # Where the claim is 0 somewhere no budget suffices, but a small shortfall is proved.
            one = replace(self._region, name=name, claim=best)
            return self._within(lambda budget: judge(one, budget, self._hints), _QUICK)
        inputs = self._formulas.system.inputs
        claims = [
            sum(a * u for a, u in zip(self._coefficients(row), inputs, strict=True))
            + self._offset(row)
            for row in rows
        ]
        statement = replace(
            self._region,
            name="all conditions can be met at once on G",
            claim=sp.Min(*claims, evaluate=False),
            witnesses=inputs,
            witness=self._common_input,
        )
        verdict = self._within(lambda budget: judge(statement, budget))
        if verdict.word != "refuted":
            return verdict
        # The input that fails is one of many.
        reason = f"no input was found that meets all conditions: {verdict.reason}"
        return JudgeResult("undecided", verdict.boxes, box=verdict.box, reason=reason)

    @cached_property
    def shortfall(self) -> JudgedNumber:
        """Proved upper bound of what the best input misses a condition by on G."""
        name = "the shortfall"
        if self.feasible.word == "proved":
            return JudgedNumber(name, 0.0, self.feasible)
        rows = self._rows
        if isinstance(rows, str):
            return JudgedNumber(name, math.inf, JudgeResult("undecided", 0, reason=rows))
        if not self._formulas.independent:
            return JudgedNumber(name, math.inf, JudgeResult("undecided", 0, reason=JOINT))
        worst = sp.Max(*[-self._best(row) for row in rows], evaluate=False)
        return self._number(name, worst, self._lack)

    @property
    def _rows(self) -> tuple[AffineConstraint, ...] | str:
        """The constraints, or why the judge has no form of them."""
        rows = self._formulas.safety_filter.constraints
        if any(row.change is not None for row in rows):
            return (
                "a condition has a margin of first order for sampling, which has no interval form"
            )
        if any(row.uncertainty is not None or row.terms is not None for row in rows):
            return "a condition is learned or uncertain, which has no interval form"
        return tuple(rows)

    def _coefficients(self, row: AffineConstraint) -> list[Any]:
        return [self._formulas.system.exact(a) for a in row.coefficient]

    def _offset(self, row: AffineConstraint) -> Any:
        return self._formulas.system.exact(row.offset - (row.demand or 0))

    def _best(self, row: AffineConstraint) -> Any:
        """Return a u + b for the best input within the bounds."""
        bounds = [tuple(map(exact_number, ends)) for ends in self._formulas.problem.input_bounds]
        return self._offset(row) + largest_input_term(self._coefficients(row), bounds)

    def _common_input(self, x: np.ndarray) -> np.ndarray:
        """Return the inputs that the filter chooses at states, shape (B, m)."""
        rest = np.clip(0.0, *np.array(self._formulas.problem.input_bounds).T)
        with np.errstate(all="ignore"):
            found = self._formulas.safety_filter.filter(
                x, np.broadcast_to(rest, (len(x), len(rest)))
            )
        return np.nan_to_num(found.action)

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """All that a bound asks for, with the judge's word."""
        certain = self._formulas.certain
        found = [
            ("G is bounded", self.bounded),
            ("f, g and sigma are continuous on G", self.continuous),
            ("the barrier is twice differentiable on G", self.smooth),
        ]
        if not certain:
            found += [
                (f"{n.name} <= {number_at_most(n.value, _SHOWN)}", n.verdict) for n in self.suprema
            ]
        found.append(("the condition can be met everywhere on G", self.feasible))
        if self.feasible.word != "proved":
            number = self.shortfall
            amount = f" by at most {number_at_most(number.value, _SHOWN)}" * math.isfinite(
                number.value
            )
            found.append((f"the best input violates it{amount}", number.verdict))
        return found

    def word_of(self, allows_shortfall: bool) -> tuple[Word, str]:
        """Return whether a bound is proved, and why not.

        Args:
            allows_shortfall: whether it holds with a shortfall.
        """
        needed = [self.bounded, self.continuous, self.smooth]
        if not self._formulas.certain:
            needed += [number.verdict for number in self.suprema]
        needed.append(self.shortfall.verdict if allows_shortfall else self.feasible)
        for word in ("refuted", "undecided"):
            for verdict in needed:
                if verdict.word == word:
                    return word, verdict.reason
        return "proved", ""


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


_BUDGET = Budget(boxes=2_000_000, seconds=120.0)
_NAME = "barrier certificate: (psi_0 e^(-a T) - m (1 - e^(-a T))/a)/c"


@dataclass(frozen=True)
class CertificateGuarantee:
    """The bound of a barrier certificate, once the judge has proved its statements.

    Attributes:
        certificate: with psi and the numbers.
        against: why its bound is not one of the filter, in words; empty where it is.
    """

    certificate: BarrierCertificate
    against: str = ""
    remark = ""

    @cached_property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """The statements of the certificate, with the judge's word."""
        return judged(self.certificate, _BUDGET)

    @property
    def note(self) -> str | None:
        """Why there is no bound; None if there is one."""
        if self.against:
            return self.against
        refuted = (v.reason for _, v in self.statements if v.word == "refuted")
        return next(refuted, None)

    @property
    def word(self) -> Status:
        """Whether the bound is proved or estimated."""
        proved = all(verdict.word == "proved" for _, verdict in self.statements)
        return "proved" if proved else "estimated"

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the bound at starts; see `ChainGuarantee.at`."""
        starts = np.asarray(starts, dtype=np.float64)
        if self.note:
            return np.zeros(len(starts))
        return np.where(
            _inside_domain(self.certificate, starts),
            self.certificate.bounds_at(starts, horizon),
            0.0,
        )

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in c; see `ChainGuarantee.contradiction`."""
        psi = self.certificate.values(reached[_inside_domain(self.certificate, reached)])
        highest, c = float(psi.max(initial=-math.inf)), float(self.certificate.supremum)
        stated = Extremum(c, c)  # The judge does not refute it, or there is no bound.
        return reaches("psi", highest, stated) if highest > c * (1.0 + RELATIVE) else ""

    def applicable_bounds(self, starts: np.ndarray, horizon: float) -> list[Bound]:
        """Return the bound on average over starts; see `ChainGuarantee.applicable_bounds`."""
        if self.note:
            return [Bound(_NAME, None, "hypothesis fails", self.note)]
        values = self.at(starts, horizon)
        error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0.0
        undecided = (v.reason for _, v in self.statements if v.word == "undecided")
        return [Bound(_NAME, float(values.mean()), self.word, next(undecided, ""), False, error)]


def certificate_guarantee(
    problem: SafetyProblem, conditions: Sequence[Condition]
) -> CertificateGuarantee:
    """Return the bound of a filter with the condition of a certificate.

    Args:
        problem: whose plant has to be that of the certificate.
        conditions: one for each barrier, at least one of which is `Certified`.
    """
    first = next(c for c in conditions if isinstance(c, Certified))
    against = ""
    if any(condition != first for condition in conditions):
        against = "other conditions act besides that of the certificate"
    if not against:
        differing = system_differences(first.certificate.plant, problem.plant)
        parts = ", ".join(differing)
        against = f"the plant differs from the system of the certificate in {parts}" * bool(parts)
    return CertificateGuarantee(first.certificate, against)


def _inside_domain(certificate: BarrierCertificate, x: np.ndarray) -> np.ndarray:
    """Return which states are in C and in the workspace, shape (B,)."""
    plant = certificate.plant
    with np.errstate(all="ignore"):
        barriers = tabulated(plant.states, list(plant.barriers))(x)
    low, high = np.array([[float(end) for end in ends] for ends in plant.workspace]).T
    within = ((x >= low) & (x <= high)) | np.array(plant.angles)
    return (barriers > 0.0).all(axis=1) & within.all(axis=1)


NOTHING = "it is 0 at these starts up to this horizon"
"""What there is to say of a bound that is 0."""

_STARTS = 1024
_EMPTY = "the sets C_j have no state in common"


class ChainGuarantee:
    """The bounds that the chains b_0, ..., b_(r-1) of the barriers give.

    A search looks for counterexamples to their hypotheses and for the suprema and the shortfall in
    them. The judge then proves the hypotheses and the numbers, or leaves some of them undecided:
    bounds that need these are estimates.

    Args:
        formulas: the chains and conditions, compiled.
        analysis: of the safe set, if there is one; made when it is needed otherwise.
        seconds: of processor time, for the search for the shortfall and for the judge each. Then
            the judge is not asked either for what would be 0 at the starts. None for no limit.
    """

    def __init__(
        self,
        formulas: Formulas,
        analysis: SafeSetAnalysis | None = None,
        seconds: float | None = None,
    ) -> None:
        self.formulas, self._given, self._seconds = formulas, analysis, seconds

    @cached_property
    def analysis(self) -> SafeSetAnalysis:
        """What was found in the safe set."""
        seconds = math.inf if self._seconds is None else self._seconds
        return self._given or SafeSetAnalysis(self.formulas, seconds=seconds)

    @cached_property
    def proof(self) -> ChainProof:
        """What the judge proves of the hypotheses and numbers."""
        # What several conditions lack together is proved, or not, without knowing it.
        shortfall, hints = 0.0, np.empty((0, self.formulas.problem.plant.n))
        if self.formulas.joint:
            shortfall, state = self.analysis.max_shortfall
            hints = state[None]
        suprema = self.analysis.suprema.tolist()
        return ChainProof(self.formulas, suprema, shortfall, hints, self._seconds)

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """The hypotheses with the judge's word; none where no theorem applies."""
        return self.proof.statements if self._is_judged else []

    @cached_property
    def _is_judged(self) -> bool:
        """Whether a theorem applies, so that the judge is asked for its hypotheses and numbers."""
        return not no_bound(self.formulas) and self.analysis.invariant_set is not None

    @cached_property
    def shortfall(self) -> Extremum:
        """The largest shortfall on the invariant set; on C where that is empty."""
        found = self.analysis.max_shortfall[0]
        return Extremum(found, self.proof.shortfall.value) if self._is_judged else Extremum(found)

    @cached_property
    def suprema(self) -> tuple[Extremum, ...]:
        """The suprema c_j on the invariant set; where none matters, none is proved."""
        found = self.analysis.suprema.tolist()
        if self.formulas.certain or not self._is_judged:
            return tuple(map(Extremum, found))
        return tuple(map(Extremum, found, [number.value for number in self.proof.suprema]))

    @property
    def note(self) -> str | None:
        """Why there is no bound, the first of several reasons; None if there is one."""
        return self._reason or None

    @cached_property
    def _reason(self) -> str:
        # What needs no search comes first.
        reason = no_bound(self.formulas) or mismatch(self.formulas)
        if not reason and self.analysis.invariant_set is None:
            reason = _EMPTY
        if not reason:
            reason = next(filter(None, self._against), "")
        if (
            not reason
            and self.formulas.certain
            and not holds_up_to_a_time(self.formulas, self.stages)
        ):
            reason = self.remark
        return reason

    @property
    def _against(self) -> Iterator[str]:
        """Reasons why there is no bound, the cheapest first; a proof only where it decides."""
        yield from failures(self.analysis)
        if self._seconds is not None and self._surely_nothing:
            # What several conditions lack together takes long to search for.
            yield (self.remark if self.formulas.joint else "") or NOTHING
        yield self._unbounded
        yield from self._unverified

    @property
    def _surely_nothing(self) -> bool:
        """Whether the bound is 0 at the starts whatever the judge proves."""
        # The numbers that the search found are too small, if anything, and make it too large.
        suprema = self.analysis.suprema
        if self.formulas.certain or not np.isfinite(suprema).all():
            return False
        b = self.formulas.chain(draw_starts(self.formulas.problem, _STARTS))
        stages = stages_of(self.formulas, suprema.tolist(), 0.0)
        horizon = self.formulas.problem.duration
        found = candidates_for(self.formulas, b, stages, horizon, Extremum(0.0))
        return not found[-1].values.any()

    @property
    def _unbounded(self) -> str:
        """Which supremum is infinite, where one matters, in words; may be empty."""
        proved = self.formulas.certain or all(math.isfinite(c.value) for c in self.suprema)
        return "" if proved else unbounded(self.analysis)

    @property
    def _unverified(self) -> list[str]:
        """The assumptions that neither the search nor the judge establishes, in words."""
        found = [] if self.proof.bounded.word == "proved" else [self.analysis.limits]
        found += [] if self.proof.regular else [nearly_rough(self.analysis)]
        if not self.formulas.joint and math.isinf(self.proof.shortfall.value):
            found.append(JOINT)
        return [reason for reason in found if reason]

    @property
    def remark(self) -> str:
        """Why the bound is weak: where no action meets the condition; may be empty."""
        return missed_somewhere(self.shortfall, self.proof.negligible)

    @property
    def word(self) -> Status:
        """Whether the bound that `at` returns is proved or estimated."""
        allowed = any(self.stages.shortfalls)
        return "proved" if self.proof.word_of(allowed)[0] == "proved" else "estimated"

    @cached_property
    def stages(self) -> Stages:
        """The stages of all barriers."""
        suprema = None if self.formulas.certain else [c.value for c in self.suprema]
        return stages_of(self.formulas, suprema, self.shortfall.value)

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the largest bound on P(safe up to the horizon) whose hypotheses hold.

        Args:
            starts: states, shape (B, n).
            horizon: T in s.

        Returns:
            Values in [0, 1], shape (B,); 0 where there is no bound.
        """
        b = self.formulas.chain(np.asarray(starts, dtype=np.float64))
        if self.note:
            return np.zeros(len(b))
        return candidates_for(self.formulas, b, self.stages, horizon, self.shortfall)[-1].values

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in the numbers of the bound; "" if nothing.

        Args:
            reached: states that were reached, starts among them, shape (B, n).
            violated: states where the filter violated its conditions, shape (E, n).
            actions: what it executed there, shape (E, m).
            slack: by how much it reports to have violated them, shape (E,); the actions themselves
                tell how much of it is a sampling margin.

        Returns:
            A text.
        """
        if self.note:
            return ""
        return above_suprema(self.formulas, self.suprema, reached) or above_shortfall(
            self.formulas, self.shortfall, violated, actions
        )

    def applicable_bounds(self, starts: np.ndarray, horizon: float) -> list[Bound]:
        """Return the results that suit the conditions, at a start or on average over several.

        P(safe) from a random start is the mean of P(safe) over it, so that the mean of a bound is a
        bound.

        Args:
            starts: states, shape (B, n).
            horizon: T in s.
        """
        formulas = self.formulas
        nothing = no_bound(formulas)
        if not nothing and self.analysis.invariant_set is not None:
            nothing = self._unbounded
        if nothing or self.analysis.invariant_set is None:
            return [Bound("all of them", None, "no bound", nothing or _EMPTY)]
        b = formulas.chain(starts)
        inside = (b > 0.0).all(axis=1)
        if not inside.any():
            return [Bound("all of them", None, "hypothesis fails", outside(formulas, b))]
        share = f"{100 * (1 - inside.mean()):.1f} %"
        partly = [f"0 at the {share} of the starts that are outside some C_j"] * (not inside.all())
        candidates = candidates_for(formulas, b, self.stages, horizon, self.shortfall)
        found = [self._judged(candidate, partly) for candidate in candidates]
        high = above_suprema(formulas, self.suprema, starts)
        return [bound.without(high) for bound in found]

    def _judged(self, candidate: Candidate, partly: list[str]) -> Bound:
        """Return the mean of a result over the starts, with what is against it."""
        infeasible = "" if candidate.allows_shortfall else self._infeasible
        broken = [*failures(self.analysis), *filter(None, [infeasible])]
        unproved = self._unverified
        status, open_ = self._status(candidate, bool(broken), bool(unproved))
        values = candidate.values
        reason = "; ".join([*broken, *unproved, *filter(None, [open_]), *partly])
        error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0.0
        return Bound(candidate.name, float(values.mean()), status, reason, candidate.forever, error)

    def _status(self, candidate: Candidate, broken: bool, unproved: bool) -> tuple[Status, str]:
        """Return what a result is worth, and what the judge leaves undecided of it."""
        if broken or unproved:
            return "hypothesis fails" if broken else "not established", ""
        word, reason = self.proof.word_of(candidate.allows_shortfall)
        if word == "refuted":
            return "hypothesis fails", reason
        return ("proved", "") if word == "proved" else ("estimated", f"undecided: {reason}")

    @cached_property
    def _infeasible(self) -> str:
        """Where the conditions cannot be met, in words; may be empty."""
        return infeasible(self.analysis, self.shortfall)
