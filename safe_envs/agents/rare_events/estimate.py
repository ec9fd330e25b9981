"""How rare violations are, where plain episodes would hardly see one."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, require_monitoring
from safe_envs.agents.evaluation.evaluate import package_versions
from safe_envs.agents.evaluation.rollout import Progress, Row
from safe_envs.agents.evaluation.spec import EvaluationSpec, Work
from safe_envs.agents.evaluation.statistics import (
    log_normal_interval,
    rate_interval,
    require_confidence,
)
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.rare_events.importance_sampling import Drifting, optimal_tilt
from safe_envs.agents.rare_events.splitting import LEAST, POWERS, Repetitions, Splitting
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import NumericalError, require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning import LearnedModel

PARTICLES = 250
REPETITIONS = 20

_BETTER = 2.0
"""How many times smaller the relative error of the drift has to be."""

_ROUGH = 1.0
_FEWEST_PARTICLES = 20
_FEWEST_REPETITIONS = 10


@dataclass(frozen=True)
class RareEvaluation:
    """The answer of `estimate_rare`.

    Attributes:
        problem: what was simulated.
        config: everything needed to run it again, as JSON.
        rows: an estimate for each filter, or why there is none.
        timing: the part that depends on the machine.
    """

    problem: SafetyProblem
    config: dict[str, Any]
    rows: list[Row]
    timing: dict[str, Any]

    def document(self) -> dict[str, Any]:
        """The whole as JSON-able data."""
        return {
            "config": self.config,
            "versions": package_versions(),
            "rows": self.rows,
            "timing": self.timing,
        }


def estimate_rare(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    filters: Sequence[str] | None = None,
    *,
    trust: bool = False,
    options: Mapping[str, Any] | None = None,
    particles: int = PARTICLES,
    repetitions: int = REPETITIONS,
    seed: int = 0,
    num_envs: int = 4096,
    knowledge: str = "model",
    objective: str = "nearest",
    confidence: float = 0.95,
    learned: Sequence[LearnedModel | Path | str] = (),
    monitoring: str = "discrete",
    progress: Progress | None = None,
) -> RareEvaluation:
    """Estimate the probability of a violation under each filter by splitting on h; see
    `safe_envs.agents.rare_events.splitting.Splitting`.

    The paths that violate, as splitting found them, say what importance sampling by a drift could
    do, see `safe_envs.agents.rare_events.importance_sampling.optimal_tilt`. If that is less than
    half of splitting's relative error, it is tried; see `verdict`.

    An episode is safe as in `safe_envs.agents.evaluation.evaluate.evaluate`. The intervals are
    those of independent repetitions; see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Where splitting cannot work a row
    has the reason in place of numbers.

    Args:
        problem: as for `evaluate`, but no env of somebody else, which cannot be put back to where
            it was.
        policy: as for `evaluate`, without memory.
        filters: as for `evaluate`.
        trust: as for `evaluate`.
        options: as for `evaluate`.
        particles: episodes of a repetition.
        repetitions: independent ones, at least 10.
        seed: of all randomness.
        num_envs: the most episodes side by side; another number is another draw of the same
            estimate.
        knowledge: as for `evaluate`.
        objective: as for `evaluate`.
        confidence: of all intervals, between 0 and 1.
        learned: as for `evaluate`; what is missing is learned once.
        monitoring: as for `evaluate`.
        progress: told the part of the work that is done, from 0 to 1.

    Raises:
        ConfigurationError: an argument names something unknown or is out of range, or the env or
            the policy cannot be split.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.
    """
    for name, value, least in (
        ("particles", particles, _FEWEST_PARTICLES),
        ("repetitions", repetitions, _FEWEST_REPETITIONS),
        ("num_envs", num_envs, 1),
    ):
        require_whole(name, value, least)
    require_confidence(confidence)
    require_monitoring(monitoring)
    setting = EvaluationSpec(
        problem,
        policy,
        filters,
        trust=trust,
        options=options,
        seed=seed,
        knowledge=knowledge,
        objective=objective,
        spec=None,
        learned=learned,
        repeats=1,
    )
    work = Work(progress, len(setting.learning.missing()) + 3 * len(setting.names))
    setting.learn(work.part)
    bridge = BrownianBridge(setting.problem) if monitoring == "continuous" else None
    frozen, sizes = _why_frozen(setting), (particles, repetitions)
    rows, speeds = [], []
    for name in setting.names:
        begun = time.perf_counter()
        make = partial(setting.drifting_env, setting.filters[name][0])
        how = (make, setting.actor, seed, num_envs, bridge)
        row = {"filter": name, "policy": setting.config()["policy"]["name"]}
        row |= (
            _none(frozen)
            if frozen
            else _row(Splitting(*how), Drifting(*how), setting.problem, sizes, confidence, work)
        )
        seconds = time.perf_counter() - begun
        speeds.append(
            {"filter": name, "seconds": seconds, "steps_per_second": row["steps"] / seconds}
        )
        rows.append(row)
    config = {
        **setting.config(),
        "particles": particles,
        "repetitions": repetitions,
        "seed": seed,
        "confidence": confidence,
        "monitoring": monitoring,
    }
    return RareEvaluation(setting.problem, config, rows, {"num_envs": num_envs, "rows": speeds})


def _why_frozen(setting: EvaluationSpec) -> str:
    """Why copies of an episode would all be the same, if so."""
    world, actor = setting.problem, setting.actor
    random = not actor.deterministic if isinstance(actor, Policy) else False
    if random or Integrator(world.plant, world.dt, world.substeps, "arrays").channels:
        return ""
    return (
        "nothing is random after the start, so that copies of an episode go on like it; plain"
        " episodes say all that there is"
    )


def _row(
    splitting: Splitting,
    drifting: Drifting,
    problem: SafetyProblem,
    sizes: tuple[int, int],
    confidence: float,
    work: Work,
) -> Row:
    particles, repetitions = sizes
    power, pilot_steps = splitting.choose(particles, work.part())
    found = splitting.estimate(power, particles, repetitions, work.part())
    last_part = work.part()
    low, high = rate_interval(found.first, found.paths, confidence)
    seen = {
        "violations": found.first,
        "ci_low": low,
        "ci_high": high,
        "outside": found.outside,
        "kept_length": found.kept_length,
    }
    plain = {"episodes": found.paths, **seen}
    rest = {
        "levels": float(found.levels.mean()),
        "steps": found.steps + pilot_steps,
        "plain": plain,
    }
    if found.given_up:
        return _none(_why_none(found, particles, problem, plain)) | rest
    split = _estimate(
        "splitting on h" if power == POWERS[0] else "splitting on h/sqrt(T - t)",
        found.estimates,
        confidence,
    )
    if not found.levels.any():
        split |= {"method": "plain episodes", "ci_low": low, "ci_high": high}
    drift, drift_steps = _by_drift(
        drifting, problem, found, split["relative_error"], sizes, confidence, last_part
    )
    answer, check, doubt = verdict(split, drift, plain)
    p, error = answer["probability"], answer["relative_error"]
    needed = (1.0 - p) / (p * error**2) if error else None
    return {
        "status": "estimated",
        "reason": None,
        **answer,
        "plain_episodes_needed": needed,
        "plain_steps_needed": None if needed is None else needed * found.length,
        "doubt": doubt,
        "check": check,
        **rest,
        "steps": rest["steps"] + drift_steps,
    }


def _by_drift(
    drifting: Drifting,
    problem: SafetyProblem,
    found: Repetitions,
    to_beat: float,
    sizes: tuple[int, int],
    confidence: float,
    progress: Progress | None,
) -> tuple[Row | None, int]:
    """The estimate by importance sampling, if it promises to be much better, and the control
    periods that it took."""
    length, deviation = optimal_tilt(found.girsanov_integrals, found.shares, problem.duration)
    if not _BETTER * deviation / math.sqrt(math.prod(sizes)) < to_beat:
        return None, 0
    try:
        estimates, steps = drifting.estimate(length, *sizes, progress)
    except NumericalError:
        # Pushed far out, where nothing else would take it, a system may leave the finite numbers.
        return None, 0
    return (
        _estimate(f"drift of {length:.3g}/sqrt(s)", estimates, confidence)
        if (estimates > 0.0).all()
        else None
    ), steps


def verdict(split: Row, drift: Row | None, plain: Row) -> tuple[Row, Row | None, str | None]:
    """Which of two estimates is the answer, which the check on it, and what speaks against the
    answer, if anything.

    The drift's is the answer if its relative error is less than half of splitting's and their
    intervals overlap.

    Args:
        split: estimate by splitting.
        drift: by importance sampling, if there is one.
        plain: number of episodes and of violations among them, and the interval, of plain episodes.
    """
    agree = drift is None or _overlap(split, drift)
    if drift is not None and agree and _BETTER * drift["relative_error"] < split["relative_error"]:
        answer, check = drift, split
    else:
        answer, check = split, drift
    if check is not None and not agree:
        told = f"[{check['ci_low']:.2g}, {check['ci_high']:.2g}]"
        return (
            answer,
            check,
            f"importance sampling says {check['probability']:.2g} {told}: take more particles",
        )
    if not _overlap(answer, plain):
        seen = f"{plain['violations']} violations among {plain['episodes']} contradict it"
        return answer, check, f"its first episodes are plain ones, and {seen}: take more particles"
    if float(np.std(np.log(answer["estimates"]))) > _ROUGH:
        return (
            answer,
            check,
            (
                "its repetitions differ by large factors, so that the interval is rough: take more"
                " particles"
            ),
        )
    return answer, check, None


def _overlap(one: Row, other: Row) -> bool:
    return one["ci_low"] <= other["ci_high"] and other["ci_low"] <= one["ci_high"]


def _estimate(method: str, estimates: np.ndarray, confidence: float) -> Row:
    low, high = log_normal_interval(estimates, confidence)
    p = math.fsum(estimates) / len(estimates)
    error = float(np.std(estimates, ddof=1)) / math.sqrt(len(estimates)) / p
    return {
        "method": method,
        "probability": p,
        "ci_low": low,
        "ci_high": min(high, 1.0),
        "relative_error": error,
        "estimates": estimates.tolist(),
    }


def _none(reason: str) -> Row:
    """A row without an estimate."""
    names = (
        "probability",
        "ci_low",
        "ci_high",
        "relative_error",
        "plain_episodes_needed",
        "plain_steps_needed",
        "doubt",
        "check",
    )
    nothing = {"levels": 0.0, "method": None, "steps": 0, "plain": None}
    return {"status": "none", "reason": reason, "estimates": [], **dict.fromkeys(names), **nothing}


def _why_none(found: Repetitions, particles: int, problem: SafetyProblem, plain: Row) -> str:
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
    if not plain["violations"]:
        return reason
    seen = (
        f"{plain['violations']} of the {plain['episodes']} plain episodes at its beginning violated"
    )
    return f"{reason}. But {seen}, which says [{plain['ci_low']:.3g}, {plain['ci_high']:.3g}]"
