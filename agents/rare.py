"""How rare violations are, where plain episodes would hardly see one."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.bridge import Bridge, require_monitoring
from agents.drifting import Drifting
from agents.episodes import Progress, Row
from agents.evaluation import package_versions
from agents.policy import Policy
from agents.setting import Setting, Work
from agents.splitting import LEAST, POWERS, Repetitions, Splitting
from agents.statistics import log_normal_interval, rate_interval, require_confidence
from safe_envs.errors import ConfigurationError, NumericalError, require_whole
from safe_envs.integrate import Integrator
from safe_envs.problem import SafetyProblem
from wrappers import FilterSpec
from wrappers.learning import LearnedModel

PARTICLES = 250
REPETITIONS = 20

_ROUGH = 1.5
_FEWEST_PARTICLES = 20


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
        return {"config": self.config, "versions": package_versions(), "rows": self.rows, "timing": self.timing}


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
    spec: FilterSpec | str | None = None,
    learned: Sequence[LearnedModel | Path | str] = (),
    monitoring: str = "discrete",
    progress: Progress | None = None,
) -> RareEvaluation:
    """Estimate the probability of a violation under each filter by splitting on h; see `agents.splitting.Splitting`.

    Where the noise reaches h directly, importance sampling tries too, see `agents.drifting.Drifting`. Its estimate is taken if its
    relative error is less than half of splitting's and the two intervals overlap; splitting's is the check on it then.

    An episode is safe as in `agents.evaluation.evaluate`. The intervals are those of independent repetitions; see
    `agents.statistics.log_normal_interval`. Where splitting cannot work a row has the reason in place of numbers.

    Args:
        problem: as for `evaluate`, but no env of somebody else, which cannot be put back to where it was.
        policy: as for `evaluate`, without memory.
        filters: as for `evaluate`.
        trust: as for `evaluate`.
        options: as for `evaluate`.
        particles: episodes of a repetition.
        repetitions: independent ones, at least 5.
        seed: of all randomness.
        num_envs: the most episodes side by side; another number is another draw of the same estimate.
        knowledge: as for `evaluate`.
        objective: as for `evaluate`.
        confidence: of all intervals, between 0 and 1.
        spec: refused.
        learned: as for `evaluate`; what is missing is learned once.
        monitoring: as for `evaluate`.
        progress: told the part of the work that is done, from 0 to 1.

    Raises:
        ConfigurationError: an argument names something unknown or is out of range, or the env or the policy cannot be split.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.
    """
    for name, value, least in (("particles", particles, _FEWEST_PARTICLES), ("repetitions", repetitions, 5), ("num_envs", num_envs, 1)):
        require_whole(name, value, least)
    require_confidence(confidence)
    require_monitoring(monitoring)
    if spec is not None:
        raise ConfigurationError("an env of somebody else cannot be put back to where it was: estimate its safety with plain episodes")
    setting = Setting(
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
    work = Work(progress, len(setting.learning.missing()) + 2 * len(setting.names))
    setting.learn(work.part)
    bridge = Bridge(setting.problem) if monitoring == "continuous" else None
    frozen, sizes = _is_frozen(setting), (particles, repetitions)
    rows, speeds = [], []
    for name in setting.names:
        begun = time.perf_counter()
        conditions = setting.filters[name][0]
        splitting = Splitting(lambda size, c=conditions: setting.env(c, size), setting.actor, seed, num_envs, bridge)
        drifting = Drifting(lambda lengths, c=conditions: setting.drifting_env(c, lengths), setting.actor, seed, num_envs, bridge)
        row = {"filter": name, "policy": setting.config()["policy"]["name"]}
        row |= _none(frozen) if frozen else _row(splitting, drifting, setting.problem, sizes, confidence, work)
        seconds = time.perf_counter() - begun
        speeds.append({"filter": name, "seconds": seconds, "steps_per_second": row["steps"] / seconds})
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


def _is_frozen(setting: Setting) -> str:
    """Why copies of an episode would all be the same, if so."""
    world, actor = setting.problem, setting.actor
    random = not actor.deterministic if isinstance(actor, Policy) else False
    if random or Integrator(world.plant, world.dt, world.substeps, "arrays").channels:
        return ""
    return "nothing is random after the start, so that copies of an episode go on like it; plain episodes say all that there is"


def _row(splitting: Splitting, drifting: Drifting, problem: SafetyProblem, sizes: tuple[int, int], confidence: float, work: Work) -> Row:
    particles, repetitions = sizes
    power, pilot_steps = splitting.choose(particles, work.part())
    found = splitting.estimate(power, particles, repetitions, work.part())
    low, high = rate_interval(found.first, found.paths, confidence)
    plain = {"episodes": found.paths, "violations": found.first, "ci_low": low, "ci_high": high}
    rest = {"levels": float(found.levels.mean()), "steps": found.steps + pilot_steps, "plain": plain}
    if found.given_up:
        return _none(_why_none(found, particles)) | rest
    # Without a level they are plain episodes, and nothing else.
    interval = log_normal_interval(found.estimates, confidence) if found.levels.any() else (low, high)
    answer = _estimate("splitting on h" if power == POWERS[0] else "splitting on h/sqrt(T - t)", found.estimates, interval)
    check, drift_steps = None, 0
    if found.levels.any():
        check, drift_steps = _by_drift(drifting, problem, sizes, confidence)
    doubt = _doubt(found, interval, (low, high))
    if check is not None and 2.0 * check["relative_error"] < answer["relative_error"]:
        if check["ci_low"] <= answer["ci_high"] and answer["ci_low"] <= check["ci_high"]:
            answer, check, doubt = check, answer, None
        else:
            doubt = f"importance sampling says {check['probability']:.2g} [{check['ci_low']:.2g}, {check['ci_high']:.2g}]"
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


def _by_drift(drifting: Drifting, problem: SafetyProblem, sizes: tuple[int, int], confidence: float) -> tuple[Row | None, int]:
    """The estimate by importance sampling, if there is one, and the control periods that it took."""
    if not any(Bridge(problem).reached):
        return None, 0
    try:
        length, steps = drifting.choose(problem.steps * problem.dt)
        if length is None:
            return None, steps
        estimates, more = drifting.estimate(length, *sizes)
    except NumericalError:
        # Pushed far out, where nothing else would take it, a system may leave the finite numbers.
        return None, 0
    if not (estimates > 0.0).all():
        return None, steps + more
    return _estimate(f"drift of {length:.3g}/sqrt(s)", estimates, log_normal_interval(estimates, confidence)), steps + more


def _estimate(method: str, estimates: np.ndarray, interval: tuple[float, float]) -> Row:
    p = math.fsum(estimates) / len(estimates)
    error = float(np.std(estimates, ddof=1)) / math.sqrt(len(estimates)) / p
    return {
        "method": method,
        "probability": p,
        "ci_low": interval[0],
        "ci_high": min(interval[1], 1.0),
        "relative_error": error,
        "estimates": estimates.tolist(),
    }


def _none(reason: str) -> Row:
    """A row without an estimate."""
    names = ("probability", "ci_low", "ci_high", "relative_error", "plain_episodes_needed", "plain_steps_needed", "doubt", "check")
    nothing = {"levels": 0.0, "method": None, "steps": 0, "plain": None}
    return {"status": "none", "reason": reason, "estimates": [], **dict.fromkeys(names), **nothing}


def _why_none(found: Repetitions, particles: int) -> str:
    repetitions = len(found.estimates)
    if found.stuck:
        return (
            f"in {len(found.stuck)} of {repetitions} repetitions all {particles} particles stood at one level and none came below "
            f"h = {min(found.stuck):.3g}. There h may be flat, jump or never fall, or those that come lower are too few: more particles "
            "or a smaller dt may help"
        )
    return (
        f"in {len(found.endless)} of {repetitions} repetitions the probability to come below h = {min(found.endless):.3g} is less than "
        f"{LEAST:g} already; h = 0 may never be reached"
    )


def _doubt(found: Repetitions, interval: tuple[float, float], plain: tuple[float, float]) -> str | None:
    """What speaks against an estimate, if anything."""
    if interval[1] < plain[0] or plain[1] < interval[0]:
        return f"its first episodes are plain ones, and {found.first} violations among {found.paths} contradict it: take more particles"
    if float(np.std(np.log(found.estimates))) > _ROUGH:
        return "its repetitions differ by large factors, so that the interval is rough: take more particles"
    return None
