"""The chain of a filter that is verified: bound for held input <= measured rate <= attainable.

All of it is of the env's own steps. The bound for continuous control is another claim, and stands
next to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    against_attainable,
    contradicted,
    progress_of_part,
)
from safe_envs.agents.evaluation.bounds import (
    FilteredPolicy,
    HeldAverager,
    by_rate,
    by_states,
    end_for,
    held_bound_of,
    judged,
    upper_ends,
)
from safe_envs.agents.evaluation.episodes import VisitedStates
from safe_envs.agents.evaluation.evaluate import Evaluation, evaluate
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import exact_upper_end
from safe_envs.filters.conditions.text import FilterSettings, spec_of
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.feasibility import Verification
from safe_envs.proofs.guarantees import HOLDING, Bound
from safe_envs.proofs.safe_set import draw_starts

STARTS = 2**14
"""How many starts of a distribution a bound is averaged over."""

_MULTIPLES = (1, 2, 5, 10, 20)
_LONG_MULTIPLES = (50, 100, 200, 500)
_MOST_INSTANTS = 50_000
_MOST_STEPS = 25_000_000
_MOST_SOLVED = 400_000
_ERROR = 0.05
_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Horizon:
    """The measured safety up to a time, next to the bounds.

    Attributes:
        time: T in s.
        safe: number of episodes without a violation up to it.
        rate: their share.
        ci_low: lower end of its 95 % interval.
        ci_high: upper end.
        bounds: for this horizon, those that have a value.
        contradicted: the names of those that the measurement contradicts.
    """

    time: float
    safe: int
    rate: float
    ci_low: float
    ci_high: float
    bounds: tuple[Bound, ...]
    contradicted: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeasuredSafety:
    """The measured safety from a start.

    Attributes:
        start: a name, or what the state is.
        state: the state, shape (n,); None for a distribution.
        episodes: how many were simulated.
        repeats: whether nothing is random, so that all episodes are one and the same.
        horizons: the shortest first.
        visited: states that may contradict a bound.
    """

    start: str
    state: np.ndarray | None
    episodes: int
    repeats: bool
    horizons: tuple[Horizon, ...]
    visited: tuple[VisitedStates, ...] = ()

    def ends(self, horizon: Horizon) -> tuple[float, float]:
        """Return the `upper_ends` of its rate at 95 %."""
        if self.repeats:
            return horizon.rate, horizon.rate
        return upper_ends(horizon.safe, self.episodes, 0.95)


def withhold_contradicted(
    bounds: Sequence[Bound], measurements: Sequence[MeasuredSafety], verification: Verification
) -> tuple[list[Bound], list[MeasuredSafety]]:
    """Withhold the values of what was estimated and is contradicted.

    See `safe_envs.agents.evaluation.bounds`.

    Args:
        bounds: at the start.
        measurements: of the same conditions.
        verification: on which the bounds rest.
    """
    visited = [each for m in measurements for each in m.visited]
    of_all = by_states(verification.guarantee, visited)
    of_each: dict[str, str] = {}
    for m in measurements:
        for h in m.horizons:
            for bound in h.bounds:
                below = by_rate(bound.value, end_for(bound.status, *m.ends(h)))
                if below:
                    of_each.setdefault(bound.name, f"from {m.start}, up to {h.time:g} s, {below}")

    def without(bound: Bound) -> Bound:
        return bound.without(of_each.get(bound.name) or of_all)

    def cleared(h: Horizon) -> Horizon:
        return replace(h, bounds=tuple(map(without, h.bounds)))

    return [without(bound) for bound in bounds], [
        replace(m, horizons=tuple(map(cleared, m.horizons))) for m in measurements
    ]


def measure(
    verification: Verification,
    policy: Any = "nominal",
    *,
    episodes: int = 500,
    seed: int = 0,
    engine: str = "auto",
    progress: Progress | None = None,
) -> list[MeasuredSafety]:
    """Simulate a policy under the conditions, and compare its safety with the bounds.

    The horizons are the problem's times 1, 2, 5, ..., up to 20 or, if there is noise and a bound
    that is for ever, 500, as far as the simulation stays short. A bound is contradicted where the
    upper end of a one-sided exact interval lies below it by more than its own error, an interval so
    wide that in 20 such reports at most one contradicts a bound that holds: the 5 % are shared by
    all comparisons.

    Args:
        verification: of the conditions.
        policy: as for `evaluate`.
        episodes: how many.
        seed: of all randomness.
        engine: as for `evaluate`.
        progress: called with the part of the work that is done, from 0 to 1.

    Returns:
        The measurement, with the bounds that it contradicts.

    Raises:
        ConfigurationError: as `evaluate`.
    """
    return _all_compared([_measure(verification, policy, episodes, seed, engine, progress)])


def starts_of(problem: SafetyProblem, seed: int = 0) -> np.ndarray:
    """Return the starts that bounds are averaged over, shape (B, n); one if all are the same.

    Args:
        problem: whose starts they are.
        seed: of the draws.
    """
    return draw_starts(problem, STARTS if problem.starts[problem.start].uniforms else 1, seed)


def _measure(
    verification: Verification,
    policy: Any,
    episodes: int,
    seed: int,
    engine: str,
    progress: Progress | None,
) -> MeasuredSafety:
    world, formulas = verification.problem, verification.formulas
    starts = starts_of(world, seed)
    lasting = formulas.noisy and any(
        b.forever and b.value
        for b in verification.guarantee.applicable_bounds(starts, world.duration)
    )
    runs = _runs(world, lasting, episodes)
    horizons: list[Horizon] = []
    visited: list[VisitedStates] = []
    repeats = False
    done, whole = 0, sum(run[-1] for run in runs)
    for run in runs:
        answer = evaluate(
            replace(world, horizon=run[-1] * world.duration),
            policy,
            [spec_of(formulas.conditions)],
            episodes=episodes,
            seed=seed,
            knowledge=formulas.knowledge,
            bounds=False,
            engine=engine,
            progress=progress_of_part(progress, done / whole, run[-1] / whole),
        )
        horizons += [_horizon(verification, answer, k * world.duration, starts) for k in run]
        visited += answer.visited[answer.rows[0].filter]
        repeats, done = answer.is_deterministic, done + run[-1]
    return MeasuredSafety(
        f"the start {world.start!r}",
        starts[0] if len(starts) == 1 else None,
        episodes,
        repeats,
        tuple(horizons),
        tuple(visited),
    )


def _runs(world: SafetyProblem, lasting: bool, episodes: int) -> list[list[int]]:
    """Return which horizons to measure, in units of the problem's."""
    # Several conditions on more than two inputs go to an iterative solver.
    allowed = _MOST_SOLVED if len(world.barriers) > 1 and len(world.inputs) > 2 else _MOST_STEPS
    most = min(_MOST_INSTANTS, allowed // episodes) / world.steps
    lengths = (_MULTIPLES, _LONG_MULTIPLES) if lasting else (_MULTIPLES,)
    runs = [[k for k in length if k == 1 or k <= most] for length in lengths]
    return [run for run in runs if run]


def _horizon(
    verification: Verification, answer: Evaluation, horizon: float, starts: np.ndarray
) -> Horizon:
    """Read the curve of an evaluation at its last instant up to a horizon."""
    curve = answer.rows[0].curve
    i = int(np.searchsorted(curve.time, horizon * (1.0 + 1e-9), side="right")) - 1
    time = curve.time[i]
    found = verification.guarantee.applicable_bounds(starts, time)
    bounds = tuple(bound for bound in found if bound.value is not None)
    return Horizon(time, curve.safe[i], curve.rate[i], curve.ci_low[i], curve.ci_high[i], bounds)


def _all_compared(found: list[MeasuredSafety]) -> list[MeasuredSafety]:
    comparisons = max(
        1, sum(bool(bound.value) for m in found for h in m.horizons for bound in h.bounds)
    )
    return [
        replace(m, horizons=tuple(_compared(m, h, comparisons) for h in m.horizons)) for m in found
    ]


def _compared(measurement: MeasuredSafety, horizon: Horizon, comparisons: int) -> Horizon:
    """Name the bounds above the interval, or above the rate where nothing is random."""
    most = (
        horizon.rate
        if measurement.repeats
        else exact_upper_end(horizon.safe, measurement.episodes, _ERROR / comparisons)
    )
    above = [
        b.name
        for b in horizon.bounds
        if b.value is not None and b.value - _DEVIATIONS * b.error > most
    ]
    return replace(horizon, contradicted=tuple(above))


@dataclass(frozen=True)
class SafetyChain:
    """The bounds of a filter, its measured rate, and what any policy can attain.

    Attributes:
        bounds: for held input and for continuous control.
        rate: measured from the problem's start, up to its horizon; None where it was not.
        ci_low: lower end of the 95 % interval of the rate.
        ci_high: upper end.
        best: attainable safety, if it was asked for.
    """

    bounds: BoundSummary
    rate: float | None
    ci_low: float | None
    ci_high: float | None
    best: AttainableSafety | None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        found = asdict(self.bounds)
        shown = {name: value for name, value in found.items() if name in _SHOWN}
        rate = {"safety_rate": self.rate, "ci_low": self.ci_low, "ci_high": self.ci_high}
        return shown | rate | {"best": self.best and self.best.as_dict()}


_SHOWN = (
    *("withheld", "held_bound", "held_word", "held_note", "held_error"),
    *("continuous_bound", "continuous_word", "continuous_note", "continuous_error"),
)


def safety_chain(
    filtered: FilteredPolicy,
    starts: np.ndarray,
    bounds: Sequence[Bound],
    measurements: Sequence[MeasuredSafety],
    best: AttainableSafety | None = None,
) -> SafetyChain:
    """Return the chain of conditions, without what contradicts another part of it.

    Args:
        filtered: the conditions, and the policy that was simulated.
        starts: over which the bounds are averaged, shape (B, n).
        bounds: for continuous control, as far as they are not contradicted.
        measurements: of the problem's start first; none without a simulation.
        best: attainable safety, if it was asked for.
    """
    problem = filtered.problem
    assert not isinstance(filtered.parts, FilterSettings)
    name = spec_of(filtered.parts)
    averager = HeldAverager(held_bound_of(filtered))
    averager.add(starts)
    first = measurements[0] if measurements else None
    visited = first.visited if first and first.visited else [VisitedStates.nothing(problem)]
    summary = _of_continuous(bounds)
    for each in visited:
        summary = averager.put_in(summary, each)
        if summary.withheld:
            break
    rates = None, None, None
    if first is not None:
        h = first.horizons[0]
        rates = h.rate, h.ci_low, h.ci_high
        # The bounds for continuous control were judged before, with all measurements.
        held = judged(replace(summary, continuous_bound=None), *first.ends(h))
        summary = replace(held, continuous_bound=summary.continuous_bound)
        episodes = 1 if first.repeats else first.episodes
        best = best and contradicted(best, [(name, round(h.rate * episodes), episodes)])
    if best is not None:
        best, summary = against_attainable(best, best.upper, name, summary)
    return SafetyChain(summary, *rates, best)


def _of_continuous(bounds: Sequence[Bound]) -> BoundSummary:
    """Return the largest bound that is proved, or else the largest one that is estimated."""
    for word in HOLDING:
        found = [b for b in bounds if b.status == word and b.value]
        if found:
            largest = max(found, key=lambda b: b.value or 0.0)
            return BoundSummary(
                continuous_bound=largest.value,
                continuous_word="proved" if word == "proved" else "estimated",
                continuous_note=largest.reason,
                continuous_error=largest.error,
            )
    against = next((b for b in bounds if b.status == "withheld"), bounds[-1])
    word = "withheld" if against.status == "withheld" else "none"
    note = against.reason or "it is 0 at these starts up to this horizon"
    return BoundSummary(continuous_word=word, continuous_note=note)
