"""Where does the safety rate go as the control period goes to 0?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.brownian_bridge import reached_by_noise
from safe_envs.agents.evaluation.combined_rates import combined_rates
from safe_envs.agents.evaluation.comparison import pair_counts
from safe_envs.agents.evaluation.contradiction import continuous_judged, upper_ends_of
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import paired_difference_interval
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem

DIVISORS = (1, 2, 4)
"""By what the control period is divided."""

TOLERANCE = 0.03
"""The most by which a rate may be off its limit, at either end of the interval, to be called
converged."""

_SURE = 0.999
"""Confidence with which the integration step is found to matter."""


@dataclass(frozen=True)
class RefinementRow:
    """The safety rate under a filter with smaller and smaller control periods, on the same noise.

    Attributes:
        filter: its name.
        safe: number of safe episodes with each period.
        safety_rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
        change: of the rate from dt/2 to dt/4.
        change_low: lower end of the interval of the change.
        change_high: upper end.
        limit: of the rate as the period goes to 0, extrapolated.
        limit_low: lower end of its interval.
        limit_high: upper end.
        error: of the rate with dt, as the distance from the limit.
        error_low: lower end of its interval.
        error_high: upper end.
        verdict: see `refine`.
        withheld: how the rates contradict a bound, which is withheld then.
    """

    filter: str
    safe: list[int]
    safety_rate: list[float]
    ci_low: list[float]
    ci_high: list[float]
    change: float
    change_low: float
    change_high: float
    limit: float
    limit_low: float
    limit_high: float
    error: float
    error_low: float
    error_high: float
    verdict: str
    withheld: str | None


@dataclass(frozen=True)
class Refinement:
    """The result of `refine`.

    Attributes:
        given: the evaluation as it was asked for.
        evaluations: with the control period dt as given, dt/2 and dt/4.
        coupled: whether all three have the integration step of the last one, and the same noise.
        order: power of the period with which the rates go to their limit.
        rows: for each filter its rates with these periods, their limit, and a verdict.
    """

    given: Evaluation
    evaluations: tuple[Evaluation, ...]
    coupled: bool
    order: float
    rows: list[RefinementRow]

    @property
    def periods(self) -> list[float]:
        """The control periods in s."""
        return [evaluation.problem.dt for evaluation in self.evaluations]

    def document(self) -> dict[str, Any]:
        """Return the evaluation with the given dt and its refinement as JSON-able data."""
        rows = [asdict(row) for row in self.rows]
        how = {"coupled": self.coupled, "order": self.order, "tolerance": TOLERANCE}
        return {**self.given.document(), "refinement": {"dt": self.periods, **how, "rows": rows}}


def refine(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    *,
    progress: Progress | None = None,
    record: bool = False,
    episodes_out: Path | str | None = None,
    **arguments: Any,
) -> Refinement:
    """Evaluate with the control periods dt, dt/2 and dt/4, and extrapolate the safety rate.

    Learned filters are learned once, with the period dt.

    Control and the check of safety go with the period. All three are integrated with the step of
    dt/4, which makes them sample the same path of the noise, so that their rates differ by little
    more than the period makes them differ. What takes one integration step in a period alone, as
    filters with tables do, is evaluated with that, on noise of its own. The horizon is the number
    of whole periods dt.

    Where noise reaches a barrier directly and h is looked at at control instants, the rate goes to
    its limit as sqrt(dt), since a path is seen less often than it crosses; elsewhere as dt. The
    rates p(dt/2) and p(dt/4) give the limit (p(dt/4) - r p(dt/2))/(1 - r), by Richardson, with r =
    2^-1/2 or 1/2. By how much this differs from what p(dt) and p(dt/2) give shows the terms of
    higher order: the interval of the limit has both, that of the episodes and this difference,
    added as squares.

    The verdict on the rate with dt is "converged" where the interval of its distance from the limit
    reaches no further than `TOLERANCE` either way. Elsewhere it is "still changing" where the
    interval does not contain 0, and "not resolved" where it does, so that more episodes are needed.
    It is "integration" where the rate as it was asked for differs, with 99.9 % confidence, from
    that with the smaller integration step. A rate with any of these periods contradicts a bound as
    it does in `evaluate`: then that is withheld, and the verdict "contradicted".

    Args:
        problem: as for `evaluate`.
        policy: as for `evaluate`.
        progress: called with the part of the work of all evaluations that is done, from 0 to 1.
        record: keep trajectories of the evaluation as given for pictures.
        episodes_out: FILE.parquet for the results of each episode of that evaluation.
        **arguments: the others of `evaluate`.

    Returns:
        The evaluations, and the rates with each period.

    Raises:
        ConfigurationError: as for `evaluate`, or dt cannot be divided.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.

    Source: M. Broadie, P. Glasserman, S. Kou, A continuity correction for discrete barrier options,
        Mathematical Finance 7 (1997) 325-349, for the power 1/2.
    """
    if arguments.get("repeats", 1) != 1:
        raise ConfigurationError(
            "repeats are of the identification and refinement of the period: ask for one of the two"
        )
    if arguments.get("filter_spec") is not None:
        raise ConfigurationError(
            "the control period of a third-party env is its own, and cannot be refined"
        )
    shares = _shares(progress)
    of_given = {"record": record, "episodes_out": episodes_out}
    given = evaluate(problem, policy, progress=shares[0], **of_given, **arguments)
    arguments |= {
        "options": None,
        "filters": given.spec.filters or [row.filter for row in given.rows],
        "bounds": False,
        "best": False,
        "closed_loop": False,
        "learned": given.learned,
    }

    def finer(coupled: bool) -> tuple[Evaluation, ...]:
        parts = list(zip(DIVISORS, shares[1:], strict=True))[not coupled :]
        return tuple(
            evaluate(_divided(given.problem, d, coupled), policy, progress=share, **arguments)
            for d, share in parts
        )

    coupled = True
    try:
        evaluations = finer(coupled)
    except ConfigurationError:
        coupled = False
        evaluations = (given, *finer(coupled))
    # The finer ones are nearer to continuous time, of which the bounds are.
    given = replace(given, rows=[_judged(row, evaluations) for row in given.rows])
    order = _order(given)
    rows = [_row(row, given, evaluations, order) for row in given.rows]
    return Refinement(given, evaluations, coupled, order, rows)


def _judged(row: EvaluationRow, finer: Sequence[Evaluation]) -> EvaluationRow:
    """Return a row without bounds of continuous control that the rate of a finer one contradicts.

    What is of the env's own steps is of its own period, and no other one contradicts it.
    """
    for evaluation in finer:
        finer_row = evaluation.row(row.filter)
        row = continuous_judged(row, *upper_ends_of(finer_row, evaluation.spec.confidence))
    return row


def _shares(progress: Progress | None) -> list[Progress | None]:
    """Return the progress of each evaluation, whose work is that of its control periods."""
    parts, before, found = (1, *DIVISORS), 0, []
    for part in parts:
        found.append(progress and _share(progress, before / sum(parts), part / sum(parts)))
        before += part
    return found


def _share(progress: Progress, before: float, size: float) -> Progress:
    return lambda done: progress(before + size * done)


def _divided(problem: SafetyProblem, divisor: int, coupled: bool) -> SafetyProblem:
    # Noise is drawn for one integration step after the other: of equal steps it is the same.
    steps = problem.substeps * (DIVISORS[-1] // divisor if coupled else 1)
    # With the whole number of periods as the horizon all end at the same time.
    return replace(problem, dt=problem.dt / divisor, substeps=steps, horizon=problem.duration)


def _order(evaluation: Evaluation) -> float:
    """Return the power of the period with which rates go to their limit."""
    discrete = evaluation.spec.monitoring == "discrete"
    return 0.5 if discrete and any(reached_by_noise(evaluation.problem)) else 1.0


def _row(
    own: EvaluationRow, given: Evaluation, evaluations: tuple[Evaluation, ...], order: float
) -> RefinementRow:
    name, confidence = own.filter, given.spec.confidence
    rows = [evaluation.row(name) for evaluation in evaluations]
    flags = [evaluation.safe[name][0] for evaluation in evaluations]
    changes = paired_difference_interval(*pair_counts(flags[2], flags[1]), confidence)
    ratio = 2.0**-order
    p1, p2, p4 = (row.safety_rate for row in rows)
    higher = abs(p4 - p2 - ratio * (p2 - p1)) / (1.0 - ratio)
    weights = (0.0, -ratio / (1.0 - ratio), 1.0 / (1.0 - ratio))
    limit = _widened(combined_rates(flags, weights, confidence), higher)
    error = _widened(combined_rates(flags, (1.0, -weights[1], -weights[2]), confidence), higher)
    steps = paired_difference_interval(*pair_counts(given.safe[name][0], flags[0]), _SURE)
    word = verdict(*error[1:])
    if not steps[0] <= 0.0 <= steps[1]:
        word = "integration"
    limit, limit_low, limit_high = (min(max(end, 0.0), 1.0) for end in limit)
    return RefinementRow(
        filter=name,
        safe=[row.safe for row in rows],
        safety_rate=[p1, p2, p4],
        ci_low=[row.ci_low for row in rows],
        ci_high=[row.ci_high for row in rows],
        change=p4 - p2,
        change_low=changes[0],
        change_high=changes[1],
        limit=limit,
        limit_low=limit_low,
        limit_high=limit_high,
        error=error[0],
        error_low=error[1],
        error_high=error[2],
        verdict="contradicted" if own.withheld else word,
        withheld=own.withheld,
    )


def _widened(found: tuple[float, float, float], by: float) -> tuple[float, float, float]:
    """Return a value and its interval, with another distance added to it as a square."""
    value, low, high = found
    return value, value - math.hypot(value - low, by), value + math.hypot(high - value, by)


def verdict(low: float, high: float) -> str:
    """Return what the interval (low, high) of the error of a rate means: see `refine`."""
    if max(-low, high) <= TOLERANCE:
        return "converged"
    return "not resolved" if low <= 0.0 <= high else "still changing"
