"""How safe the rows of an evaluation are, measured by how safe any policy can be.

Of every policy's episodes at least the share r is violated, where 1 - r is the best attainable
safety. It is not known exactly, only 1 - upper <= r <= 1 - lower, nor is the share v of violations
under a filter, only its interval 1 - ci_high <= v <= 1 - ci_low. So v/r is given as an interval,

    (1 - ci_high)/(1 - lower) <= v/r <= (1 - ci_low)/(1 - upper),

whose ends are as sure as those of the rate's interval and of the envelopes together. No policy is
below 1, where the lower end is cut off. Where upper is 1 no violation is shown to be unavoidable,
and there is no upper end; where lower is 1 too, none is unavoidable, and the number means nothing.

A violation has to mean the same to both: the table counts leaving the workspace in the safe set as
the evaluation does, as the end of a safe episode, or the two countings are the same because no
state outside the workspace is in the safe set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    attainable_safety,
    contradicted,
    keep_attainable,
    kept_attainable,
    leaves_safely,
    place_of,
    withheld,
)
from safe_envs.agents.evaluation.bounds import Bounded, above_attainable, without_held
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.tables import ValueSettings


@dataclass(frozen=True)
class TimesUnavoidable:
    """Violations under a filter for each one that no policy can avoid.

    Attributes:
        low: lower end, at least 1.
        high: upper end; None where no violation is shown to be unavoidable.
    """

    low: float
    high: float | None


def times_unavoidable(
    best: AttainableSafety | None, ci_low: float, ci_high: float
) -> TimesUnavoidable | None:
    """Return how many times the unavoidable violations a filter has; see the module.

    Args:
        best: attainable safety, if it is known.
        ci_low: lower end of the interval of the filter's safety rate.
        ci_high: upper end.

    Returns:
        The interval; None where it would mean nothing.
    """
    return None if best is None else times_between(best.lower, best.upper, ci_low, ci_high)


def times_between(
    lower: float | None, upper: float | None, ci_low: float, ci_high: float
) -> TimesUnavoidable | None:
    """Return how many times the unavoidable violations a filter has; see the module.

    Args:
        lower: lower end of the best attainable safety, if it is known.
        upper: its upper end.
        ci_low: lower end of the interval of the filter's safety rate.
        ci_high: upper end.

    Returns:
        The interval; None where it would mean nothing.
    """
    if lower is None or upper is None or lower >= 1.0:
        return None
    low = max(1.0, (1.0 - ci_high) / (1.0 - lower))
    high = (1.0 - ci_low) / (1.0 - upper) if upper < 1.0 else None
    return TimesUnavoidable(low, None if high is None else max(low, high))


def evaluation_settings(problem: SafetyProblem) -> ValueSettings:
    """Return the settings of a table that counts as `evaluate` does.

    Where the countings are the same it is the one of staying, which other commands need too.
    """
    same = not leaves_safely(problem)
    return ValueSettings(knowledge="plant", leaving="violation" if same else "safe")


def best_for(problem: SafetyProblem, progress: Progress | None = None) -> AttainableSafety:
    """Return the best attainable safety as `evaluate` counts.

    It is computed if need be, and kept in the user's cache.

    Args:
        problem: with the starts.
        progress: called with the part of the work that is done, from 0 to 1.

    Raises:
        ConfigurationError: There is no table of the problem.
    """
    settings = evaluation_settings(problem)
    place = place_of(problem.unmeasured, settings)
    found = kept_attainable(place)
    if found is None:
        found, _ = attainable_safety(problem, settings, episodes=0, progress=progress)
        keep_attainable(found, place)
    elif progress is not None:
        progress(1.0)
    return found


def held_against(best: AttainableSafety, rows: Sequence[EvaluationRow]) -> AttainableSafety:
    """Return the best attainable safety, without bounds that the rate of a row exceeds.

    Args:
        best: to judge.
        rows: of an evaluation. Those over several identifications do not have independent
            episodes, and are left out.
    """
    judging = [r for r in rows if r.learning is None or r.learning.repeats == 1]
    return contradicted(best, [(row.filter, row.safe, row.episodes) for row in judging])


def chained(
    best: AttainableSafety | None, rows: Sequence[EvaluationRow]
) -> tuple[AttainableSafety | None, list[EvaluationRow]]:
    """Return the attainable safety and the rows, without what breaks bound <= rate <= attainable.

    Where a bound for the env's own steps is above the attainable upper bound, a table is wrong: the
    attainable safety is withheld, and so is a bound that is only computed.

    Args:
        best: attainable safety, if it is known.
        rows: of an evaluation.
    """
    if best is None:
        return None, list(rows)
    upper, found = best.upper, []
    best = held_against(best, rows)
    for row in rows:
        best, judged = against_attainable(best, upper, row.filter, row)
        found.append(judged)
    return best, found


def against_attainable(
    best: AttainableSafety, upper: float | None, name: str, row: Bounded
) -> tuple[AttainableSafety, Bounded]:
    """Return both without what contradicts the other; see `chained`.

    Args:
        best: attainable safety, maybe withheld by now.
        upper: its upper end.
        name: of the filter.
        row: with its bounds.
    """
    reason = above_attainable(row, upper)
    if not reason:
        return best, row
    if best.upper is not None:
        best = withheld(best, f"{name}: {reason}")
    return best, without_held(row, reason) if row.held_word == "computed" else row


def best_document(
    best: AttainableSafety | None, rows: Sequence[EvaluationRow]
) -> dict[str, Any] | None:
    """Return the best attainable safety, with the comparison of each row, as JSON-able data.

    Args:
        best: attainable safety, if it is known.
        rows: of the evaluation.
    """
    if best is None:
        return None
    times = {row.filter: times_unavoidable(best, row.ci_low, row.ci_high) for row in rows}
    return {
        **best.as_dict(),
        "times_unavoidable": {name: found and asdict(found) for name, found in times.items()},
    }
