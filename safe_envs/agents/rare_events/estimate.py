"""Estimates of the probability of rare violations, of which plain episodes would hardly see one."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, Filter, Progress, listed
from safe_envs.agents.evaluation.statistics import exact_interval
from safe_envs.agents.evaluation.work_parts import WorkParts
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.agents.rare_events.importance_sampling import ImportanceSampling, optimal_tilt
from safe_envs.agents.rare_events.particles import PathPlayer
from safe_envs.agents.rare_events.path_players import player_of
from safe_envs.agents.rare_events.rows import BETTER, PlainEpisodes, RareEstimate, RareRow, verdict
from safe_envs.agents.rare_events.splitting import LEAST, POWERS, Repetitions, Splitting
from safe_envs.compiled.engine import require_engine
from safe_envs.errors import NumericalError, require_whole
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem

PARTICLES = 250
REPETITIONS = 20

_EPISODES = 10
"""Plain episodes that take NumPy as long as a particle with all of its continuations, about."""

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
    particles: int = PARTICLES,
    repetitions: int = REPETITIONS,
    num_envs: int = 4096,
    engine: str = "auto",
    progress: Progress | None = None,
    **fields: Any,
) -> RareEvaluation:
    """Estimate the probability of a violation under each filter, by splitting on h.

    See `safe_envs.agents.rare_events.splitting.Splitting`.

    The violating paths of splitting predict the error of importance sampling by a drift, see
    `safe_envs.agents.rare_events.importance_sampling.optimal_tilt`. If that is less than half of
    splitting's relative error, it is tried; see `safe_envs.agents.rare_events.rows.verdict`.

    An episode is safe as in `safe_envs.agents.evaluation.evaluate.evaluate`. The intervals are
    those of independent repetitions, see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Where splitting cannot work a row
    has the reason in place of numbers.

    Args:
        problem: as for `evaluate`, but no third-party env, whose state cannot be restored.
        policy: as for `evaluate`, without memory.
        filters: as for `evaluate`.
        particles: episodes of a repetition.
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
        ("particles", particles, _FEWEST_PARTICLES),
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
    particles: int
    repetitions: int
    num_envs: int
    engine: str
    work: WorkParts

    def row(self, name: str, policy: str) -> tuple[RareRow, dict[str, Any]]:
        """Return the row of a filter, and its timing."""
        resolved = self.resolved
        nothing = RareRow(filter=name, policy=policy, status="none")
        if resolved.is_frozen:
            reason = (
                "nothing is random after the start, so that copies of an episode go on like it;"
                " plain episodes find all that there is"
            )
            speed = {"seconds": 0.0, "steps_per_second": 0.0, "engine": "numpy", "jobs": 1}
            return replace(nothing, reason=reason), speed
        periods = _EPISODES * self.particles * self.repetitions * resolved.problem.steps
        chosen = player_of(resolved, resolved.filters[name][0], self.num_envs, self.engine, periods)
        begun = time.perf_counter()
        row = self._estimated(nothing, chosen.player)
        seconds = time.perf_counter() - begun
        speed = {"seconds": seconds, "steps_per_second": row.steps / seconds}
        return row, {**speed, "engine": chosen.engine, "jobs": chosen.jobs}

    def _estimated(self, nothing: RareRow, player: PathPlayer) -> RareRow:
        """Fill the row of a filter.

        Args:
            nothing: the row without an estimate.
            player: simulates the paths.
        """
        spec, problem = self.resolved.spec, self.resolved.problem
        how = (player, spec.seed)
        splitting, work = Splitting(*how), self.work
        power, pilot_steps = splitting.choose(self.particles, work.part())
        found = splitting.estimate(power, self.particles, self.repetitions, work.part())
        paths = found.paths
        low, high = exact_interval(found.first, paths.lowest.size, spec.confidence)
        plain = PlainEpisodes(
            paths.lowest.size, found.first, low, high, paths.outside, paths.kept_length
        )
        steps = paths.steps + pilot_steps
        nothing = replace(nothing, levels=float(found.levels.mean()), steps=steps, plain=plain)
        if found.stuck or found.endless:
            return replace(nothing, reason=_why_none(found, self.particles, problem, plain))
        by = "splitting on h" if power == POWERS[0] else "splitting on h/sqrt(T - t)"
        split = RareEstimate.of(by, found.estimates, spec.confidence)
        if not found.levels.any():
            split = replace(split, method="plain episodes", ci_low=low, ci_high=high)
        drift, drift_steps = self._by_drift(ImportanceSampling(*how), found, split.relative_error)
        best, check, doubt = verdict(split, drift, plain)
        p, error = best.probability, best.relative_error
        needed = (1.0 - p) / (p * error**2) if error else None
        return replace(
            nothing,
            status="estimated",
            **vars(best),
            plain_episodes_needed=needed,
            plain_steps_needed=None if needed is None else needed * found.length,
            doubt=doubt,
            check=check,
            steps=steps + drift_steps,
        )

    def _by_drift(
        self,
        drifting: ImportanceSampling,
        found: Repetitions,
        to_beat: float,
    ) -> tuple[RareEstimate | None, int]:
        """Return the estimate by importance sampling, and the control periods that it took.

        There is none unless it is predicted to be much better.
        """
        duration, sizes = self.resolved.problem.duration, (self.particles, self.repetitions)
        length, deviation = optimal_tilt(*found.violating(), duration)
        if not BETTER * deviation / math.sqrt(math.prod(sizes)) < to_beat:
            return None, 0
        try:
            estimates, steps = drifting.estimate(length, *sizes)
        except NumericalError:
            # Pushed far out, a system may leave the finite numbers.
            return None, 0
        if not (estimates > 0.0).all():
            return None, steps
        method = f"drift of {length:.3g}/sqrt(s)"
        return RareEstimate.of(method, estimates, self.resolved.spec.confidence), steps


def _why_none(
    found: Repetitions, particles: int, problem: SafetyProblem, plain: PlainEpisodes
) -> str:
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
