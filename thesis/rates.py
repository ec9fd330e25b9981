"""Safety rates of filters on the same episodes, and the paired differences between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs import Barrier, ControlAffineSDE, RelativeDegreeError, SafetyProblem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.identification import pooled
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.statistics import SafeFlags, compare_all
from safe_envs.filters.learning import LearnedModel
from safe_envs.wrappers import AffineConstraint, Condition
from thesis.artefact import Claim, Number

PRINTED_EPISODES = 1000
"""Of each rate in Tables 5.1, 5.2, 6.2 and 6.3."""

_CONFIDENCE = 0.95
Flags = Sequence[np.ndarray]
"""Which episodes were safe, shape (episodes,) each, with each of one or several identifications."""


@dataclass(frozen=True)
class MeasuredFilter:
    """Episodes under one filter, with each of one or several identifications.

    Attributes:
        row: statistics of `evaluate`, over all identifications.
        flags: which episodes were safe, with each identification.
    """

    row: EpisodeSummary
    flags: Flags

    @property
    def episodes(self) -> int:
        """The number of episodes of each identification."""
        return len(self.flags[0])

    @property
    def rate(self) -> float:
        """The safety rate in per cent."""
        return 100 * self.row.safety_rate

    @property
    def rates(self) -> list[float]:
        """The safety rate with each identification, from 0 to 1."""
        return [float(np.mean(each)) for each in self.flags]

    def number(self, name: str, printed: float | None = None) -> Number:
        """Return the rate with its interval over identifications and episodes."""
        low, high = 100 * self.row.ci_low, 100 * self.row.ci_high
        trials = None if printed is None else PRINTED_EPISODES
        return Number(name, self.rate, low, high, printed, trials, "%")

    def at_each_horizon(self, printed: float) -> list[Number]:
        """Return the rate up to each instant of the curve, with a printed one in per cent."""
        return [
            Number.rate("", safe, self.row.episodes, printed, PRINTED_EPISODES)
            for safe in self.row.curve.safe
        ]


def measure(
    problem: SafetyProblem | str,
    condition: str | Condition,
    episodes: int,
    seed: int,
    models: Sequence[LearnedModel] = (),
    **how: Any,
) -> MeasuredFilter:
    """Evaluate a filter over the nominal policy, with each of the models that it learns from.

    Where a model says that no input has any effect there is no filter: the unfiltered environment
    is evaluated. `how` holds further arguments of `evaluate`.
    """
    results = []
    for learned in [[model] for model in models] or [[]]:
        common: dict[str, Any] = {"episodes": episodes, "seed": seed, "bounds": False, **how}
        try:
            results.append(evaluate(problem, filters=[condition], learned=learned, **common))
        except RelativeDegreeError:
            if not learned:
                raise
            results.append(evaluate(problem, filters=["none"], **common))
    flags = [flags.array for each in results for flags in next(iter(each.safe.values()))]
    return MeasuredFilter(pooled([each.rows[0] for each in results], _CONFIDENCE), flags)


def difference(name: str, first: Flags, second: Flags) -> Number:
    """Return by how many points the first rate is above the second one on the same episodes.

    Its interval is over episodes and identifications.
    """
    flags = {"second": second, "first": first}
    (found,) = compare_all({k: [*map(SafeFlags.of, v)] for k, v in flags.items()}, _CONFIDENCE)
    low, high = 100 * found.ci_low, 100 * found.ci_high
    return Number(name, 100 * found.difference, low, high, unit="points")


def safer(
    sentence: str, first: MeasuredFilter, second: MeasuredFilter, *, printed: bool = True
) -> Claim:
    """Return the claim that the first rate is above the second one by more than chance."""
    gap = difference("", first.flags, second.flags)
    evidence = f"{first.rate:.1f} % less {second.rate:.1f} %: {gap.text}"
    return Claim(sentence, gap.is_above(), evidence, printed)


@dataclass(frozen=True)
class PrintedCondition(Condition):
    """A condition that asks for a formula of the thesis as it is printed, errors included.

    Attributes:
        formula: makes the constraint for a model and a barrier.
    """

    formula: Callable[[ControlAffineSDE, Barrier], AffineConstraint]
    name = "printed"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Return the constraint of the formula."""
        return self.formula(model, barrier)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedCondition:
        """Raise TypeError: a formula is not made of rates."""
        raise TypeError(f"a printed formula is not made of the rates {gains}")
