"""Points of a safe set: the states to look at, the starts, and draws from the set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.philox import StreamReader, key_of
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.simulation import Simulation
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.verification.search import Region, Score, search

_PERIOD = 2.0 * math.pi
_STARTS = 64
_FIRST_LOG2, _LAST_LOG2 = 12, 18
_FEW = 16


def workspace_of(problem: SafetyProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper ends of the workspace, shape (n,); infinite where it has none."""
    return np.array([v.low for v in problem.states]), np.array([v.high for v in problem.states])


def in_workspace(x: np.ndarray, ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return which states are in a workspace, which the last step of an episode may leave.

    Args:
        x: states, shape (B, n).
        ends: lower and upper ends, shape (n,) each.

    Returns:
        Shape (B,).
    """
    low, high = ends
    return np.all((x >= low) & (x <= high), axis=1)


def region_of(
    problem: SafetyProblem, system: ControlAffineSDE, expressions: Sequence[sp.Expr]
) -> Region:
    """Return the workspace of a problem, with a finite range for what it leaves unbounded.

    Args:
        problem: whose ranges are taken.
        system: whose parameters are in the expressions.
        expressions: all that will be asked of a state: where they repeat after 2 pi, a period is
            enough.
    """
    low, high = workspace_of(problem)
    periodic, chosen = np.zeros(len(low), dtype=bool), np.zeros(len(low), dtype=bool)
    unbounded = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high)))
    for i in unbounded.tolist():
        s = problem.states[i].symbol
        if not (np.isfinite(low[i]) or np.isfinite(high[i])) and all(
            repeats(system.numeric(e), s) for e in expressions
        ):
            periodic[i], low[i], high[i] = True, -_PERIOD / 2.0, _PERIOD / 2.0
            continue
        chosen[i] = True
        starts = draw_starts(problem, _STARTS)[:, i]
        reach = 10.0 * max(float(np.ptp(starts)), float(abs(starts).max()), 1.0)
        low[i] = low[i] if np.isfinite(low[i]) else starts.min() - reach
        high[i] = high[i] if np.isfinite(high[i]) else starts.max() + reach
    notes = []
    if chosen.any():
        ranges = [
            f"{problem.states[i].symbol} in [{low[i]:.4g}, {high[i]:.4g}]"
            for i in np.flatnonzero(chosen).tolist()
        ]
        whose = "its workspace is" if len(ranges) == 1 else "their workspace is"
        notes.append(f"{', '.join(ranges)}, chosen around the starts: {whose} unbounded")
    if periodic.any():
        names = ", ".join(str(problem.states[i].symbol) for i in np.flatnonzero(periodic))
        notes.append(f"{names} over a period of 2 pi, since nothing here tells the periods apart")
    return Region(low, high, periodic, chosen, tuple(notes))


def repeats(expression: Any, s: sp.Symbol) -> bool:
    """Return whether an expression has the period 2 pi in a state, by its form.

    The state has to appear only within sines, cosines and tangents of whole multiples of it. Values
    would not tell: what is constant over some of the states may not be elsewhere.

    Args:
        expression: of the states.
        s: symbol of the state.
    """

    def is_wave(part: Any) -> bool:
        if not isinstance(part, (sp.sin, sp.cos, sp.tan)):
            return False
        slope = sp.diff(part.args[0], s)
        return bool(slope.is_number and float(slope).is_integer())

    return s not in expression.replace(is_wave, lambda _: sp.Integer(1)).free_symbols


def draw_starts(problem: SafetyProblem, count: int, seed: int = 0) -> np.ndarray:
    """Draw initial states of a problem.

    Args:
        problem: whose starts are taken.
        count: number of states.
        seed: of the draws.

    Returns:
        States, shape (count, n).
    """
    starts = Simulation(problem, "floats").starts
    return starts.draw_batch(StreamReader(), [key_of(seed)] * count, range(count)).T


@dataclass(frozen=True)
class PointsOfSet:
    """Points of a set.

    Attributes:
        points: evenly spread over the set, shape (B, n).
        drawn: how many points of a box were tried for them.
        share: part of the whole region that the set is, as found in the first pass.
    """

    points: np.ndarray
    drawn: int
    share: float


def sample(
    what: str, level: Score, region: Region, wanted: int, rng: np.random.Generator
) -> PointsOfSet:
    """Draw points of the set {level >= 0}, in smaller and smaller boxes if the set is small.

    Args:
        what: the set, for the message.
        level: of a state; NaN counts as outside.
        region: where to look.
        wanted: number of points at which the drawing ends.
        rng: of all randomness.

    Returns:
        Points; fewer than wanted where the set is small.

    Raises:
        ConfigurationError: no point of the set was found.
    """
    box, drawn, share = region, 0, None
    found = np.empty((0, len(region.low)))
    for log2 in range(max(_FIRST_LOG2, math.ceil(math.log2(wanted))), _LAST_LOG2 + 1):
        tried = box.draw(log2, rng)
        levels = level(tried)
        inside = tried[levels >= 0.0]
        drawn += len(tried)
        share = len(inside) / len(tried) if share is None else share
        found = inside if box is not region else np.concatenate([found, inside])
        if len(found) >= wanted and (box is region or _covers(box, region, found)):
            return PointsOfSet(found, drawn, share)
        enough = len(found) >= _FEW
        seeds = found if enough else _climbed(level, tried, region, rng)
        if not len(seeds):
            break
        box = region.around(seeds, 1.2 if enough else 4.0)
    if not len(found):
        raise ConfigurationError(
            f"no point of {what} was found among {drawn} of the workspace; is the set empty?"
        )
    return PointsOfSet(found, drawn, share or 0.0)


def _covers(box: Region, region: Region, points: np.ndarray) -> bool:
    """Return whether a box cuts nothing off: points keep away from its ends within the region."""
    width = 0.01 * (box.high - box.low)
    below = (points.min(axis=0) > box.low + width) | (box.low <= region.low)
    above = (points.max(axis=0) < box.high - width) | (box.high >= region.high)
    return bool((below & above).all())


def _climbed(
    level: Score, tried: np.ndarray, region: Region, rng: np.random.Generator
) -> np.ndarray:
    """Return points with level >= 0, found by a search for the largest level."""
    population, values = search(
        level, tried, region, rng, until=lambda values: int(np.count_nonzero(values >= 0.0)) >= _FEW
    )
    return population[values >= 0.0]
