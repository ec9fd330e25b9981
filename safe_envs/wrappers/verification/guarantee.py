"""The bounds of conditions at a start: which theorems apply, which fail and why, and what their
values are estimated at."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from safe_envs.wrappers.verification import bounds
from safe_envs.wrappers.verification.assumptions import (
    amount,
    failures,
    no_bound,
    unbounded,
    unverified_assumptions,
)
from safe_envs.wrappers.verification.feasibility import Verification
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.observed import above_suprema, described
from safe_envs.wrappers.verification.safe_set import sample
from safe_envs.wrappers.verification.search import largest

Status = Literal["estimated", "withheld", "hypothesis fails", "no bound", "not established"]
"""What a bound is worth: no hypothesis was found to fail; it did until episodes contradicted it;
one fails; there is none; or what it rests on is known to be false or was not looked at."""

_SAMPLES = 2048


@dataclass(frozen=True)
class Bound:
    """A lower bound on the probability of staying safe.

    Attributes:
        name: of the result.
        value: at the start, or its mean over several; None if there is none.
        error: standard error of that mean as the mean over all starts; 0 for one start.
        status: what it is worth.
        reason: why, in words; may be empty where it is estimated.
        forever: whether it is of all times, not only up to the horizon.
    """

    name: str
    value: float | None
    status: Status
    reason: str
    forever: bool = False
    error: float = 0.0

    def without(self, reason: str) -> Bound:
        """The bound as withheld for a reason, if it was estimated and there is one; itself
        otherwise."""
        if not reason or self.status != "estimated":
            return self
        return replace(self, value=None, error=0.0, status="withheld", reason=reason)


@dataclass(frozen=True)
class Stages:
    """The chains of all barriers, with what the bounds need of them.

    Attributes:
        rates: of each stage, in 1/s.
        suprema: c_j of each, finite.
        shortfalls: m_j of each, 0 except for the last one of a barrier.
    """

    rates: tuple[float, ...]
    suprema: tuple[float, ...]
    shortfalls: tuple[float, ...]


def promise(verification: Verification, starts: np.ndarray, horizon: float) -> list[Bound]:
    """The bounds of the results that suit the conditions, at a start or on average over several.

    P(safe) from a random start is the mean of P(safe) over it, so that the mean of a bound is a
    bound.

    Args:
        verification: of the conditions.
        starts: states, shape (B, n).
        horizon: T in s.
    """
    formulas = verification.formulas
    nothing = no_bound(formulas) or unbounded(verification.survey)
    if nothing:
        return [Bound("all of them", None, "no bound", nothing)]
    kept = verification.kept
    if kept is None:
        return [Bound("all of them", None, "no bound", "the sets C_j have no state in common")]
    b = formulas.chain(starts)
    inside = (b > 0.0).all(axis=1)
    if not inside.any():
        return [Bound("all of them", None, "hypothesis fails", _outside(formulas, b))]
    partly = (
        ""
        if inside.all()
        else f"0 at the {100 * (1 - inside.mean()):.1f} % of the starts that are outside some C_j"
    )
    verdict = _Verdict(
        failures(verification.survey),
        _infeasible(verification),
        unverified_assumptions(verification.survey),
        partly,
    )
    candidates = (
        _certain(verification, b, horizon)
        if formulas.certain
        else _from_chains(verification, b, horizon)
    )
    found = [_judged(candidate, verdict) for candidate in candidates]
    high = above_suprema(formulas, _stages(verification).suprema, starts)
    return [bound.without(high) for bound in found]


class _Candidate(NamedTuple):
    """A result that suits the conditions.

    Attributes:
        name: of it.
        values: at the starts, shape (B,).
        forever: whether it is of all times.
        gap: what its proof lacks even where its hypotheses hold; may be empty.
        allows_shortfall: whether the conditions may be missed somewhere.
    """

    name: str
    values: np.ndarray
    forever: bool
    gap: str = ""
    allows_shortfall: bool = False


class _Verdict(NamedTuple):
    """What is against all candidates alike.

    Attributes:
        failures: hypotheses that fail, in words.
        infeasible: where the conditions cannot be met; may be empty.
        unverified_assumptions: what was not looked at, in words.
        partly: at how many starts they are 0; may be empty.
    """

    failures: list[str]
    infeasible: str
    unverified_assumptions: list[str]
    partly: str


def _judged(candidate: _Candidate, verdict: _Verdict) -> Bound:
    broken = [
        *verdict.failures,
        *[verdict.infeasible] * (not candidate.allows_shortfall and bool(verdict.infeasible)),
    ]
    open_questions = [*verdict.unverified_assumptions, *[candidate.gap] * bool(candidate.gap)]
    status: Status = (
        "hypothesis fails" if broken else "not established" if open_questions else "estimated"
    )
    reason = "; ".join([*broken, *open_questions, *[verdict.partly] * bool(verdict.partly)])
    error = (
        float(candidate.values.std(ddof=1)) / math.sqrt(len(candidate.values))
        if len(candidate.values) > 1
        else 0.0
    )
    return Bound(
        candidate.name, float(candidate.values.mean()), status, reason, candidate.forever, error
    )


def _certain(verification: Verification, b: np.ndarray, horizon: float) -> list[_Candidate]:
    """Conditions that keep every path: without noise, or SRCBF."""
    noisy, stages = verification.formulas.noisy, _stages(verification)
    name = "Prop. 4.2.2: safe with probability 1" if noisy else "no noise: no path leaves"
    found = [_Candidate(name, (b > 0.0).all(axis=1).astype(float), forever=True)]
    if any(stages.shortfalls) and not noisy and not any(map(math.isnan, stages.rates)):
        values = outlasting(stages, b, horizon)
        found.append(
            _Candidate(
                "no noise, in spite of the shortfall: safe up to T",
                values,
                forever=False,
                allows_shortfall=True,
            )
        )
    return found


def _from_chains(verification: Verification, b: np.ndarray, horizon: float) -> list[_Candidate]:
    """Conditions that know the noise and have a chain of rates: SCBF and SZCBF."""
    stages = _stages(verification)
    c, rates, shortfalls = stages.suprema, stages.rates, stages.shortfalls
    found = (
        _of_order_one(b[:, 0], c[0], rates[0], horizon)
        if len(c) == 1
        else _of_stages(verification, b, stages, horizon)
    )
    if any(shortfalls):
        name = f"repaired for the shortfall m = {max(shortfalls):.4g}, up to T"
        found.append(
            _Candidate(
                name,
                bounds.union_bound(b, c, horizon, rates, shortfalls),
                forever=False,
                allows_shortfall=True,
            )
        )
    return found


def _of_order_one(h: np.ndarray, c: float, k: float, horizon: float) -> list[_Candidate]:
    if not k:
        return [
            _Candidate("Prop. 4.2.8: h/c, for ever", bounds.proposition_4_2_8(h, c), forever=True)
        ]
    # For k <= c the misprinted exponent is merely larger than it has to be.
    false = (
        f"its exponent is misprinted, and false for k > c: k = {k:g}, c = {c:.4g}" if k > c else ""
    )
    printed, corrected = (
        bounds.proposition_4_2_5_printed(h, c, horizon),
        bounds.proposition_4_2_5(h, c, k, horizon),
    )
    return [
        _Candidate("Prop. 4.2.5 as printed: (h/c) e^(-c T)", printed, forever=False, gap=false),
        _Candidate("Prop. 4.2.5 corrected: (h/c) e^(-k T)", corrected, forever=False),
    ]


def _of_stages(
    verification: Verification, b: np.ndarray, stages: Stages, horizon: float
) -> list[_Candidate]:
    """The product of the print, for a single barrier, and the union."""
    forever = not any(stages.rates)
    time, length = (math.inf, "for ever") if forever else (horizon, "up to T")
    several = len(verification.barriers) > 1
    union = bounds.union_bound(b, stages.suprema, time, stages.rates)
    found = [
        _Candidate(f"union over the stages{' of all barriers' * several}, {length}", union, forever)
    ]
    if not several:
        name = (
            "Thm. 4.2.10 as printed: product of b_j/c_j"
            if forever
            else "Thm. 4.2.10, zeroing: product of (b_j/c_j) e^(-a_j T)"
        )
        product = bounds.theorem_4_2_10_printed(b, stages.suprema, time, stages.rates)
        found.insert(
            0,
            _Candidate(
                f"{name}, {length}", product, forever, gap="its proof conditions on the future"
            ),
        )
    return found


def _outside(formulas: Formulas, b: np.ndarray) -> str:
    """Where the start is outside, by the value that is lowest."""
    if (b > 0.0).any(axis=0).all():
        return "no start lies in all C_j at once"
    j = int(b.max(axis=0).argmin())
    stage = j - next(s.start for s in formulas.stages if s.start <= j < s.stop)
    return f"the start is outside C_{stage}: {described(formulas, j)} = {b[:, j].max():.4g}" + (
        " at most" if len(b) > 1 else ""
    )


def _infeasible(verification: Verification) -> str:
    kept = verification.kept
    if kept is None or not kept.shortfall:
        return ""
    formulas = verification.formulas
    share = f"{100 * kept.infeasible:.2g} % of" if kept.infeasible else "a thin part of"
    where = "C" if formulas.first_order else "the intersection of the C_j"
    conditions = "the condition" if len(formulas.conditions) == 1 else "all conditions"
    return f"no action meets {conditions} on {share} {where}, {amount(kept.shortfall)}"


def _stages(verification: Verification) -> Stages:
    return assembled(
        verification.formulas, verification.survey.suprema, verification.survey.missed[0]
    )


def assembled(formulas: Formulas, suprema: np.ndarray, shortfall: float) -> Stages:
    """The stages of all barriers; rates are NaN where a chain has none."""
    rates: list[float] = []
    shortfalls: list[float] = []
    for condition, stage in zip(formulas.conditions, formulas.stages, strict=True):
        degree = stage.stop - stage.start
        rates += condition.chain_rates(degree) or (math.nan,) * degree
        shortfalls += [*[0.0] * (degree - 1), shortfall]
    return Stages(tuple(rates), tuple(suprema.tolist()), tuple(shortfalls))


def outlasting(stages: Stages, b: np.ndarray, horizon: float) -> np.ndarray:
    """1 where no path leaves up to T: without noise b is at least what `stage_bound` subtracts
    from, so that a positive one is enough."""
    kept = [
        (
            bounds.stage_bound(b[:, j], 1.0 + abs(b[:, j]), horizon, rate, m) > 0.0
            if m
            else b[:, j] > 0.0
        )
        for j, (rate, m) in enumerate(zip(stages.rates, stages.shortfalls, strict=True))
    ]
    return np.all(kept, axis=0).astype(float)


def best_start(verification: Verification, seed: int = 0) -> np.ndarray | None:
    """The state (n,) where the printed bound is largest; None where there is no such bound.

    Args:
        verification: of the conditions.
        seed: of the search.
    """
    formulas = verification.formulas
    if (
        verification.kept is None
        or formulas.certain
        or no_bound(formulas)
        or unbounded(verification.survey)
    ):
        return None
    c = _stages(verification).suprema
    rng = np.random.default_rng(seed)
    points = sample(
        "the intersection of the C_j", formulas.kept_level, verification.region, _SAMPLES, rng
    ).points
    return largest(
        lambda x: bounds.theorem_4_2_10_printed(formulas.chain(x), c),
        points,
        verification.region,
        rng,
    )[1]
