"""Lower bounds on the probability of staying safe: what suits conditions, and what it is worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from safe_envs.outward_text import number_at_least, number_at_most
from safe_envs.wrappers.verification import bounds
from safe_envs.wrappers.verification.formulas import Formulas

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
        gap: what its proof lacks even where its hypotheses hold; may be empty.
        allows_shortfall: whether the conditions may be violated somewhere.
    """

    name: str
    values: np.ndarray
    forever: bool = False
    gap: str = ""
    allows_shortfall: bool = False


def of_order_one(h: np.ndarray, stages: Stages, horizon: float) -> list[Candidate]:
    """Return the results for one barrier of relative degree 1.

    Args:
        h: values of the barrier at the starts, shape (B,).
        stages: of the barrier.
        horizon: T in s.
    """
    (k,), (c,) = stages.rates, stages.suprema
    if not k:
        return [Candidate("Prop. 4.2.8: h/c, for ever", bounds.proposition_4_2_8(h, c), True)]
    # For k <= c the misprinted exponent is merely larger than it has to be.
    false = f"its exponent is misprinted, and false for k > c: k = {k:g}, c = {c:.4g}" * (k > c)
    return [
        Candidate(
            "Prop. 4.2.5, printed formula: (h/c) e^(-c T)",
            bounds.proposition_4_2_5_printed(h, c, horizon),
            gap=false,
        ),
        Candidate(
            "Prop. 4.2.5, corrected: (h/c) e^(-k T)", bounds.proposition_4_2_5(h, c, k, horizon)
        ),
    ]


def of_stages(b: np.ndarray, stages: Stages, horizon: float, several: bool) -> list[Candidate]:
    """Return the printed product, for a single barrier, and the union over the stages.

    Args:
        b: values of all chain functions at the starts, shape (B, sum of the r).
        stages: of all barriers.
        horizon: T in s.
        several: whether there is more than one barrier.
    """
    forever = not any(stages.rates)
    time, length = (math.inf, "for ever") if forever else (horizon, "up to T")
    union = Candidate(
        f"union over the stages{' of all barriers' * several}, {length}",
        bounds.union_bound(b, stages.suprema, time, stages.rates),
        forever,
    )
    if several:
        return [union]
    name = (
        "Thm. 4.2.10, printed formula: product of b_j/c_j"
        if forever
        else "Thm. 4.2.10, zeroing: product of (b_j/c_j) e^(-a_j T)"
    )
    product = bounds.theorem_4_2_10_printed(b, stages.suprema, time, stages.rates)
    gap = "its proof conditions on the future"
    return [Candidate(f"{name}, {length}", product, forever, gap), union]


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

    Args:
        formulas: of the conditions.
        b: values of all chain functions at the starts, shape (B, sum of the r).
        stages: of all barriers.
        horizon: T in s.
        shortfall: m, for the name of a result.
    """
    if formulas.certain:
        name = "no noise: no path leaves"
        name = "Prop. 4.2.2: safe with probability 1" if formulas.noisy else name
        found = [Candidate(name, (b > 0.0).all(axis=1).astype(float), True)]
        if any(stages.shortfalls) and holds_up_to_a_time(formulas, stages):
            name = "no noise, in spite of the shortfall: safe up to T"
            found.append(Candidate(name, surely_safe(stages, b, horizon), allows_shortfall=True))
        return found
    if b.shape[1] == 1:
        found = of_order_one(b[:, 0], stages, horizon)
    else:
        found = of_stages(b, stages, horizon, stages.barriers > 1)
    if any(stages.shortfalls):
        values = bounds.union_bound(b, stages.suprema, horizon, stages.rates, stages.shortfalls)
        name = f"repaired for the shortfall m {shortfall.text('=', '>=')}, up to T"
        found.append(Candidate(name, values, allows_shortfall=True))
    return found


def surely_safe(stages: Stages, b: np.ndarray, horizon: float) -> np.ndarray:
    """Return 1 for starts from which no path leaves up to T, and 0 elsewhere, shape (B,).

    Without noise b is at least what `stage_bound` subtracts from, so that a positive one is enough.

    Args:
        stages: of all barriers.
        b: values of all chain functions at the starts, shape (B, sum of the r).
        horizon: T in s.
    """
    safe = [
        (
            bounds.stage_bound(b[:, j], 1.0 + abs(b[:, j]), horizon, rate, m) > 0.0
            if m
            else b[:, j] > 0.0
        )
        for j, (rate, m) in enumerate(zip(stages.rates, stages.shortfalls, strict=True))
    ]
    return np.all(safe, axis=0).astype(float)
