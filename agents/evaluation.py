"""How safe a policy is, bare and under filters: the same episodes for every filter, batched."""

from __future__ import annotations

import hashlib
import platform
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from agents.comparison import Comparison, Flags, compare_all
from agents.episodes import Env, Progress, Recorder, Row, Totals, run_episodes
from agents.policy import POLICIES, Policy, make_policy
from agents.problems import full_id, load_problem
from agents.statistics import RunningSum, require_confidence, share
from safe_envs.codegen import Components
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, require_whole
from safe_envs.integrate import Integrator
from safe_envs.problem import SafetyProblem
from safe_envs.vector import SafeVectorEnv
from wrappers import CONDITIONS, SafetyFilterVectorWrapper, parse_conditions, spec_of
from wrappers.proved import proved_bound

BARE = "none"
"""Name of the row without any filter."""

_PACKAGES = ("safe-envs", "gymnasium", "numpy", "scipy", "sympy", "proxsuite", "stable-baselines3", "torch")


@dataclass(frozen=True)
class Evaluation:
    """The answer of `evaluate`.

    Attributes:
        problem: what was simulated.
        config: everything needed to run it again, as JSON.
        rows: statistics, one row for each filter.
        comparisons: of every two rows, by which of the same episodes were safe.
        timing: the only part that depends on the machine and on `num_envs`.
        recorders: trajectories for each filter, if asked for.
        flags: which episodes were safe, for each filter.
        repeats: whether nothing is random, so that all episodes are one and the same.
    """

    problem: SafetyProblem
    config: dict[str, Any]
    rows: list[Row]
    comparisons: list[Comparison]
    timing: dict[str, Any]
    recorders: dict[str, Recorder]
    flags: dict[str, Flags]
    repeats: bool

    def document(self) -> dict[str, Any]:
        """The whole as JSON-able data."""
        return {
            "config": self.config,
            "versions": _versions(),
            "rows": self.rows,
            "comparisons": self.comparisons,
            "timing": self.timing,
        }


def evaluate(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    filters: Sequence[str] | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    episodes: int = 1000,
    seed: int = 0,
    num_envs: int = 1024,
    knowledge: str = "model",
    objective: str = "nearest",
    confidence: float = 0.95,
    bounds: bool = True,
    progress: Progress | None = None,
    record: bool = False,
) -> Evaluation:
    """Estimate the safety of a policy under each filter.

    An episode is safe if every barrier is positive at every control instant, its start included. After its first
    violation an episode's interventions, infeasible steps and effort are no longer counted: the conditions mean
    nothing outside the safe set. Its simulation goes on, and its return and smallest h are of the whole episode.

    Beside the rate stands the largest bound that is proved for the filter, on average over the starts: see
    `wrappers.bounds`. It is of continuous time and rests on suprema that are estimated.

    Episode i is seeded by its own child of `seed`, the same for all filters; all but `timing` is the same, to the
    last bit, for every `num_envs`.

    Args:
        problem: what to simulate, or the id of a registered env.
        policy: a name or a path for `make_policy`, or anything with Stable-Baselines3's `predict`.
        filters: texts for `parse_conditions`, and "none" for the bare env; by default that and the problem's own.
        options: arguments of `gym.make` for an id.
        episodes: number for each filter.
        seed: whole number from 0.
        num_envs: how many episodes to simulate side by side.
        knowledge: what the filters know, "model" or "plant".
        objective: of the filters, "nearest" to the policy's action or "clf": see `SafetyFilter.for_problem`.
        confidence: of all intervals, between 0 and 1.
        bounds: look for proved bounds, which takes a search of the safe set for each filter.
        progress: told the part of the work that is done, from 0 to 1.
        record: keep trajectories for pictures.

    Raises:
        ConfigurationError: an argument names something unknown or is out of range.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("num_envs", num_envs, 1)):
        require_whole(name, value, least)
    for name, value, allowed in (("knowledge", knowledge, ("model", "plant")), ("objective", objective, ("nearest", "clf"))):
        if value not in allowed:
            raise ConfigurationError(f"{name} = {value!r}; {nearest(value, allowed)}")
    require_confidence(confidence)
    env_id = full_id(problem) if isinstance(problem, str) else None
    if env_id is None and options:
        raise ConfigurationError("options are the arguments of a registered id; configure the problem itself instead")
    world = problem if isinstance(problem, SafetyProblem) else load_problem(problem, options)
    actor = make_policy(policy, world) if isinstance(policy, str) else policy
    names = list(dict.fromkeys((BARE, world.filter) if filters is None else filters))
    specs = [_spec(name, world) for name in names]
    envs = [_make_env(world, spec, knowledge, objective, min(num_envs, episodes)) for spec in specs]
    config = {
        "env_id": env_id,
        "options": {k: v for k, v in (options or {}).items() if v is not None},
        "problem": _describe(world),
        "policy": _describe_policy(policy),
        "filters": [{"name": name, "spec": spec} for name, spec in zip(names, specs, strict=True)],
        "knowledge": knowledge,
        "objective": objective,
        "episodes": episodes,
        "seed": seed,
        "confidence": confidence,
    }
    rows, speeds, flags = [], [], {}
    recorders = {name: Recorder(world.steps, world.plant.n, episodes) for name in names} if record else {}
    for i, (name, env) in enumerate(zip(names, envs, strict=True)):
        told = None if progress is None else _part_of(progress, i, len(names), episodes)
        promised = _Promise(name, world, knowledge, bounds)
        begun = time.perf_counter()
        totals = run_episodes(env, actor, episodes, seed, told, recorders.get(name), promised.add)
        speeds.append(_speed(name, totals, time.perf_counter() - begun))
        rows.append({"filter": name, "policy": config["policy"]["name"], **totals.row(confidence), **promised.row()})
        flags[name] = totals.flags
    timing = {"num_envs": num_envs, "rows": speeds}
    comparisons = compare_all(flags, confidence)
    return Evaluation(world, config, rows, comparisons, timing, recorders, flags, _is_deterministic(world, actor))


class _Promise:
    """The proved bound on P(safe up to the horizon) of a filter, averaged over the starts of the episodes."""

    def __init__(self, name: str, problem: SafetyProblem, knowledge: str, asked: bool) -> None:
        self._horizon = problem.steps * problem.dt
        self._bound, self._why_none = None, "there is no filter" if name == BARE else "it was not asked for"
        self._total, self._count = RunningSum(), 0
        if name != BARE and asked:
            try:
                self._bound = proved_bound(problem, parse_conditions(name, problem), knowledge)
                self._why_none = self._bound.note
            except SafeEnvsError as error:
                # The bound looks at the whole safe set, where the episodes may never be.
                self._why_none = str(error)

    def add(self, start: Components, count: int) -> None:
        """Take the starts of a wave."""
        if self._bound is not None and not self._why_none:
            self._total.add(self._bound.at(np.stack(start, axis=1)[:count], self._horizon))
            self._count += count

    def row(self) -> Row:
        """The mean bound, None where there is none, and why there is none or why it is weak."""
        if self._bound is None or self._why_none:
            return {"bound": None, "bound_note": self._why_none}
        mean = share(self._total.total, self._count)
        if not mean:
            return {"bound": None, "bound_note": self._bound.remark or "it is 0 at these starts up to this horizon"}
        return {"bound": mean, "bound_note": self._bound.remark}


def _part_of(progress: Progress, before: int, parts: int, episodes: int) -> Progress:
    """From episodes done in one of several parts to the share of the whole that is done."""
    return lambda done: progress((before + done / episodes) / parts)


def _speed(name: str, totals: Totals, seconds: float) -> dict[str, Any]:
    return {"filter": name, "seconds": seconds, "steps": totals.steps, "steps_per_second": totals.steps / seconds}


def _spec(name: str, problem: SafetyProblem) -> str:
    """The text of a filter with all its parameters."""
    if name == BARE:
        return BARE
    if BARE in name.split("+"):
        raise ConfigurationError(f"filter {name!r}: {BARE!r} is the bare env and no condition of a barrier; give it alone or leave it out")
    if re.split("[:+]", name)[0] not in CONDITIONS:
        raise ConfigurationError(f"unknown filter {name!r}; {nearest(name, (BARE, *CONDITIONS))}")
    return spec_of(parse_conditions(name, problem))


def _make_env(problem: SafetyProblem, spec: str, knowledge: str, objective: str, num_envs: int) -> Env:
    env = SafeVectorEnv(problem, num_envs)
    if spec == BARE:
        filtered: Env = env
    else:
        filtered = SafetyFilterVectorWrapper(env, spec, knowledge, objective)
    # The first step compiles what the filter needs: an error shows before a long run, and the timing is of steps.
    filtered.reset(seed=0)
    filtered.step(np.zeros(env.action_space.shape or ()))
    return filtered


def _is_deterministic(problem: SafetyProblem, policy: Any) -> bool:
    noise = Integrator(problem.plant, problem.dt, problem.substeps, "arrays").channels
    acts_alike = policy.deterministic if isinstance(policy, Policy) else True
    return acts_alike and not noise and not problem.starts[problem.start].uniforms


def _describe(problem: SafetyProblem) -> dict[str, Any]:
    return {
        "name": problem.name,
        "plant": {p.name: v for p, v in problem.plant.parameters.items()},
        "model": {p.name: v for p, v in problem.model.parameters.items()},
        "barriers": [str(b.expression) for b in problem.barriers],
        "box": [[float(low), float(high)] for low, high in problem.box],
        "start": problem.start,
        "dt": problem.dt,
        "substeps": problem.substeps,
        "horizon": problem.horizon,
    }


def _describe_policy(policy: Any) -> dict[str, Any]:
    if not isinstance(policy, str):
        return {"name": type(policy).__name__}
    if policy in POLICIES:
        return {"name": policy}
    return {"name": policy, "sha256": hashlib.sha256(Path(policy).read_bytes()).hexdigest()}


def _versions() -> dict[str, str]:
    return {"python": platform.python_version(), **{package: version(package) for package in _PACKAGES}}
