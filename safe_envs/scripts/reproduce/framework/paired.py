"""Safety rates of filters on the same episodes, and the paired differences between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs import SafetyProblem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.comparison import compare_all
from safe_envs.agents.evaluation.repeats import pooled
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.safe_flags import SafeFlags
from safe_envs.errors import RelativeDegreeError
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number
from safe_envs.wrappers import Condition
from safe_envs.wrappers.learning import LearnedModel

PRINTED_EPISODES = 1000
"""Of each rate in Tables 5.1, 5.2, 6.2 and 6.3."""

_CONFIDENCE = 0.95


@dataclass(frozen=True)
class MeasuredFilter:
    """Episodes under one filter, with each of one or several identifications.

    Attributes:
        row: statistics of `evaluate`, over all identifications.
        rates: safety rate with each identification, from 0 to 1.
        flags: which episodes were safe, with each identification.
        episodes: of each identification.
    """

    row: EpisodeSummary
    rates: Sequence[float]
    flags: Sequence[np.ndarray]
    episodes: int

    @property
    def rate(self) -> float:
        """The safety rate in per cent."""
        return 100 * self.row.safety_rate

    @property
    def curve(self) -> dict[str, list[float]]:
        """Safety rate in per cent over time in s."""
        curve = self.row.curve
        return {"time": curve.time, "rate": [100 * rate for rate in curve.rate]}

    def number(self, name: str, printed: float | None = None) -> Number:
        """Return the rate, with its interval over identifications and episodes.

        Args:
            name: of the number.
            printed: rate in the thesis, of 1000 runs, in per cent.
        """
        low, high = (100 * end for end in (self.row.ci_low, self.row.ci_high))
        trials = None if printed is None else PRINTED_EPISODES
        return Number(name, self.rate, low, high, printed, trials, "%")

    def at_each_horizon(self, printed: float) -> list[Number]:
        """Return the rate up to each instant, with a printed one in per cent."""
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
    """Evaluate a filter over the nominal policy, without bounds.

    Where a model says that no input has any effect, there is no filter, and the unfiltered
    environment is evaluated.

    Args:
        problem: what to simulate, or its id.
        condition: of the filter, or its text.
        episodes: with each model.
        seed: of the episodes.
        models: what a learned filter uses, one at a time; none for a filter that learns nothing.
        how: further arguments of `evaluate`.

    Returns:
        Statistics over all models, with those of each.
    """
    found = []
    for learned in [[model] for model in models] or [[]]:
        common = {"episodes": episodes, "seed": seed, "bounds": False, **how}
        try:
            found.append(evaluate(problem, filters=[condition], learned=learned, **common))
        except RelativeDegreeError:
            if not learned:
                raise
            found.append(evaluate(problem, filters=["none"], **common))
    rows = [each.rows[0] for each in found]
    flags = [flags.array for each in found for flags in next(iter(each.safe.values()))]
    rates = [row.safety_rate for row in rows]
    return MeasuredFilter(pooled(rows, _CONFIDENCE), rates, flags, episodes)


def difference(name: str, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> Number:
    """Return by how many points the rate of one filter is above another's on the same episodes.

    Args:
        name: of the number.
        first: which episodes are safe with the one filter, shape (episodes,), for each
            identification.
        second: with the other.

    Returns:
        The difference with its 95 % interval over episodes and identifications.
    """
    flags = {"second": second, "first": first}
    (found,) = compare_all({k: [*map(SafeFlags.of, v)] for k, v in flags.items()}, _CONFIDENCE)
    middle, low, high = (100 * end for end in (found.difference, found.ci_low, found.ci_high))
    return Number(name, middle, low, high, unit="points")


def is_above(number: Number, value: float = 0.0) -> bool:
    """Return whether the whole interval of a number is above a value.

    Args:
        number: with its interval.
        value: to compare with.
    """
    return number.low is not None and number.low > value


def is_below(number: Number, value: float = 0.0) -> bool:
    """Return whether the whole interval of a number is below a value.

    Args:
        number: with its interval.
        value: to compare with.
    """
    return number.high is not None and number.high < value


def with_interval(number: Number, unit: str = "") -> str:
    """Return a difference with its sign and its interval, as text.

    Args:
        number: the difference.
        unit: of it, with a space in front.
    """
    return f"{number.ours:+.1f}{unit} [{number.low:.1f}, {number.high:.1f}]"


def safer(
    sentence: str, first: MeasuredFilter, second: MeasuredFilter, *, printed: bool = True
) -> Claim:
    """Return the claim that the first rate is above the second one by more than chance.

    Args:
        sentence: of the claim.
        first: filter that is to be the safer one.
        second: the other, on the same episodes.
        printed: whether the thesis says it.
    """
    apart = difference("", first.flags, second.flags)
    evidence = f"{first.rate:.1f} % less {second.rate:.1f} %: {with_interval(apart, ' points')}"
    return Claim(sentence, is_above(apart), evidence, printed)
