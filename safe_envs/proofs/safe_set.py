"""A safe set: its formulas, its points, and searches for suprema, shortfalls, kinks and poles.

SciPy's differential evolution in place of `search`, with the same populations and numbers of
rounds, was measured for 11 registered problems: slower for every one, 2 to 11 times, never with a
meaningfully larger supremum or shortfall, and with a smaller one for five. It has neither the
steps of all sizes, which follow ridges, nor periodic states.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from safe_envs.dynamics.codegen import tabulated
from safe_envs.dynamics.lie import quadratic_variation_rate
from safe_envs.dynamics.noise import StreamReader, key_of
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.simulation import Simulation
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.filters.conditions.base import Condition, with_parts
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.problem import SafetyProblem

BEYOND, BEYOND_LOG2 = 10.0, 12
"""Factor of the box that is looked at beyond another one, and the draws from it."""


@dataclass(frozen=True)
class Region:
    """A box of states.

    Attributes:
        low: lower ends, shape (n,).
        high: upper ends, shape (n,).
        periodic: the states of which the box holds a whole period, shape (n,).
        assumed: the states whose range was assumed, since the workspace is unbounded, shape
            (n,).
        notes: which of the ranges are not the workspace, in words.
    """

    low: np.ndarray
    high: np.ndarray
    periodic: np.ndarray
    assumed: np.ndarray
    notes: tuple[str, ...] = ()

    def scaled(self, factor: float) -> Region:
        """Return the box that is larger by a factor about the same centre; a period stays one."""
        half = np.where(self.periodic, 1.0, factor) * (self.high - self.low) / 2.0
        center = (self.high + self.low) / 2.0
        return replace(self, low=center - half, high=center + half)

    def within(self, low: ArrayLike, high: ArrayLike) -> Region:
        """Return the part of the box between ends.

        Args:
            low: lower ends, shape (n,); may be infinite.
            high: upper ends, shape (n,); may be infinite.
        """
        return replace(self, low=np.maximum(self.low, low), high=np.minimum(self.high, high))

    def around(self, points: np.ndarray, widened: float) -> Region:
        """Return the part of the box around points.

        Args:
            points: states, shape (B, n).
            widened: factor by which it is wider than they are.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        more = (widened - 1.0) * (high - low) / 2.0 + 1e-6 * (self.high - self.low)
        return replace(
            self, low=np.maximum(self.low, low - more), high=np.minimum(self.high, high + more)
        )

    def beyond(
        self, rng: np.random.Generator, low: ArrayLike = -np.inf, high: ArrayLike = np.inf
    ) -> np.ndarray:
        """Draw points of a far larger box about the same centre, without those in this one.

        Args:
            rng: of the draw.
            low: lower ends of the larger box at least, shape (n,).
            high: its upper ends at most, shape (n,).

        Returns:
            States, shape (B, n).
        """
        wide = self.scaled(BEYOND).within(low, high).draw(BEYOND_LOG2, rng)
        return wide[((wide < self.low) | (wide > self.high)).any(axis=1)]

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Return states (B, n) moved into the box, by whole periods or to its nearest end."""
        clipped = x.clip(self.low, self.high)
        if not self.periodic.any():
            return clipped
        return np.where(self.periodic, self.low + (x - self.low) % (self.high - self.low), clipped)

    def draw(self, log2: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points that fill the box evenly: a Sobol sequence, shifted at random.

        Args:
            log2: binary logarithm of their number.
            rng: of the shift.

        Returns:
            States, shape (2^log2, n).
        """
        from scipy.stats import qmc

        unit = qmc.Sobol(len(self.low), scramble=False).random_base2(log2)
        return self.low + (self.high - self.low) * ((unit + rng.random(len(self.low))) % 1.0)


Score = Callable[[np.ndarray], np.ndarray]
"""From states (B, n) to numbers (B,)."""

_ROUNDS = (240, 100)
_CONVERGED = 1e-13
_FINEST = -10.0
_POPULATION = 96
_ELITE = 8
_NEWTON = 8
_SEARCH_STEP = 1e-7


def largest(
    score: Score, points: np.ndarray, region: Region, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """Return the largest score that is found, and the state (n,) that has it.

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
    score: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
    until: Callable[[np.ndarray], bool] | None = None,
    deadline: float = math.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Differential evolution, twice: the final population and its scores.

    It begins with the best points and a few others, and again with what was best so far among
    random ones: a population that has gathered sees no other peak. Kinks in the score and the edge
    of the set make ridges here, on which gradients fail. Differences of members take on the shape
    of such a ridge.

    Args:
        score: see `largest`.
        points: see `largest`.
        region: see `largest`.
        rng: see `largest`.
        until: ends the search, given the scores of the population.
        deadline: processor time, as `time.process_time` has it, at which the search ends.
    """
    values = _scores(score, points)
    best = np.argsort(-values)[: _POPULATION // 2]
    x, value = _evolved(
        score,
        *_joined(points, values, best, region, score, rng),
        region,
        rng,
        _ROUNDS[0],
        until,
        deadline,
    )
    if until is not None:
        return x, value
    elite = np.argsort(-value)[:_ELITE]
    tried, found = np.concatenate([x[elite], points]), np.concatenate([value[elite], values])
    return _evolved(
        score,
        *_joined(tried, found, np.arange(len(elite)), region, score, rng),
        region,
        rng,
        _ROUNDS[1],
        until,
        deadline,
    )


def _joined(
    points: np.ndarray,
    values: np.ndarray,
    chosen: np.ndarray,
    region: Region,
    score: Score,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a population of the chosen points and others, of near ones where there are few."""
    counting = np.flatnonzero(np.isfinite(values))
    pool = counting if len(counting) else np.arange(len(points))
    others = rng.choice(pool, min(len(pool), _POPULATION - len(chosen)), replace=False)
    members = np.concatenate([chosen, others])
    x, value = points[members], values[members]
    if len(x) < _POPULATION:
        near = np.resize(x, (_POPULATION - len(x), x.shape[1]))
        near = region.inside(
            near + 1e-3 * (region.high - region.low) * rng.standard_normal(near.shape)
        )
        x, value = np.concatenate([x, near]), np.concatenate([value, _scores(score, near)])
    return x, value


def _evolved(
    score: Score,
    x: np.ndarray,
    value: np.ndarray,
    region: Region,
    rng: np.random.Generator,
    rounds: int,
    until: Callable[[np.ndarray], bool] | None,
    deadline: float,
) -> tuple[np.ndarray, np.ndarray]:
    for _ in range(rounds):
        if time.process_time() > deadline:
            break
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
    """Return a trial for each member, by a difference or by a normal step."""
    # A quarter begins at the best member, the others at themselves. Normal steps are of all sizes,
    # along one axis or all: where a whole ridge is best, differences never get small.
    size, n = x.shape
    base = np.where(rng.random((size, 1)) < 0.25, top, x)
    difference = rng.uniform(0.3, 1.0, (size, 1)) * (
        x[rng.permutation(size)] - x[rng.permutation(size)]
    )
    chosen = (rng.random((size, 1)) < 0.5) | (rng.integers(n, size=(size, 1)) == np.arange(n))
    length = (region.high - region.low) * 10.0 ** rng.uniform(_FINEST, 0.0, (size, 1))
    normal = length * chosen * rng.standard_normal((size, n))
    return base + np.where(rng.random((size, 1)) < 0.5, difference, normal)


def _scores(score: Score, x: np.ndarray) -> np.ndarray:
    values = score(x)
    return np.where(np.isnan(values), -np.inf, values)


def towards_zero(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, region: Region
) -> np.ndarray:
    """Move states to where a function is zero by Newton's method; they may end where it is not.

    Args:
        function: from states (B, n) to values (B, m).
        x: states near its zeros, shape (B, n).
        region: where they have to stay.

    Returns:
        States, shape (B, n).
    """
    steps = _SEARCH_STEP * (region.high - region.low)
    for _ in range(_NEWTON):
        value = function(x)
        slopes = [(function(x + step) - value) / step.sum() for step in np.diag(steps)]
        jacobian = np.nan_to_num(np.stack(slopes, axis=2), posinf=0.0, neginf=0.0)
        shift = np.linalg.pinv(jacobian) @ np.nan_to_num(value, posinf=0.0, neginf=0.0)[:, :, None]
        x = region.inside(x - shift[:, :, 0])
    return x


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


def filter_of_formulas(
    problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str
) -> SafetyFilter:
    """Return the filter of a problem whose constraints depend on the state alone.

    Args:
        problem: with a barrier for each constraint.
        conditions: one for each barrier.
        knowledge: "model" or "plant".

    Raises:
        ConfigurationError: A condition is learned, or a barrier is a maximum.
    """
    if any(c.is_learned for c in conditions):
        raise ConfigurationError(
            "the condition is learned; for bayesian-scbf:simultaneous=P a bound is estimated"
            " over the posterior"
        )
    found = SafetyFilter.for_problem(problem, tuple(conditions), knowledge)
    for barrier, constraint in zip(problem.barriers, found.constraints, strict=True):
        if constraint.alternatives:
            raise ConfigurationError(
                f"barrier {barrier.name} is a maximum: which of its functions counts depends on the"
                " proposed input, and what is proved is of constraints of the state alone"
            )
    return found


_ROUNDING = 1e-9
_EDGE = 1e-9
_ZERO = 1e-12
_EPSILONS = 64 * np.finfo(float).eps
_SIZES_LOG2 = 10
_STEP, _NEARLY = 1e-6, 1e-6


class Formulas:
    """The chains and conditions of a problem, compiled; arrays (B, n) of states in, arrays out.

    Attributes:
        safety_filter: which meets the conditions, or tells by how much it cannot.
        stages: the chain b_0..b_(r-1) of each barrier, as slices of all of them.

    Args:
        problem: whose barriers, input bounds and system are taken. A barrier that is a minimum
            counts as the barriers that it is the least of.
        conditions: one for each barrier.
        knowledge: "model" or "plant".

    Raises:
        ConfigurationError: an argument is out of its range, or a barrier is a maximum.
        RelativeDegreeError: a condition does not suit a barrier.
    """

    def __init__(
        self, problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str
    ) -> None:
        self.problem, self.conditions = with_parts(problem, conditions)
        self.knowledge = knowledge
        self.safety_filter = filter_of_formulas(self.problem, self.conditions, knowledge)
        self.system = self.safety_filter.model
        self._constraints = self.safety_filter.constraints
        self._low, self._high = np.array(problem.input_bounds).T
        self._rest = np.clip(0.0, self._low, self._high)
        ends = np.cumsum([len(c.chain) for c in self._constraints]).tolist()
        self.stages = tuple(
            slice(end - len(c.chain), end) for end, c in zip(ends, self._constraints, strict=True)
        )

    @property
    def first_order(self) -> bool:
        """Whether all relative degrees are 1, so that the invariant set is C itself."""
        return self.stages[-1].stop == len(self.stages)

    @cached_property
    def names(self) -> list[str]:
        """Names of all chain functions: h, b_1, ...; with the barrier's if there are several."""
        several = len(self.stages) > 1
        return [
            barrier.name if j == 0 else f"b_{j}" + f" of {barrier.name}" * several
            for barrier, stage in zip(self.problem.barriers, self.stages, strict=True)
            for j in range(stage.stop - stage.start)
        ]

    @property
    def barriers(self) -> list[int]:
        """Indices of the barriers themselves among the chain functions."""
        return [stage.start for stage in self.stages]

    @property
    def noisy(self) -> bool:
        """Whether the plant has noise."""
        return self.problem.plant.noisy

    @property
    def certain(self) -> bool:
        """Whether the conditions, where they can be met, keep every path and not only some."""
        return not self.noisy or all(c.almost_sure for c in self.conditions)

    @property
    def expressions(self) -> list[Any]:
        """All functions of the state that a verification evaluates."""
        return [*self.chain_expressions, *self._constraint_expressions()]

    @property
    def chain_expressions(self) -> list[Any]:
        """b_0..b_(r-1) of each barrier, one after the other."""
        return [e for c in self._constraints for e in c.chain]

    def _constraint_expressions(self) -> list[Any]:
        return [e for c in self._constraints for e in (*c.coefficient, c.offset - (c.demand or 0))]

    @cached_property
    def chain(self) -> Callable[[np.ndarray], np.ndarray]:
        """States (B, n) to b_0..b_(r-1) of each barrier, one after the other, (B, sum of the r)."""
        return self._compiled(self.chain_expressions)

    @cached_property
    def _constraints_compiled(self) -> Any:
        return self._compiled(self._constraint_expressions())

    def _compiled(self, expressions: Sequence[Any]) -> Any:
        function = tabulated(self.system.states, [self.system.numeric(e) for e in expressions])

        def values(x: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                return function(x)

        return values

    @cached_property
    def variation_rates(self) -> Callable[[np.ndarray], np.ndarray]:
        """States (B, n) to |sigma' grad h|^2 of each barrier, the variance of h per s, (B, k)."""
        barriers = [c.chain[0] for c in self._constraints]
        return self._compiled([quadratic_variation_rate(self.system, h) for h in barriers])

    @cached_property
    def region(self) -> Region:
        """The workspace, with a finite range for what it leaves unbounded."""
        return region_of(self.problem, self.system, self.expressions)

    @cached_property
    def _sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """Typical sizes over the workspace: of each b_j, and of each offset b, shape (k,)."""
        x = self.region.draw(_SIZES_LOG2, np.random.default_rng(0))
        return _typical(self.chain(x)), _typical(
            self._constraints_compiled(x).reshape(len(x), len(self.stages), -1)[:, :, -1]
        )

    @cached_property
    def _edges(self) -> np.ndarray:
        """Width of the strip of each b_j where a reciprocal condition has no value; else 0."""
        reciprocal = [c.demand is not None for c in self._constraints for _ in c.chain]
        return np.where(reciprocal, _EDGE * self._sizes[0], 0.0)

    def barrier_level(self, x: np.ndarray) -> np.ndarray:
        """Return a level (B,) that is nonnegative in C."""
        return (self.chain(x) - self._edges)[:, self.barriers].min(axis=1)

    def invariant_level(self, x: np.ndarray) -> np.ndarray:
        """Return a level (B,) that is nonnegative in the invariant set."""
        return (self.chain(x) - self._edges).min(axis=1)

    @property
    def independent(self) -> bool:
        """Whether no input appears in two conditions, so that each can be met by itself."""
        uses = [{j for j, a in enumerate(c.coefficient) if a != 0} for c in self._constraints]
        return sum(map(len, uses)) == len(set().union(*uses))

    @property
    def joint(self) -> bool:
        """Whether the joint shortfall is exact: one condition, independent ones, or one input."""
        # Sampling margins decide how the filter distributes a violation, by the nominal action.
        sampled = any(c.change is not None for c in self._constraints)
        return self.independent or (self.problem.plant.m == 1 and not sampled)

    def _changes(self, x: np.ndarray) -> np.ndarray:
        """Return the change of each a, to first order, over states that rounding cannot tell."""
        found, width = 0.0, self.region.high - self.region.low
        for step in np.diag(_STEP * width):
            ahead, behind = (self._entries(x + sign * step)[:, :, :-1] for sign in (1.0, -1.0))
            slope = np.nan_to_num(abs(ahead - behind), posinf=0.0)
            found = found + slope * (_EPSILONS / (2.0 * _STEP))
        return np.asarray(found)

    def _entries(self, x: np.ndarray) -> np.ndarray:
        return self._constraints_compiled(x).reshape(len(x), len(self.stages), -1)

    @cached_property
    def _nearly_zero(self) -> np.ndarray:
        """Sizes below which an a may be 0 but for rounding, shape (k, m)."""
        x = self.region.draw(_SIZES_LOG2, np.random.default_rng(0))
        return _NEARLY * _typical(self._entries(x)[:, :, :-1])

    def constraints_at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a (B, k, m) and b (B, k) of the constraints a u + b >= 0.

        An a that is 0 to rounding is 0: within input bounds that are wide enough, rounding would
        meet any condition.
        """
        found = self._entries(x)
        a = found[:, :, :-1]
        small = (abs(a) <= self._nearly_zero).any(axis=(1, 2))
        if small.any():
            a = a.copy()
            a[small] = np.where(abs(a[small]) <= self._changes(x[small]), 0.0, a[small])
        return a, found[:, :, -1]

    def defined(self, x: np.ndarray) -> np.ndarray:
        """Return whether the conditions have finite values, shape (B,)."""
        return np.isfinite(self._constraints_compiled(x)).all(axis=1)

    def control_authority(self, x: np.ndarray) -> np.ndarray:
        """Return half of the range of L_g b_(r-1) u over the input bounds, shape (B, k)."""
        return (abs(self.constraints_at(x)[0]) * (self._high - self._low) / 2.0).sum(axis=2)

    def reach(self, x: np.ndarray) -> float:
        """Return the part of the input bounds, at most 1, that matters as much as the offset b."""
        a, b = self.constraints_at(x)
        with np.errstate(all="ignore"):
            ratio = np.nanmedian(abs(b + a @ self._rest), axis=0) / np.nanmedian(
                self.control_authority(x), axis=0
            )
        ratio = ratio[(ratio > 0.0) & np.isfinite(ratio)]
        return min(1.0, float(ratio.min())) if ratio.size else 1.0

    def own_shortfall(self, x: np.ndarray, reach: float = 1.0) -> np.ndarray:
        """Return by how much the action that is best for a condition alone violates it.

        Where the condition can be met, to rounding, it is minus the margin of that action.

        Args:
            x: states, shape (B, n).
            reach: part of the input bounds that is allowed, about the action next to 0.

        Returns:
            Amounts for each condition, shape (B, k).
        """
        a, b = self.constraints_at(x)
        low, high = self._ends(reach)
        most = np.maximum(a * low, a * high).sum(axis=2)
        spare, rounding = b + most, _ROUNDING * (abs(most) + abs(b)) + _ZERO * self._sizes[1]
        return np.where(abs(spare) > rounding, -spare, 0.0)

    def shortfall(self, x: np.ndarray, reach: float = 1.0) -> np.ndarray:
        """Return by how much the worst condition is violated at best.

        Where all can be met, it is minus the best common margin. Where several conditions share the
        inputs, the filter decides how a violation is distributed.

        Args:
            x: states, shape (B, n).
            reach: see `own_shortfall`; below 1 the violation of the worst condition is least.

        Returns:
            Amounts, shape (B,); NaN where a condition is undefined.
        """
        own = self.own_shortfall(x, reach).max(axis=1)
        if self.independent:
            return own
        found = self._common(x, reach) if self.joint else own
        unsettled = (found > 0.0 if self.joint else found <= 0.0) & (reach == 1.0) & self.defined(x)
        if unsettled.any():
            slack = self.slack(x[unsettled]).max(axis=1)
            rounding = _ROUNDING * abs(self.constraints_at(x[unsettled])[1]).max(axis=1)
            found[unsettled] = np.where(
                slack > rounding, np.maximum(slack, found[unsettled]), found[unsettled]
            )
        return found

    def _ends(self, reach: float) -> tuple[np.ndarray, np.ndarray]:
        return self._rest + reach * (self._low - self._rest), self._rest + reach * (
            self._high - self._rest
        )

    def _common(self, x: np.ndarray, reach: float) -> np.ndarray:
        """Return minus the best common margin of several conditions on one input, shape (B,)."""
        # The smallest margin is concave and piecewise linear in the input: it is largest where two
        # of them cross, or at a bound of the input.
        a, b = self.constraints_at(x)
        a = a[:, :, 0]
        low, high = (end[0] for end in self._ends(reach))
        i, j = np.triu_indices(len(self.stages), 1)
        with np.errstate(all="ignore"):
            crossings = (b[:, j] - b[:, i]) / (a[:, i] - a[:, j])
        tried = np.clip(np.nan_to_num(crossings, nan=low, posinf=high, neginf=low), low, high)
        tried = np.concatenate([tried, np.broadcast_to([low, high], (len(x), 2))], axis=1)
        margins = a[:, :, None] * tried[:, None, :] + b[:, :, None]
        rounding = (
            _ROUNDING * (abs(a[:, :, None] * tried[:, None, :]) + abs(b[:, :, None]))
            + _ZERO * self._sizes[1][:, None]
        )
        return -np.where(abs(margins) > rounding, margins, 0.0).min(axis=1).max(axis=1)

    def slack(self, x: np.ndarray) -> np.ndarray:
        """Return by how much the filter violates each condition, shape (B, k)."""
        rest = np.broadcast_to(self._rest, (len(x), len(self._rest)))
        return self.safety_filter.filter(x, rest).slack


def _typical(values: np.ndarray) -> np.ndarray:
    """Return the medians of sizes that are neither 0 nor undefined, over the first axis; else 1."""
    sizes = np.where(np.isfinite(values) & (values != 0.0), abs(values), np.nan)
    empty = np.isnan(sizes).all(axis=0)
    return np.where(empty, 1.0, np.nanmedian(np.where(empty, 1.0, sizes), axis=0))


_TOUCHED = 1e-6
"""Part of its typical size at which a function counts as one that reaches 0."""

_NEXT = 1e-8
"""Part of the range of a state within which a search does not tell a function that reaches 0."""

NOT_ESTABLISHED = "it is not established that "
"""How the text begins of a function that comes near 0 and may stay away from it."""

_LONGEST = 60
"""Number of characters of a part that a message shows."""


_TWICE = "twice differentiable, which Ito's formula asks for,"


class Edge(NamedTuple):
    """A part of an expression that is not smooth where another expression is 0.

    Attributes:
        part: of the expression.
        base: which must not reach 0.
        pole: whether the part has no finite value there, and not only no second derivative.
    """

    part: sp.Expr
    base: sp.Expr
    pole: bool


def edges(expression: Any) -> Iterator[Edge]:
    """Yield the parts of an expression that are smooth only inside their domains, each once."""
    part: Any
    for part in dict.fromkeys(sp.preorder_traversal(expression)):
        arguments: tuple[Any, ...] = part.args
        match part:
            case sp.Pow() if part.base.free_symbols and not (part.exp.is_Integer and part.exp >= 0):
                yield Edge(part, part.base, not part.exp.is_nonnegative)
            case sp.log():
                yield Edge(part, arguments[0], True)
            case sp.tan() | sp.sec():
                yield Edge(part, sp.cos(arguments[0]), True)
            case sp.cot() | sp.csc():
                yield Edge(part, sp.sin(arguments[0]), True)
            case sp.asin() | sp.acos() | sp.atanh():
                yield Edge(part, 1 - arguments[0] ** 2, isinstance(part, sp.atanh))
            case sp.acosh():
                yield Edge(part, arguments[0] - 1, False)
            case sp.atan2():
                # It jumps where y = 0 and x <= 0.
                y, x = arguments
                yield Edge(part, sp.sqrt(x**2 + y**2) + x, True)


class Asked(NamedTuple):
    """What has to be smooth.

    Attributes:
        name: of the function.
        expression: of the states, with numbers for all parameters.
        only_poles: whether a second derivative does not matter, but a finite value does.
    """

    name: str
    expression: sp.Expr
    only_poles: bool


def asked_of(formulas: Formulas) -> list[Asked]:
    """Return the functions that the bounds require to be smooth.

    They are the chains, which without noise need no derivative; the constraints need values.
    """
    numeric, found = formulas.system.numeric, []
    constraints, barriers = formulas.safety_filter.constraints, formulas.problem.barriers
    for barrier, stage, row in zip(barriers, formulas.stages, constraints, strict=True):
        chain = zip(formulas.names[stage], row.chain, strict=True)
        found += [Asked(name, numeric(function), not formulas.noisy) for name, function in chain]
        entries = (*row.coefficient, row.offset)
        found += [Asked(f"the condition on {barrier.name}", numeric(e), True) for e in entries]
    return found


def roughness(
    asked: Sequence[Asked],
    states: Sequence[sp.Symbol],
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> str:
    """Say which function is not smooth somewhere in a set, and where; "" if none was found.

    Where it comes near that only, the text begins with `NOT_ESTABLISHED`.

    Ito's formula asks for two continuous derivatives, and without noise paths may not pass a pole.
    A function with a kink by its name is found by `safe_envs.dynamics.lie.has_kinks`.

    Args:
        asked: what has to be smooth.
        states: symbols.
        level: nonnegative in the set.
        points: of the set, shape (B, n).
        region: where to look.
        rng: of the search.

    Returns:
        A text.
    """
    doubt = ""
    for name, expression, only_poles in asked:
        for edge in edges(expression):
            if (only_poles and not edge.pole) or edge.base.is_nonzero:
                continue
            state, reached = _nearest_zero(edge.base, states, level, points, region, rng)
            if state is None:
                continue
            values = zip(states, state.tolist(), strict=True)
            at = ", ".join(f"{s} = {value + 0.0:.4g}" for s, value in values)
            place = f"near {at}, by {shortened(edge.part, _LONGEST)}"
            if reached:
                return f"{name} {'has a pole' if edge.pole else f'is not {_TWICE}'} {place}"
            denied = "has no pole" if edge.pole else f"is {_TWICE}"
            doubt = doubt or f"{NOT_ESTABLISHED}{name} {denied} {place}"
    return doubt


def _nearest_zero(
    base: sp.Expr,
    states: Sequence[sp.Symbol],
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> tuple[np.ndarray | None, bool]:
    """Return a state (n,) of the set where a function is next to 0, and whether it is 0 there."""
    # None if no such state is found.
    values = tabulated(states, [base])

    def size(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return abs(values(x)[:, 0])

    def score(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.where(level(x) >= 0.0, -size(x), -np.inf)

    sizes = size(points)
    sizes = sizes[np.isfinite(sizes)]
    least, state = largest(score, points, region, rng)
    if not (sizes.size and -least <= _TOUCHED * float(np.median(sizes))):
        return None, False
    steps = np.diag(_NEXT * (region.high - region.low))
    with np.errstate(all="ignore"):
        here, *around = values(np.concatenate([state[None], state + steps, state - steps]))[:, 0]
    return state, bool(abs(here) <= np.nan_to_num(np.abs(np.array(around) - here)).max())


_POOL_LOG2 = 15
_GROWTH = 1.01
_BOXES = (1.0, 10.0, 100.0)
_BOX_LOG2 = 12
_CONFLICTS = 128
_REACHES = (1.0, 10.0, 100.0, 1000.0)
_WIDE = 0.3
_NEAR = 1e-6
_RAYS = 64


def supremum(
    j: int,
    formulas: Formulas,
    positive: Sequence[int],
    points: np.ndarray,
    rng: np.random.Generator,
) -> float:
    """Return the supremum of a chain function over the states of the workspace of a set.

    To leave the workspace ends an episode, so that what lies beyond does not matter (see
    `safe_envs.proofs.guarantees`). Ranges that were chosen for states without any are
    widened: the supremum is infinite if it grows with them.

    Args:
        j: index among all chain functions.
        formulas: of the chain.
        positive: indices of those that are positive in the set.
        points: states of the set in the region.
        rng: of all randomness.
    """

    def score(x: np.ndarray) -> np.ndarray:
        b = formulas.chain(x)
        return np.where(b[:, positive].min(axis=1) > 0.0, b[:, j], -np.inf)

    reached, region = -np.inf, formulas.region
    for factor in _BOXES:
        box = region.scaled(factor).within(*workspace_of(formulas.problem))
        more = _pool(points, box, rng) if factor == 1.0 else box.draw(_BOX_LOG2, rng)
        before, (reached, _) = reached, largest(score, np.concatenate([points, more]), box, rng)
        if not region.assumed.any():
            return reached
        if factor > 1.0 and reached <= _GROWTH * before:
            return max(reached, before)
    return np.inf


def unbounded(formulas: Formulas, j: int) -> bool:
    """Return whether a chain function is certainly unbounded where all are positive.

    They are polynomials along a straight line, which goes where the workspace has no end.

    Args:
        formulas: of the chain.
        j: index among all chain functions.
    """
    states, t = formulas.system.states, sp.Dummy("t", real=True)
    chain = [formulas.system.exact(e) for c in formulas.safety_filter.constraints for e in c.chain]
    if not all(e.is_polynomial(*states) for e in chain):
        return False
    for direction in itertools.islice(filter(_endless(formulas), _directions(len(states))), _RAYS):
        line = {
            s: p + int(d) * t
            for s, p, d in zip(states, _origin(formulas.region), direction, strict=True)
        }
        along = [sp.Poly(e.subs(line), t) for e in chain]
        if along[j].degree() > 0 and all(p.LC() > 0 for p in along):
            return True
    return False


def _endless(formulas: Formulas) -> Callable[[Sequence[int]], bool]:
    """Return a function that tells whether the workspace has no end in a direction."""
    ends = np.isinf(workspace_of(formulas.problem))
    return lambda direction: (
        any(direction) and all(ends[int(d > 0), i] for i, d in enumerate(direction) if d)
    )


def _directions(n: int) -> Iterator[Sequence[int]]:
    yield from np.eye(n, dtype=int).tolist()
    yield from (-np.eye(n, dtype=int)).tolist()
    yield from itertools.product((1, -1, 0), repeat=n)


def _origin(region: Region) -> list[sp.Expr]:
    """Return a point of a region that is nowhere special."""
    shares = np.linspace(2.0 / 7.0, 5.0 / 7.0, len(region.low) + 1)[:-1]
    return [sp.Rational(x) for x in (region.low + shares * (region.high - region.low)).tolist()]


def max_shortfall(
    formulas: Formulas,
    level: Score,
    points: np.ndarray,
    rng: np.random.Generator,
    seconds: float = math.inf,
) -> tuple[float, np.ndarray]:
    """Return the largest shortfall of the conditions over {level >= 0}, and the state of it.

    Within wide input bounds the conditions are violated only on the thin set where the control
    authority vanishes, which no sample meets. So the search begins with as much of the bounds as
    matters, and hands its population on to wider ones and, last, onto that set.

    Args:
        formulas: of the conditions.
        level: nonnegative in the set.
        points: of the set, shape (B, n).
        rng: of all randomness.
        seconds: of processor time after which a search ends with what it has.

    Returns:
        The shortfall in the units of b_(r-1) per s, 0 if there is none, and a state (n,).
    """
    tried = (
        np.concatenate([points, _pool(points, formulas.region, rng)]) if formulas.joint else points
    )
    reach, deadline = formulas.reach(points), time.process_time() + seconds
    wider = [reach * k for k in _REACHES if reach * k < _WIDE]
    for part in wider:
        population, _ = search(
            lambda x, part=part: where_inside(level, x, lambda y: formulas.shortfall(y, part)),
            tried,
            formulas.region,
            rng,
            deadline=deadline,
        )
        tried = np.concatenate([population, tried])
    if wider:
        tried = np.concatenate(
            [*_without_control(formulas, tried[: _CONFLICTS * len(wider)]), tried]
        )
    population, values = search(
        lambda x: where_inside(level, x, formulas.shortfall),
        tried,
        formulas.region,
        rng,
        deadline=deadline,
    )
    best = int(values.argmax())
    if formulas.joint or values[best] <= 0.0:
        return max(float(values[best]), 0.0), population[best]
    tried = np.concatenate([population[values > 0.0], points[:_CONFLICTS]])
    slack = formulas.slack(tried).max(axis=1)
    return float(slack.max()), tried[int(slack.argmax())]


def _without_control(formulas: Formulas, x: np.ndarray) -> list[np.ndarray]:
    """Return states (B, n) moved to where there is no control authority, for each condition."""
    return [
        towards_zero(lambda y, i=i: formulas.constraints_at(y)[0][:, i], x, formulas.region)
        for i in range(len(formulas.stages))
    ]


def without_control(formulas: Formulas, i: int, x: np.ndarray) -> np.ndarray:
    """Return a state, or an indistinguishable one where a condition has no control authority.

    Args:
        formulas: of the conditions.
        i: index of the condition.
        x: state, shape (n,).
    """
    moved = towards_zero(lambda y: formulas.constraints_at(y)[0][:, i], x[None], formulas.region)[0]
    near = abs(moved - x) <= _NEAR * (formulas.region.high - formulas.region.low)
    return moved if near.all() and not formulas.constraints_at(moved[None])[0][0, i].any() else x


def _pool(points: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Draw many more states around those of a set: narrow peaks need a look near them."""
    return region.around(points, 1.2).draw(_POOL_LOG2, rng)


def where_inside(level: Score, x: np.ndarray, score: Score) -> np.ndarray:
    """Return the score where level >= 0, and -inf elsewhere, where it is not evaluated.

    Args:
        level: nonnegative in the set.
        x: states, shape (B, n).
        score: of states in the set.
    """
    values, inside = np.full(len(x), -np.inf), level(x) >= 0.0
    if inside.any():
        values[inside] = score(x[inside])
    return values
