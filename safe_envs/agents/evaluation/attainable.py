"""How safe any policy can be from an env's starts, and how safe the greedy policy of a table is.

The largest probability of a safe episode lies between the means, over the starts, of a lower and of
an upper envelope, which hold the error of their grid; see `safe_envs.values`. They are
computed in floating point, and certified where the table was checked. The policy that follows the
table is simulated, and its rate must lie between them: where its interval does not meet them, they
are withheld.

To read the table and to look ahead from thousands of starts takes seconds.

The rows of an evaluation are measured by it. Of every policy's episodes at least the share r is
violated, where 1 - r is the best attainable safety. It is not known exactly, only that
1 - upper <= r <= 1 - lower, nor is the share v of violations under a filter, only its interval
1 - ci_high <= v <= 1 - ci_low. So v/r is given as an interval,

    (1 - ci_high)/(1 - lower) <= v/r <= (1 - ci_low)/(1 - upper),

whose ends are as sure as those of the rate's interval and of the envelopes together. No policy is
below 1, where the lower end is cut off. Where upper is 1 no violation is shown to be unavoidable,
and there is no upper end; where lower is 1 too, none is unavoidable, and the number means nothing.

A violation has to mean the same to both: the table counts leaving the workspace in the safe set as
the evaluation does, as the end of a safe episode, or the two countings are the same because no
state outside the workspace is in the safe set.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.agents.evaluation.bounds import SURE, Bounded, above_attainable, without_held
from safe_envs.agents.evaluation.brownian_bridge import smallest
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import (
    exact_interval,
    percent_in,
    rate_interval,
    require_confidence,
)
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.noise import episode_seeds
from safe_envs.enclosures.intervals import Interval, interval_function
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.files import cache_folder, make_room, mark_used, read_json, write_atomically
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import number_at_least, number_at_most
from safe_envs.values.look_ahead import LookAhead, start_values
from safe_envs.values.proved import ProvedStarts, TableCheck, check_table
from safe_envs.values.reduction import reduced
from safe_envs.values.solve import table_key
from safe_envs.values.tables import ValueSettings, ValueTable
from safe_envs.wrappers.specification import SpecificationMonitorVector


@dataclass(frozen=True)
class SimulatedRate:
    """The safety rate of the greedy policy of a table.

    Attributes:
        rate: share of safe episodes, or of those that meet the specification of the table, with
            leaving counted as the table does.
        low: lower end of its interval.
        high: upper end.
        leave_rate: share of the episodes that left the workspace in the safe set.
        safe: number of safe episodes.
        episodes: how many were simulated.
        seed: of the simulation; they are the episodes that `evaluate` has with it.
        confidence: of the interval.
    """

    rate: float
    low: float
    high: float
    leave_rate: float
    safe: int
    episodes: int
    seed: int
    confidence: float


def simulate(
    policy: BestPolicy,
    episodes: int,
    seed: int,
    confidence: float,
    num_envs: int,
    progress: Progress | None = None,
) -> SimulatedRate:
    """Simulate the greedy policy of a table in its world.

    Args:
        policy: to simulate.
        episodes: how many.
        seed: from which each episode gets its own, as in `evaluate`.
        confidence: of the interval.
        num_envs: episodes side by side.
        progress: called with the part that is done, from 0 to 1.

    Returns:
        The rate, with leaving counted as the table does.
    """
    env = SafeVectorEnv(policy.problem, min(num_envs, episodes))
    safe = left = 0
    for first in range(0, episodes, env.num_envs):
        count = min(env.num_envs, episodes - first)

        def tell(part: float, first: int = first, count: int = count) -> None:
            if progress:
                progress((first + count * part) / episodes)

        seeds = episode_seeds(seed, range(first, first + env.num_envs))
        play = _judge if policy.settings.specification else _play
        of_batch = play(env, policy, seeds, np.arange(env.num_envs) < count, tell)
        safe, left = safe + of_batch[0], left + of_batch[1]
    env.close()
    if policy.settings.leaving == "safe":
        safe += left
    low, high = rate_interval(safe, episodes, confidence)
    return SimulatedRate(
        safe / episodes, low, high, left / episodes, safe, episodes, seed, confidence
    )


def _play(
    env: SafeVectorEnv, policy: BestPolicy, seeds: list[int], counts: np.ndarray, tell: Progress
) -> tuple[int, int]:
    """Count the episodes of a batch that stay safe to their end, and that leave while safe."""
    plant, problem = env.problem.plant, env.problem
    outside = compile_function(plant.states, (plant.numeric(problem.outside),), "arrays")
    observation, info = env.reset(seed=seeds)
    safe = counts & (smallest(info["barrier"]) > 0.0)
    alive, left = counts.copy(), np.zeros_like(counts)
    state, start = None, np.ones_like(counts)
    for k in range(1, problem.steps + 1):
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, info = env.step(actions)
        safe &= (smallest(info["barrier"]) > 0.0) | ~alive
        left |= alive & safe & (outside(*env.components)[0] > 0.0)
        start = terminated | truncated
        alive &= ~start
        tell(k / problem.steps)
        # What follows a violation changes none of the counts.
        if not (alive & safe).any():
            break
    return int(np.count_nonzero(safe & ~left)), int(np.count_nonzero(left))


def _judge(
    env: SafeVectorEnv, policy: BestPolicy, seeds: list[int], counts: np.ndarray, tell: Progress
) -> tuple[int, int]:
    """Count the episodes of a batch that meet a specification: in the workspace, and outside."""
    plant, problem = env.problem.plant, env.problem
    outside = compile_function(plant.states, (plant.numeric(problem.outside),), "arrays")
    monitor = SpecificationMonitorVector(env, policy.settings.specification)
    observation, info = monitor.reset(seed=seeds)
    alive, met, left = counts.copy(), 0, 0
    state, start, settled = None, np.ones_like(counts), info["verdict"] > 0
    for k in range(1, problem.steps + 1):
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, info = monitor.step(actions)
        start = terminated | truncated
        over = alive & start & info["satisfied"]
        lost = over & ~settled & (outside(*env.components)[0] > 0.0)
        met, left = met + np.count_nonzero(over & ~lost), left + np.count_nonzero(lost)
        settled, alive = info["verdict"] > 0, alive & ~start
        tell(k / problem.steps)
        if not alive.any():
            break
    return int(met), int(left)


_TABLE_WORK = 0.8
"""Part of the work that is the table's, for the progress."""


@dataclass(frozen=True)
class AttainableSafety:
    """How safe any policy can be, from the starts of an env.

    Attributes:
        lower: bound of the largest probability of a safe episode from below, the mean over the
            starts; None where it is withheld.
        upper: the bound from above; None where it is withheld.
        simulated: rate of the greedy policy; None where it was not simulated.
        contradiction: why the bounds are withheld; "" where they are not.
        knowledge: whose step is taken, that of the "plant" or of the "model".
        leaving: how an episode counts that leaves the workspace in the safe set, as a "violation"
            or as "safe".
        specification: that an episode is to meet; "" for staying safe.
        coordinates: of the grid, expressions of the states.
        cells: of the grid along each coordinate.
        inputs: number of inputs that are scanned.
        steps: control periods of an episode.
        seconds: that the table took when it was computed.
        memory: of the table in bytes.
        check: of the table, whose result is in both ends; None where they are only computed.
    """

    lower: float | None
    upper: float | None
    simulated: SimulatedRate | None
    contradiction: str
    knowledge: str
    leaving: str
    specification: str
    coordinates: tuple[str, ...]
    cells: tuple[int, ...]
    inputs: int
    steps: int
    seconds: float
    memory: int
    check: TableCheck | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data; the rate of the greedy policy is a number, or null."""
        found = {**vars(self), "contradiction": self.contradiction or None}
        found |= {name: list(found[name]) for name in ("coordinates", "cells")}
        s = self.simulated
        found["check"] = self.check and vars(self.check)
        return found | {
            "simulated": s and s.rate,
            "simulated_interval": s and [s.low, s.high],
            "simulated_confidence": s and s.confidence,
            "leave_rate": s and s.leave_rate,
            "episodes": s and s.episodes,
            "seed": s and s.seed,
        }


def attainable_safety(
    problem: SafetyProblem,
    settings: ValueSettings,
    *,
    episodes: int = 1000,
    seed: int = 0,
    confidence: float = 0.95,
    num_envs: int = 1024,
    file: Path | None = None,
    progress: Progress | None = None,
) -> tuple[AttainableSafety, BestPolicy]:
    """Compute how safe any policy can be from a problem's starts.

    With the knowledge "model" it is the world of the model that is looked at, and simulated.

    Args:
        problem: with the starts.
        settings: of the table.
        episodes: of the simulation of the greedy policy; 0 for none.
        seed: of the simulation.
        confidence: of the interval of its rate.
        num_envs: episodes side by side.
        file: of the table, read or written, in place of the cache.
        progress: called with the part of the work that is done, from 0 to 1.

    Returns:
        What was found, and the greedy policy with its table.

    Raises:
        ConfigurationError: A number is out of range, or there is no table of the problem.
    """
    require_whole("episodes", episodes, 0)
    require_confidence(confidence)
    # A value is that of the true state, whatever is measured of it.
    problem = problem.unmeasured
    world = problem if settings.knowledge == "plant" else replace(problem, plant=problem.model)
    policy = BestPolicy(world, settings, file)
    part = _TABLE_WORK if episodes else 1.0
    policy.prepare(progress_of_part(progress, 0.0, part))
    found = of_table(world, policy.table, policy.look_ahead)
    if not episodes:
        return found, policy
    simulated = simulate(
        policy,
        episodes,
        seed,
        confidence,
        num_envs,
        progress_of_part(progress, part, 1.0 - part),
    )
    return judged(replace(found, simulated=simulated)), policy


def of_table(problem: SafetyProblem, table: ValueTable, look_ahead: LookAhead) -> AttainableSafety:
    """Return what a table says of a problem's starts, without a simulation.

    Args:
        problem: with the starts.
        table: of the problem.
        look_ahead: of the table.
    """
    settings = table.settings
    values = start_values(look_ahead, problem)
    coordinates = reduced(
        problem, settings.knowledge, settings.intervals, settings.specification
    ).coordinates
    return AttainableSafety(
        lower=values.lower,
        upper=values.upper,
        simulated=None,
        contradiction="",
        knowledge=settings.knowledge,
        leaving=settings.leaving,
        specification=settings.specification,
        coordinates=tuple(str(c.expression) for c in coordinates),
        cells=tuple(table.grid.shape),
        inputs=len(table.inputs),
        steps=table.steps,
        seconds=table.seconds,
        memory=table.memory,
    )


def certified(
    found: AttainableSafety, policy: BestPolicy, progress: Progress | None = None
) -> AttainableSafety:
    """Return what was found with certified ends in place of computed ones.

    The upper end is computed still where `check.upper` is None.

    Args:
        found: with bounds; without any it is returned as it is.
        policy: with the table.
        progress: called with the part of the work that is done, from 0 to 1.

    Raises:
        TableRefusedError: The table is no envelope.
        ConfigurationError: Such tables are not checked.
    """
    if found.lower is None or found.upper is None:
        return found
    table, problem, look_ahead = policy.table, policy.problem, policy.look_ahead
    check = check_table(table, problem, progress=progress)
    starts = ProvedStarts(table, problem, check, look_ahead)
    values = start_values(starts, problem, most=starts.most_starts)
    upper = found.upper if check.upper is None else values.upper
    return judged(replace(found, lower=values.lower, upper=upper, check=check))


def judged(found: AttainableSafety) -> AttainableSafety:
    """Return what was found, without bounds that the rate of the greedy policy contradicts."""
    s = found.simulated
    if s is None or found.lower is None or found.upper is None:
        return found
    low, high = exact_interval(s.safe, s.episodes, SURE)
    where = (
        f"above the upper bound {number_at_most(found.upper, 6)}"
        if low > found.upper
        else f"below the lower bound {number_at_least(found.lower, 6)}"
        if high < found.lower
        else ""
    )
    if not where:
        return found
    told = f"{percent_in(s.rate, low, high)} of {s.episodes} episodes ({100 * SURE:g} % interval)"
    return withheld(found, f"the greedy policy is safe in {told}, which is {where}")


def contradicted(
    found: AttainableSafety, rates: Sequence[tuple[str, int, int]]
) -> AttainableSafety:
    """Return what was found, without bounds that a measured rate exceeds.

    Args:
        found: with bounds, or without.
        rates: name, safe episodes and episodes of each rate, counted as the table does.
    """
    if found.upper is None:
        return found
    for name, safe, episodes in rates:
        low, high = exact_interval(safe, episodes, SURE)
        if low > found.upper:
            told = f"{percent_in(safe / episodes, low, high)} ({100 * SURE:g} % interval)"
            most = number_at_most(found.upper, 6)
            reason = f"{name} is safe in {told}, above the upper bound {most}"
            return withheld(found, reason)
    return found


def withheld(found: AttainableSafety, reason: str) -> AttainableSafety:
    """Return what was found without its bounds.

    Args:
        found: with bounds.
        reason: how they are contradicted.
    """
    return replace(found, lower=None, upper=None, contradiction=reason)


FOLDER = "attainable"
"""Name of the folder in the user's cache."""


def place_of(problem: SafetyProblem, settings: ValueSettings) -> Path | None:
    """Return the file for what is attainable; None without a cache.

    Args:
        problem: with the starts.
        settings: of the table.

    Raises:
        ConfigurationError: No grid takes the problem.
    """
    folder = cache_folder(FOLDER)
    if folder is None:
        return None
    start = problem.starts[problem.start]
    condition = None if start.condition is None else problem.model.numeric(start.condition)
    parts = (*start.state, *start.uniforms, *problem.model.states, sp.sympify(condition or 0))
    described = [table_key(problem, settings), [sp.srepr(sp.sympify(each)) for each in parts]]
    digest = hashlib.sha256(json.dumps(described).encode()).hexdigest()
    return folder / f"{digest}.json"


def kept_attainable(place: Path | None) -> AttainableSafety | None:
    """Return what is kept in a file; None where there is none, or none to rely on."""
    if place is None or not place.is_file():
        return None
    try:
        found = AttainableSafety(**read_json(place, "remove it"))
        found = replace(
            found, coordinates=tuple(found.coordinates), cells=tuple(map(int, found.cells))
        )
        ends = [0.0, *(end for end in (found.lower, found.upper) if end is not None), 1.0]
        if ends != sorted(ends):
            return None
    except (ConfigurationError, TypeError, ValueError):
        return None
    mark_used(place)
    return found


def keep_attainable(found: AttainableSafety, place: Path | None) -> None:
    """Keep what is attainable, before anything was measured, in a file.

    Args:
        found: with both ends.
        place: of the file; None keeps nothing.
    """
    if place is None:
        return
    text = json.dumps(vars(found))
    try:
        write_atomically(place, lambda path: path.write_text(text))
    except (ConfigurationError, OSError):  # The disk may be full.
        return
    make_room()


_MARGIN = 1e-9
"""Of the size of numbers, for their rounding."""


def leaves_safely(problem: SafetyProblem) -> bool:
    """Return whether a state outside the workspace may be in the safe set.

    False is certain: beyond each bound of a state some barrier is not positive, by interval
    arithmetic, or because it is a concave quadratic form, which is positive in an ellipsoid only.

    Args:
        problem: with the barriers and the workspace.
    """
    barriers = [problem.plant.numeric(barrier.expression) for barrier in problem.barriers]
    symbols = [state.symbol for state in problem.states]
    values = interval_function(symbols, barriers)
    everywhere = Interval(np.array(-np.inf), np.array(np.inf))
    extents = [_extents(barrier) for barrier in barriers]
    for i, state in enumerate(problem.states):
        reached = [extent[state.symbol] for extent in extents if state.symbol in extent]
        for bound, beyond, inside in (
            (state.high, Interval(np.array(state.high), np.array(np.inf)), lambda e, b: e[1] < b),
            (state.low, Interval(np.array(-np.inf), np.array(state.low)), lambda e, b: e[0] > b),
        ):
            if math.isinf(bound) or any(inside(extent, bound) for extent in reached):
                continue
            found = values([beyond if j == i else everywhere for j in range(len(symbols))])
            # What is not a number is not known.
            if not any(bool(np.all(h.high <= 0.0)) for h in found):
                return True
    return False


def _extents(barrier: Any) -> dict[Any, tuple[float, float]]:
    """Return the range of each state where a concave quadratic form is positive."""
    # With c + b'x - x'Qx = h0 - (x - x0)'Q(x - x0), the range of x_i is x0_i -+ sqrt(h0 (1/Q)_ii).
    symbols: list[Any] = sorted(barrier.free_symbols, key=str)
    if not symbols or not barrier.is_polynomial(*symbols):
        return {}
    form = sp.Poly(barrier, *symbols)
    if form.total_degree() != 2:
        return {}
    curvature = -np.array(sp.hessian(barrier, symbols), dtype=float) / 2.0
    if np.linalg.eigvalsh(curvature).min() <= _MARGIN * abs(curvature).max():
        return {}
    at_zero = dict.fromkeys(symbols, 0)
    slope = np.array([float(barrier.diff(s).subs(at_zero)) for s in symbols])
    center = np.linalg.solve(curvature, slope) / 2.0
    top = float(barrier.subs(at_zero)) + float(slope @ center) / 2.0
    if top <= 0.0:
        return {}
    half = np.sqrt(top * np.diag(np.linalg.inv(curvature)))
    half += _MARGIN * (half + abs(center))
    return {
        s: (c - d, c + d) for s, c, d in zip(symbols, center.tolist(), half.tolist(), strict=True)
    }


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


def progress_of_part(progress: Progress | None, before: float, size: float) -> Progress | None:
    """Return the progress of a part of some work.

    Args:
        progress: of the whole, called with the part that is done, from 0 to 1.
        before: the part of the whole that is done before.
        size: of the part.
    """
    return progress and (lambda done: progress(before + size * done))


class WorkParts:
    """The progress of a number of equal parts of some work, one after the other.

    Args:
        progress: called with the part of the whole work that is done, from 0 to 1.
        parts: how many there are.
    """

    def __init__(self, progress: Progress | None, parts: int) -> None:
        self._progress, self._parts, self._begun = progress, parts, 0

    def part(self, whole: float = 1.0) -> Progress | None:
        """Return the progress of the next part, to be called with how much of `whole` is done."""
        before, self._begun = self._begun, self._begun + 1
        report = self._progress
        return (
            None if report is None else lambda done: report((before + done / whole) / self._parts)
        )
