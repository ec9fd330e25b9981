"""Estimates of the probability of rare violations, of which plain episodes would hardly see one."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.attainable import WorkParts
from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, Filter, Progress, listed
from safe_envs.agents.evaluation.statistics import exact_interval, log_normal_interval
from safe_envs.agents.jobs.store import package_versions
from safe_envs.agents.rare_events.compiled_paths import ChosenPlayer, player_of
from safe_envs.agents.rare_events.splitting import (
    LEAST,
    POWERS,
    ImportanceSampling,
    Pilot,
    Repetitions,
    Splitting,
    optimal_tilt,
)
from safe_envs.engine.choice import require_engine
from safe_envs.errors import NumericalError, require_whole
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem

_ROUGH = 0.4
"""Standard deviation of the logarithms of repetitions above which their interval is doubted."""


@dataclass(frozen=True)
class RareEstimate:
    """A probability, from independent repetitions.

    Attributes:
        method: by which it was estimated.
        probability: mean of the repetitions.
        ci_low: lower end of its interval.
        ci_high: upper end.
        relative_error: standard error of the mean over the mean.
        estimates: of the repetitions.
    """

    method: str
    probability: float
    ci_low: float
    ci_high: float
    relative_error: float
    estimates: list[float]

    @classmethod
    def of(
        cls, method: str, estimates: np.ndarray, confidence: float, skew: float = 0.0
    ) -> RareEstimate:
        """Make an estimate from those of the repetitions, shape (R,), all above 0.

        Args:
            method: by which they were estimated.
            estimates: of the repetitions.
            confidence: of the interval.
            skew: see `skewed_interval`.
        """
        low, high = skewed_interval(estimates, confidence, skew)
        p = math.fsum(estimates) / len(estimates)
        error = float(np.std(estimates, ddof=1)) / math.sqrt(len(estimates)) / p
        return cls(method, p, low, min(high, 1.0), error, estimates.tolist())

    def __str__(self) -> str:
        return f"{self.probability:.3g} [{self.ci_low:.3g}, {self.ci_high:.3g}]"


@dataclass(frozen=True)
class PlainEpisodes:
    """The episodes with which splitting begins.

    Attributes:
        episodes: how many.
        violations: among them.
        ci_low: lower end of the interval of their share.
        ci_high: upper end.
        outside: how many start where h <= 0.
        kept_length: mean length of those that do not violate, in control periods; None without any.
    """

    episodes: int
    violations: int
    ci_low: float
    ci_high: float
    outside: int = 0
    kept_length: float | None = None


@dataclass(frozen=True, kw_only=True)
class RareRow:
    """What is estimated for one filter.

    Attributes:
        filter: its name.
        policy: name of the policy.
        status: "estimated" or "none".
        reason: why there is no estimate.
        method: as all up to `estimates` see `RareEstimate`; None without one.
        probability: of a violation.
        ci_low: lower end of its interval.
        ci_high: upper end.
        relative_error: of the probability.
        estimates: of the repetitions.
        plain_episodes_needed: for the same relative error without splitting.
        plain_steps_needed: control periods of these.
        doubt: what contradicts the estimate.
        check: that of the pilot, by another method.
        particles: episodes of a repetition.
        levels: mean number of levels.
        steps: control periods that were simulated.
        plain: the episodes at the beginning.
    """

    filter: str
    policy: str
    status: str
    reason: str | None = None
    method: str | None = None
    probability: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    relative_error: float | None = None
    estimates: tuple[float, ...] | list[float] = ()
    plain_episodes_needed: float | None = None
    plain_steps_needed: float | None = None
    doubt: str | None = None
    check: RareEstimate | None = None
    particles: int = 0
    levels: float = 0.0
    steps: int = 0
    plain: PlainEpisodes | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as JSON-able data."""
        return asdict(self) | {"estimates": list(self.estimates)}


def skewness(estimates: np.ndarray) -> float:
    """Return the third moment about the mean of estimates, in units of their deviation."""
    deviation = float(np.std(estimates))
    return (
        float(np.mean((estimates - np.mean(estimates)) ** 3)) / deviation**3 if deviation else 0.0
    )


def skewed_interval(
    estimates: np.ndarray, confidence: float, skew: float = 0.0
) -> tuple[float, float]:
    """Return an interval for the mean of positive estimates, of which the largest are the rarest.

    It is that for nearly normal logarithms, see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Some estimates are more skewed
    than that, on the side on which a probability is taken for too small: the upper end is that of
    Johnson's interval where this is larger, which has the third moment in place of a distribution.

    Args:
        estimates: of the repetitions, shape (R,).
        confidence: of the two-sided interval.
        skew: of other estimates of the same. It counts where it is larger: a few estimates seldom
            hold the large ones that make the moment what it is.

    Source: N. J. Johnson, Modified t tests and confidence intervals for asymmetrical populations,
        Journal of the American Statistical Association 73 (1978) 536-544.
    """
    from scipy.special import stdtrit

    low, high = log_normal_interval(estimates, confidence)
    count, mean = len(estimates), float(np.mean(estimates))
    deviation, skew = float(np.std(estimates, ddof=1)), max(skew, skewness(estimates))
    t = float(stdtrit(count - 1, 0.5 + confidence / 2.0)) / math.sqrt(count)
    return low, max(high, mean + deviation * (t + skew * (1.0 / (6.0 * count) + t**2 / 3.0)))


def doubt_of(found: RareEstimate, check: RareEstimate | None, plain: PlainEpisodes) -> str | None:
    """Return what contradicts an estimate; None if nothing does.

    Args:
        found: the estimate.
        check: that of the pilot, by another method; None if it is by the same.
        plain: the plain episodes.
    """
    if check is not None and not _overlap(found, check):
        return (
            f"{check.method} says {check.probability:.2g} [{check.ci_low:.2g},"
            f" {check.ci_high:.2g}]: take more particles"
        )
    if not _overlap(found, plain):
        return (
            f"the first episodes are plain ones, and {plain.violations} violations among"
            f" {plain.episodes} contradict it: take more particles"
        )
    spread = float(np.std(np.log(found.estimates), ddof=1))
    if spread > _ROUGH:
        return (
            f"its repetitions differ, with a standard deviation of {spread:.2g} of their"
            " logarithms, so that the interval may miss the probability: take more particles"
        )
    return None


def _overlap(one: RareEstimate, other: RareEstimate | PlainEpisodes) -> bool:
    return one.ci_low <= other.ci_high and other.ci_low <= one.ci_high


def plain_episodes(found: Repetitions, confidence: float) -> PlainEpisodes:
    """Return the episodes with which repetitions begin.

    Args:
        found: the repetitions.
        confidence: of the interval of the violations among them.
    """
    paths, count = found.paths, found.paths.lowest.size
    low, high = exact_interval(found.first, count, confidence)
    return PlainEpisodes(count, found.first, low, high, paths.outside, paths.kept_length)


def why_none(
    found: Repetitions, particles: int, problem: SafetyProblem, plain: PlainEpisodes
) -> str:
    """Return why repetitions have no estimate.

    Args:
        found: the repetitions, of which some were given up.
        particles: of each.
        problem: that was simulated.
        plain: the episodes with which they begin.
    """
    repetitions = len(found.estimates)
    h = "h" if len(problem.barriers) == 1 else "h/h(start)"
    if found.stuck:
        reason = (
            f"in {len(found.stuck)} of {repetitions} repetitions all {particles} particles stood at"
            f" one level and none came below {h} = {min(found.stuck):.3g}. There h may be flat,"
            " jump or never fall, or those that come lower are too few: more particles or a"
            " smaller dt may help"
        )
    else:
        reason = (
            f"in {len(found.endless)} of {repetitions} repetitions the probability to come below"
            f" {h} = {min(found.endless):.3g} is less than {LEAST:g} already; h = 0 may never be"
            " reached"
        )
    if not plain.violations:
        return reason
    seen = f"{plain.violations} of the {plain.episodes} plain episodes at its beginning violated"
    return f"{reason}. But {seen}, which says [{plain.ci_low:.3g}, {plain.ci_high:.3g}]"


PARTICLES = 250
REPETITIONS = 20

_EPISODES = 10
"""Plain episodes that take NumPy as long as a particle with all of its continuations, about."""

_BETTER = 2.0
"""How many times smaller the error of importance sampling has to be, as predicted."""

_MOST_DEVIATION = 2.0
"""Deviation of the weights, relative to the probability, up to which they are taken: larger ones
have heavy tails, and a sample of them does not show how large they can be."""

_FEWEST_PARTICLES = 20
_FEWEST_REPETITIONS = 10


@dataclass(frozen=True)
class RareEvaluation:
    """The result of `estimate_rare`.

    Attributes:
        problem: what was simulated.
        config: all that determines the result, as JSON-able data.
        rows: an estimate for each filter, or why there is none.
        timing: the part that depends on the machine.
    """

    problem: SafetyProblem
    config: dict[str, Any]
    rows: list[RareRow]
    timing: dict[str, Any]

    def document(self) -> dict[str, Any]:
        """Return the whole as JSON-able data."""
        return {
            "config": self.config,
            "versions": package_versions(),
            "rows": [row.as_dict() for row in self.rows],
            "timing": self.timing,
        }


def estimate_rare(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    filters: Sequence[Filter] | Filter | None = None,
    *,
    particles: int | None = None,
    repetitions: int = REPETITIONS,
    num_envs: int = 4096,
    engine: str = "auto",
    progress: Progress | None = None,
    **fields: Any,
) -> RareEvaluation:
    """Estimate the probability of a violation under each filter, by splitting on h.

    See `safe_envs.agents.rare_events.splitting.Splitting`.

    A pilot, whose noise has a seed of its own, chooses how: the score on which paths are split, the
    number of particles, and whether importance sampling by a drift is used, see
    `safe_envs.agents.rare_events.splitting.optimal_tilt`. The choice knows nothing of the
    estimate, which therefore remains unbiased.

    An episode is safe as in `safe_envs.agents.evaluation.evaluate.evaluate`. The intervals are
    those of independent repetitions, see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Where splitting cannot work a row
    has the reason in place of numbers.

    Args:
        problem: as for `evaluate`, but no third-party env, whose state cannot be restored.
        policy: as for `evaluate`, without memory.
        filters: as for `evaluate`.
        particles: episodes of a repetition; by default 250, or as many, up to 4000, as make the
            repetitions differ little.
        repetitions: independent ones, at least 10.
        num_envs: the most episodes that NumPy simulates side by side; all but `timing` is the same,
            to the last bit, for any.
        engine: "numpy", "compiled", or "auto" for the compiled one where it is there, can do it,
            and saves time. Their numbers agree but for rounding.
        progress: called with the part of the work that is done, from 0 to 1.
        **fields: `seed`, `options`, `knowledge`, `objective`, `confidence`, `learned`, `monitoring`
            and `trust` of `EvaluationSpec`; what is missing is learned once.

    Raises:
        ConfigurationError: An argument names something unknown or is out of range, or the env or
            the policy cannot be split.
        RelativeDegreeError: A condition does not suit a barrier.
        NumericalError: A simulation or a condition left the finite numbers.
    """
    for name, value, least in (
        ("particles", PARTICLES if particles is None else particles, _FEWEST_PARTICLES),
        ("repetitions", repetitions, _FEWEST_REPETITIONS),
        ("num_envs", num_envs, 1),
    ):
        require_whole(name, value, least)
    require_engine(engine)
    # Those that are given here have no meaning for splitting, and are refused among the fields.
    spec = EvaluationSpec(
        problem,
        policy,
        listed(filters),
        filter_spec=None,
        episodes=1,
        repeats=1,
        bounds=False,
        **fields,
    )
    resolved = ResolvedEvaluation(spec)
    require_direct(resolved.problem, "estimates of rare events")
    require_full_state(resolved.problem, "the filters of estimates of rare events")
    work = WorkParts(progress, resolved.parts + 2 * len(resolved.names))
    resolved.learn(work.part)
    config = {**resolved.config(), "particles": particles, "repetitions": repetitions}
    estimator = _Estimator(resolved, particles, repetitions, num_envs, engine, work)
    rows, speeds = [], []
    for name in resolved.names:
        row, speed = estimator.row(name, config["policy"]["name"])
        rows.append(row)
        speeds.append({"filter": name, **speed})
    return RareEvaluation(resolved.problem, config, rows, {"num_envs": num_envs, "rows": speeds})


@dataclass(frozen=True)
class _Estimator:
    """Estimates the probability of a violation, filter by filter."""

    resolved: ResolvedEvaluation
    particles: int | None
    repetitions: int
    num_envs: int
    engine: str
    work: WorkParts

    def row(self, name: str, policy: str) -> tuple[RareRow, dict[str, Any]]:
        """Return the row of a filter, and its timing."""
        nothing = RareRow(filter=name, policy=policy, status="none")
        if self.resolved.is_frozen:
            reason = (
                "nothing is random after the start, so that copies of an episode go on like it;"
                " plain episodes find all that there is"
            )
            speed = {"seconds": 0.0, "steps_per_second": 0.0, "engine": "numpy", "jobs": 1}
            return replace(nothing, reason=reason), speed
        # What compiles, or is read from disk, is no part of the time.
        chosen = self._player(name, 2 * self._first)
        begun = time.perf_counter()
        pilot = Splitting(chosen.player, self.resolved.spec.seed).pilot(
            self._first, self.repetitions, self.work.part()
        )
        seconds = time.perf_counter() - begun
        particles = self.particles or pilot.enough()
        if chosen.engine != "compiled":
            chosen = self._player(name, particles)
        begun = time.perf_counter()
        row = self._estimated(nothing, pilot, particles, chosen)
        seconds += time.perf_counter() - begun
        speed = {"seconds": seconds, "steps_per_second": row.steps / seconds}
        return row, {**speed, "engine": chosen.engine, "jobs": chosen.jobs}

    @property
    def _first(self) -> int:
        """Particles of a pilot."""
        return min(self.particles or PARTICLES, PARTICLES)

    def _player(self, name: str, particles: int) -> ChosenPlayer:
        """Return who simulates repetitions of so many particles under a filter."""
        periods = _EPISODES * particles * self.repetitions * self.resolved.problem.steps
        conditions = self.resolved.filters[name][0]
        return player_of(self.resolved, conditions, self.num_envs, self.engine, periods)

    def _estimated(
        self, nothing: RareRow, pilot: Pilot, particles: int, chosen: ChosenPlayer
    ) -> RareRow:
        """Fill the row of a filter."""
        spec, steps = self.resolved.spec, pilot.run.paths.steps
        seen, levels, check = pilot.run, pilot.run.levels[pilot.part], None
        best, drift_steps = self._by_drift(pilot, particles, chosen)
        size, steps = self._first, steps + drift_steps
        if best is None:
            size, splitting = particles, Splitting(chosen.player, spec.seed)
            seen = splitting.estimate(pilot.power, size, self.repetitions, self.work.part())
            levels, steps = seen.levels, steps + seen.paths.steps
        plain, mean = plain_episodes(seen, spec.confidence), float(levels.mean())
        nothing = replace(nothing, levels=mean, steps=steps, plain=plain, particles=size)
        by = f"splitting on h{'/sqrt(T - t)' * (pilot.power != POWERS[0])}"
        if best is not None:
            check = RareEstimate.of(by, pilot.estimates, spec.confidence)
        elif seen.stuck or seen.endless:
            return replace(nothing, reason=why_none(seen, particles, self.resolved.problem, plain))
        else:
            skew = skewness(pilot.estimates)
            best = RareEstimate.of(by, seen.estimates, spec.confidence, skew)
            if not levels.any():
                ends = {"ci_low": plain.ci_low, "ci_high": plain.ci_high}
                best = replace(best, method="plain episodes", **ends)
        p, error = best.probability, best.relative_error
        needed = (1.0 - p) / (p * error**2) if error else None
        return replace(
            nothing,
            status="estimated",
            **vars(best),
            plain_episodes_needed=needed,
            plain_steps_needed=None if needed is None else needed * seen.length,
            doubt=doubt_of(best, check, plain),
            check=check,
        )

    def _by_drift(
        self, pilot: Pilot, particles: int, chosen: ChosenPlayer
    ) -> tuple[RareEstimate | None, int]:
        """Return the estimate by importance sampling, and the control periods that it took."""
        if pilot.often or not (pilot.estimates > 0.0).all():
            return None, 0
        length, deviation = optimal_tilt(
            *pilot.run.violating(pilot.part), self.resolved.problem.duration
        )
        predicted = pilot.deviation * math.sqrt(pilot.particles / particles)
        worth = _BETTER * deviation / math.sqrt(self._first) < predicted
        if deviation > _MOST_DEVIATION or not worth:
            return None, 0
        drifting = ImportanceSampling(chosen.player, self.resolved.spec.seed)
        try:
            estimates, steps = drifting.estimate(length, self._first, self.repetitions)
        except NumericalError:
            # Pushed far out, a system may leave the finite numbers.
            return None, 0
        if not (estimates > 0.0).all():
            return None, steps
        if (done := self.work.part()) is not None:
            done(1.0)
        method = f"drift of {length:.3g}/sqrt(s)"
        return RareEstimate.of(method, estimates, self.resolved.spec.confidence), steps
