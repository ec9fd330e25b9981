"""Points of a safe set: quasi-random draws from a box, and the search for the points where a function is largest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.calculus import vanishes
from safe_envs.errors import ConfigurationError
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from safe_envs.simulation import Simulation

Score = Callable[[np.ndarray], np.ndarray]
"""From states (B, n) to numbers (B,)."""

_PERIOD = 2.0 * math.pi
_STARTS = 64
_ROUNDS = 240
_CONVERGED = 1e-13
_FINEST = -10.0
_POPULATION = 96
_FIRST_LOG2, _LAST_LOG2 = 12, 18
_FEW = 16


@dataclass(frozen=True)
class Region:
    """A box of states.

    Attributes:
        low: lower ends, shape (n,).
        high: upper ends, shape (n,).
        periodic: the states of which the box holds a whole period, shape (n,).
        notes: which of the ranges are not the workspace, in words.
    """

    low: np.ndarray
    high: np.ndarray
    periodic: np.ndarray
    notes: tuple[str, ...] = ()

    def scaled(self, factor: float) -> Region:
        """The box that is larger by a factor about the same centre; a period stays one."""
        half = np.where(self.periodic, 1.0, factor) * (self.high - self.low) / 2.0
        center = (self.high + self.low) / 2.0
        return replace(self, low=center - half, high=center + half)

    def around(self, points: np.ndarray, widened: float) -> Region:
        """The part of the box around points, wider than they are by a factor."""
        low, high = points.min(axis=0), points.max(axis=0)
        more = (widened - 1.0) * (high - low) / 2.0 + 1e-6 * (self.high - self.low)
        return replace(self, low=np.maximum(self.low, low - more), high=np.minimum(self.high, high + more))

    def inside(self, x: np.ndarray) -> np.ndarray:
        """States (B, n) moved into the box: by whole periods, and to its nearest end."""
        wrapped = self.low + (x - self.low) % (self.high - self.low)
        return np.where(self.periodic, wrapped, np.clip(x, self.low, self.high))

    def draw(self, log2: int, rng: np.random.Generator) -> np.ndarray:
        """Draw 2^log2 points that fill the box evenly: a Sobol sequence, shifted at random; shape (2^log2, n)."""
        from scipy.stats import qmc

        unit = qmc.Sobol(len(self.low), scramble=False).random_base2(log2)
        return self.low + (self.high - self.low) * ((unit + rng.random(len(self.low))) % 1.0)


def region_of(problem: SafetyProblem, system: ControlAffineSDE, expressions: Sequence[sp.Expr]) -> Region:
    """The workspace of a problem, with a finite range for what it leaves unbounded.

    Args:
        problem: whose ranges are taken.
        system: whose parameters are in the expressions.
        expressions: all that will be asked of a state: where they repeat after 2 pi, a period is enough.
    """
    low, high = [np.array([getattr(v, end) for v in problem.states]) for end in ("low", "high")]
    periodic, notes = np.zeros(len(low), dtype=bool), []
    unbounded = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high)))
    for i in unbounded.tolist():
        s = problem.states[i].symbol
        if not (np.isfinite(low[i]) or np.isfinite(high[i])) and all(_repeats(system, e, s) for e in expressions):
            periodic[i], low[i], high[i] = True, -_PERIOD / 2.0, _PERIOD / 2.0
            continue
        starts = draw_starts(problem, _STARTS)[:, i]
        reach = 10.0 * max(float(np.ptp(starts)), float(abs(starts).max()), 1.0)
        low[i] = low[i] if np.isfinite(low[i]) else starts.min() - reach
        high[i] = high[i] if np.isfinite(high[i]) else starts.max() + reach
        notes.append(f"{s} in [{low[i]:.4g}, {high[i]:.4g}], chosen around the starts: its workspace is unbounded")
    if periodic.any():
        names = ", ".join(str(problem.states[i].symbol) for i in np.flatnonzero(periodic))
        notes.append(f"{names} over a period of 2 pi, since nothing here tells the periods apart")
    return Region(low, high, periodic, tuple(notes))


def _repeats(system: ControlAffineSDE, expression: sp.Expr, s: sp.Symbol) -> bool:
    return s not in expression.free_symbols or vanishes(system, expression.subs(s, s + 2 * sp.pi) - expression)


def draw_starts(problem: SafetyProblem, count: int, seed: int = 0) -> np.ndarray:
    """Draw initial states of a problem, shape (count, n)."""
    rngs: list[Any] = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
    return np.stack([np.broadcast_to(c, (count,)) for c in Simulation(problem, "arrays").draw_starts(rngs)], axis=1)


@dataclass(frozen=True)
class Sample:
    """Points of a set.

    Attributes:
        points: evenly spread over the set, shape (B, n).
        drawn: how many points of a box were tried for them.
        share: part of the whole region that the set is, as found in the first pass.
    """

    points: np.ndarray
    drawn: int
    share: float


def sample(what: str, level: Score, region: Region, wanted: int, rng: np.random.Generator) -> Sample:
    """Draw points of the set {level >= 0}, in smaller and smaller boxes if it is a small part of the region.

    Args:
        what: the set, for the message.
        level: of a state; NaN counts as outside.
        region: where to look.
        wanted: number of points at which the drawing ends.
        rng: of all randomness.

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
            return Sample(found, drawn, share)
        enough = len(found) >= _FEW
        seeds = found if enough else _climbed(level, tried, region, rng)
        if not len(seeds):
            break
        box = region.around(seeds, 1.2 if enough else 4.0)
    if not len(found):
        raise ConfigurationError(f"no point of {what} was found among {drawn} of the workspace; is the set empty?")
    return Sample(found, drawn, share or 0.0)


def _covers(box: Region, region: Region, points: np.ndarray) -> bool:
    """Whether the points keep away from those ends of a box that are not the region's: then nothing is cut off."""
    width = 0.01 * (box.high - box.low)
    below = (points.min(axis=0) > box.low + width) | (box.low <= region.low)
    above = (points.max(axis=0) < box.high - width) | (box.high >= region.high)
    return bool((below & above).all())


def _climbed(level: Score, tried: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Points with level >= 0, from the population of a search for the largest level, as soon as there are enough."""
    population, values = search(level, tried, region, rng, until=lambda values: int(np.count_nonzero(values >= 0.0)) >= _FEW)
    return population[values >= 0.0]


def largest(score: Score, points: np.ndarray, region: Region, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """The largest score that is found, and the state (n,) that has it.

    Args:
        score: -inf or NaN where a state does not count.
        points: states to begin with, shape (B, n); some of them should count.
        region: where to look.
        rng: of all randomness.
    """
    population, values = search(score, points, region, rng)
    best = int(values.argmax())
    return float(values[best]), population[best]


def search(
    score: Score, points: np.ndarray, region: Region, rng: np.random.Generator, until: Callable[[np.ndarray], bool] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Differential evolution from the best points and a few others; the final population and its scores.

    Kinks in the score and the edge of the set make ridges here, on which gradients fail. Differences of members take on the
    shape of such a ridge.
    """
    values = _scores(score, points)
    best = np.argsort(-values)[: _POPULATION // 2]
    others = rng.choice(len(points), min(len(points), _POPULATION - len(best)), replace=False)
    chosen = np.concatenate([best, others])
    x, value = points[chosen], values[chosen]
    if len(x) < _POPULATION:
        near = np.resize(x, (_POPULATION - len(x), x.shape[1]))
        near = region.inside(near + 1e-3 * (region.high - region.low) * rng.standard_normal(near.shape))
        x, value = np.concatenate([x, near]), np.concatenate([value, _scores(score, near)])
    for _ in range(_ROUNDS):
        lowest, highest = float(value.min()), float(value.max())
        if math.isfinite(lowest) and highest - lowest <= _CONVERGED * abs(highest):
            break
        if until is not None and until(value):
            break
        trial = region.inside(_moved(x, x[int(value.argmax())], region, rng))
        reached = _scores(score, trial)
        better = reached >= value
        x, value = np.where(better[:, None], trial, x), np.where(better, reached, value)
    return x, value


def _moved(x: np.ndarray, top: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """A trial for each member, from itself or, of a quarter, from the best one, half of them by a difference and half by a normal step.

    The normal steps are of all sizes, along one axis or all: where a whole ridge is best, differences never get small.
    """
    size, n = x.shape
    base = np.where(rng.random((size, 1)) < 0.25, top, x)
    difference = rng.uniform(0.3, 1.0, (size, 1)) * (x[rng.permutation(size)] - x[rng.permutation(size)])
    chosen = (rng.random((size, 1)) < 0.5) | (rng.integers(n, size=(size, 1)) == np.arange(n))
    length = (region.high - region.low) * 10.0 ** rng.uniform(_FINEST, 0.0, (size, 1))
    normal = length * chosen * rng.standard_normal((size, n))
    return base + np.where(rng.random((size, 1)) < 0.5, difference, normal)


def _scores(score: Score, x: np.ndarray) -> np.ndarray:
    values = score(x)
    return np.where(np.isnan(values), -np.inf, values)
