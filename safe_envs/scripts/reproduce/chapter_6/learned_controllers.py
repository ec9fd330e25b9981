"""What the tables of chapter 6 share: rates with identifications or a printed constraint."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import rate_interval
from safe_envs.scripts.reproduce.chapter_6.identifications import CHAPTER, one_more
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number
from safe_envs.scripts.reproduce.framework.paired import (
    PRINTED_EPISODES,
    MeasuredFilter,
    difference,
    measure,
    with_interval,
)
from safe_envs.scripts.reproduce.framework.printed_condition import PrintedCondition
from safe_envs.wrappers import AffineConstraint
from safe_envs.wrappers.learning import LearnedModel

SIMILAR = CHAPTER.settings["identification"]["similar"]


def _constraint(formula: sp.Expr, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
    """Return the constraint that a formula, affine in the inputs, is at least 0."""
    slopes = [sp.diff(formula, u) for u in model.inputs]
    terms = [a * u for a, u in zip(slopes, model.inputs, strict=True)]
    return AffineConstraint(tuple(slopes), sp.expand(formula - sum(terms)), (barrier.expression,))


def printed_rate(
    name: str, problem: SafetyProblem, formula: sp.Expr, episodes: int, seed: int
) -> Number:
    """Return the safety rate under a printed constraint.

    Args:
        name: of the number.
        problem: that is simulated.
        formula: expression of states and inputs, which is to be at least 0.
        episodes: how many.
        seed: of all of them.
    """
    condition = PrintedCondition(partial(_constraint, formula))
    return measure(problem, condition, episodes, seed).number(name)


def rate_of_one_more(
    name: str, rates: Sequence[float], episodes: int, printed: float | None = None
) -> Number:
    """Return the mean rate, and the interval of the rate with one more identification.

    A printed rate is with a single one. The distances from the mean to the ends of the interval
    over episodes, which all identifications share, and those of the prediction interval over
    identifications are added as squares.

    Args:
        name: of the number.
        rates: with each identification, from 0 to 1.
        episodes: of each.
        printed: rate in the thesis, in per cent.
    """
    mean = float(np.mean(rates))
    low, high = rate_interval(round(mean * episodes), episodes)
    half = mean - one_more(rates)[0]
    low = max(mean - math.hypot(mean - low, half), 0.0)
    high = min(mean + math.hypot(high - mean, half), 1.0)
    trials = None if printed is None else PRINTED_EPISODES
    return Number(name, 100 * mean, 100 * low, 100 * high, printed, trials, "%")


@dataclass(frozen=True)
class LearnedController:
    """A controller with several identifications, on the episodes of the SCBF that knows the system.

    Attributes:
        rates: with each identification, from 0 to 1.
        episodes: of each.
        difference: mean of the rate less that of the SCBF, in points, with its interval over
            identifications and episodes.
    """

    rates: Sequence[float]
    episodes: int
    difference: Number

    @classmethod
    def run(
        cls,
        problem: SafetyProblem,
        text: str,
        models: Sequence[LearnedModel],
        reference: MeasuredFilter,
        seed: int,
    ) -> LearnedController:
        """Evaluate a learned filter with each model, on the episodes of a reference.

        Args:
            problem: that is simulated.
            text: of the filter.
            models: one at a time.
            reference: the SCBF that knows the system.
            seed: of the episodes.

        Returns:
            The rates, with their difference to that of the reference.
        """
        found = measure(problem, text, reference.episodes, seed, models)
        gap = difference("", found.flags, reference.flags)
        return cls(found.rates, found.episodes, gap)

    def number(self, name: str, printed: float | None = None) -> Number:
        """Return `rate_of_one_more` of these rates.

        Args:
            name: of the number.
            printed: rate in the thesis, in per cent.
        """
        return rate_of_one_more(name, self.rates, self.episodes, printed)

    def describe(self) -> str:
        """Return the mean difference and the rates, in words."""
        rates = f"{100 * min(self.rates):.1f} to {100 * max(self.rates):.1f} %"
        return (
            f"{with_interval(self.difference, ' points')} on average over {len(self.rates)}"
            f" identifications, with rates of {rates}"
        )


def similar(each: Mapping[str, LearnedController]) -> Claim:
    """Return the claim that an identified system is as safe as the real one at each start.

    It is decided by the interval of the mean difference.

    Source: thesis Sec. 7.1, which gives no number: the largest printed difference is taken for the
        limit.
    """
    gaps = [learned.difference for learned in each.values()]
    near = all(
        gap.low is not None and gap.high is not None and max(-gap.low, gap.high) <= SIMILAR
        for gap in gaps
    )
    evidence = "; ".join(
        f"{place}: {learned.describe()}" if place else learned.describe()
        for place, learned in each.items()
    )
    return CHAPTER.claim("table-6.2", "similar", near, each=evidence)
