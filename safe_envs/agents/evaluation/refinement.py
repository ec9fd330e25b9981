"""Has the safety rate converged in the control period?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

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
"""The most by which a rate may change, at either end of the interval, to be called converged."""


@dataclass(frozen=True)
class RefinementRow:
    """The safety rate under a filter with smaller and smaller control periods.

    Attributes:
        filter: its name.
        safe: number of safe episodes with each period.
        safety_rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
        change: of the rate from dt/2 to dt/4.
        change_low: lower end of the interval of the change.
        change_high: upper end.
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
    verdict: str
    withheld: str | None


@dataclass(frozen=True)
class Refinement:
    """The result of `refine`.

    Attributes:
        evaluations: with the control period dt as given, dt/2 and dt/4.
        rows: for each filter its rates with these periods, the change between the last two, and a
            verdict.
    """

    evaluations: tuple[Evaluation, ...]
    rows: list[RefinementRow]

    @property
    def periods(self) -> list[float]:
        """The control periods in s."""
        return [evaluation.problem.dt for evaluation in self.evaluations]

    def document(self) -> dict[str, Any]:
        """Return the evaluation with the given dt and its refinement as JSON-able data."""
        rows = [asdict(row) for row in self.rows]
        refinement = {"dt": self.periods, "tolerance": TOLERANCE, "rows": rows}
        return {**self.evaluations[0].document(), "refinement": refinement}


def refine(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    *,
    progress: Progress | None = None,
    record: bool = False,
    episodes_out: Path | str | None = None,
    **arguments: Any,
) -> Refinement:
    """Evaluate with the control periods dt, dt/2 and dt/4: has the safety rate converged?

    Learned filters are learned once, with the period dt.

    Control, noise and the check of safety go with the period; `substeps` stay as they are. The
    horizon is the number of whole periods dt that is simulated with the first. Episode i has the
    same seed each time, hence the same start, but its noise is not the same path sampled more
    finely. The change is that of paired episodes.

    The verdict on a rate is "converged" where the interval of its change from dt/2 to dt/4 reaches
    no further than `TOLERANCE` either way. Elsewhere it is "still changing" where the interval does
    not contain 0, and "not resolved" where it does, so that more episodes are needed. It says
    nothing of still smaller periods. A rate with any of these periods contradicts a bound as it
    does in `evaluate`: then that is withheld, and the verdict "contradicted".

    Args:
        problem: as for `evaluate`.
        policy: as for `evaluate`.
        progress: called with the part of the work of all three that is done, from 0 to 1.
        record: keep trajectories of the first evaluation for pictures.
        episodes_out: FILE.parquet for the results of each episode of the first evaluation.
        **arguments: the others of `evaluate`.

    Returns:
        The three evaluations, and the rates with each period.

    Raises:
        ConfigurationError: as for `evaluate`, or dt cannot be divided.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.
    """
    if arguments.get("repeats", 1) != 1:
        raise ConfigurationError(
            "repeats are of the identification and refinement of the period: ask for one of the two"
        )
    if arguments.get("filter_spec") is not None:
        raise ConfigurationError(
            "the control period of a third-party env is its own, and cannot be refined"
        )
    of_first = {"record": record, "episodes_out": episodes_out}
    first = evaluate(problem, policy, progress=_share(progress, 0), **of_first, **arguments)
    arguments |= {
        "options": None,
        "filters": first.spec.filters or [row.filter for row in first.rows],
        "bounds": False,
        "best": False,
        "closed_loop": False,
        "learned": first.learned,
    }
    finer = [
        evaluate(_divided(first.problem, d), policy, progress=_share(progress, i), **arguments)
        for i, d in enumerate(DIVISORS)
        if i
    ]
    # The finer ones are nearer to continuous time, of which the bounds are.
    first = replace(first, rows=[_judged(row, finer) for row in first.rows])
    evaluations = (first, *finer)
    return Refinement(evaluations, [_row(row.filter, evaluations) for row in first.rows])


def _judged(row: EvaluationRow, finer: Sequence[Evaluation]) -> EvaluationRow:
    """Return a row without bounds of continuous control that the rate of a finer one contradicts.

    What is of the env's own steps is of its own period, and no other one contradicts it.
    """
    for evaluation in finer:
        finer_row = evaluation.row(row.filter)
        row = continuous_judged(row, *upper_ends_of(finer_row, evaluation.spec.confidence))
    return row


def _share(progress: Progress | None, i: int) -> Progress | None:
    """Return the progress of the i-th evaluation, whose work is that of its steps."""
    if progress is None:
        return None
    before, all_steps = sum(DIVISORS[:i]), sum(DIVISORS)
    return lambda done: progress((before + DIVISORS[i] * done) / all_steps)


def _divided(problem: SafetyProblem, divisor: int) -> SafetyProblem:
    # With the whole number of periods as the horizon all three end at the same time.
    return replace(problem, dt=problem.dt / divisor, horizon=problem.duration)


def _row(name: str, evaluations: tuple[Evaluation, ...]) -> RefinementRow:
    rows = [evaluation.row(name) for evaluation in evaluations]
    coarse, fine = (evaluation.safe[name][0] for evaluation in evaluations[-2:])
    low, high = paired_difference_interval(
        *pair_counts(fine, coarse), evaluations[0].spec.confidence
    )
    return RefinementRow(
        filter=name,
        safe=[row.safe for row in rows],
        safety_rate=[row.safety_rate for row in rows],
        ci_low=[row.ci_low for row in rows],
        ci_high=[row.ci_high for row in rows],
        change=rows[-1].safety_rate - rows[-2].safety_rate,
        change_low=low,
        change_high=high,
        verdict="contradicted" if rows[0].withheld else verdict(low, high),
        withheld=rows[0].withheld,
    )


def verdict(low: float, high: float) -> str:
    """Return what the interval (low, high) of the change of a rate means: see `refine`."""
    if max(-low, high) <= TOLERANCE:
        return "converged"
    return "not resolved" if low <= 0.0 <= high else "still changing"
