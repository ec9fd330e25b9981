"""Estimates of the probability of rare violations, of which plain episodes would hardly see one."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, Filter, Progress, listed
from safe_envs.agents.evaluation.work_parts import WorkParts
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.agents.rare_events.importance_sampling import ImportanceSampling, optimal_tilt
from safe_envs.agents.rare_events.path_players import ChosenPlayer, player_of
from safe_envs.agents.rare_events.rows import (
    RareEstimate,
    RareRow,
    doubt_of,
    plain_episodes,
    skewness,
    why_none,
)
from safe_envs.agents.rare_events.splitting import POWERS, Pilot, Splitting
from safe_envs.compiled.engine import require_engine
from safe_envs.errors import NumericalError, require_whole
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem

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
    `safe_envs.agents.rare_events.importance_sampling.optimal_tilt`. The choice knows nothing of the
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
        """Fill the row of a filter.

        Args:
            nothing: the row without an estimate.
            pilot: which chooses how.
            particles: of splitting.
            chosen: simulates the paths.
        """
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
        """Return the estimate by importance sampling, and the control periods that it took.

        There is none unless the pilot predicts that it is much better.
        """
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
