"""How safe any policy can be from an env's starts, and how safe the greedy policy of a table is.

The largest probability of a safe episode lies between the means, over the starts, of a lower and of
an upper envelope, which hold the error of their grid; see `safe_envs.values`. They are
computed in floating point, and certified where the table was checked. The policy that follows the
table is simulated, and its rate must lie between them: where its interval does not meet them, they
are withheld.

To read the table and to look ahead from thousands of starts takes seconds.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.agents.evaluation.bounds import SURE
from safe_envs.agents.evaluation.brownian_bridge import smallest
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
    """Count the episodes of a batch that stay safe to their end, and those that leave while safe.

    Args:
        env: to simulate.
        policy: who acts.
        seeds: of the episodes.
        counts: which of them count.
        tell: called with the part that is done.
    """
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
    policy.prepare(progress and (lambda done: progress(part * done)))
    found = of_table(world, policy.table, policy.look_ahead)
    if not episodes:
        return found, policy
    simulated = simulate(
        policy,
        episodes,
        seed,
        confidence,
        num_envs,
        progress and (lambda done: progress(part + (1.0 - part) * done)),
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
            (state.high, Interval(np.array(state.high), np.array(np.inf)), _below),
            (state.low, Interval(np.array(-np.inf), np.array(state.low)), _above),
        ):
            if math.isinf(bound) or any(inside(extent, bound) for extent in reached):
                continue
            found = values([beyond if j == i else everywhere for j in range(len(symbols))])
            # What is not a number is not known.
            if not any(bool(np.all(h.high <= 0.0)) for h in found):
                return True
    return False


def _below(extent: tuple[float, float], bound: float) -> bool:
    return extent[1] < bound


def _above(extent: tuple[float, float], bound: float) -> bool:
    return extent[0] > bound


def _extents(barrier: Any) -> dict[Any, tuple[float, float]]:
    """Return the range of each state in the ellipsoid where a concave quadratic form is positive.

    With c + b'x - x'Qx = h0 - (x - x0)'Q(x - x0), the range of x_i is x0_i -+ sqrt(h0 (1/Q)_ii).

    Args:
        barrier: any expression.

    Returns:
        Nothing where it is no such form, or nowhere positive.
    """
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
