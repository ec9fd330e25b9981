"""Returns that can be had at a price on becoming unsafe, by dynamic programming.

With a price c that is paid once, at the first control instant outside the safe set C, and with
V_k(x) the largest expected return from x at instant k after a violation,

    J_k(x) = max_u E[r(x', u, t_{k+1}) + 1{x' in C} J_{k+1}(x') + 1{x' not in C} (V_{k+1}(x') - c)],

where an episode that has ended is worth 0 from then on. For the policies whose chance of a
violation is v and whose mean return is R, R - c v <= J_0(c), the mean over the starts; so R <=
J_0(c) + c v for every price c. The least of these lines is concave in v: it is the upper concave
envelope of what can be had, also by policies that draw lots between others.

Values between nodes are interpolated: the lines are computed, not proved. On a coarse grid cubic
polynomials, along one or two axes, make the largest values a little too large, since inputs are
chosen where they overshoot; linear interpolation, along three axes, acts like further noise and
makes values too small.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from scipy.sparse import csr_matrix

from safe_envs.dynamics.codegen import Components, compile_function, filled
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.problem.frame import Frame
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.values.cells import Sets, hull_of
from safe_envs.values.grid import NodeGrid
from safe_envs.values.input_search import scanned_inputs, threads
from safe_envs.values.look_ahead import draw_starts
from safe_envs.values.reduction import ReducedProblem, known_states, known_values, reduced, sub_step
from safe_envs.values.tables import LEAVING

MOST_COORDINATES = 3
"""Axes of a grid of returns."""

_STATES = 4096
_ALIKE = 1e-9
_WIDE = 10.0
"""Range in which states without bounds are drawn."""


@dataclass(frozen=True, eq=False)
class RewardedProblem:
    """A problem in few coordinates, with its reward.

    Attributes:
        small: the problem, with the step of the plant.
        reward: of a step, of the coordinates that it reaches, the inputs, and `TIME`.
    """

    small: ReducedProblem
    reward: sp.Expr

    @property
    def depends_on_time(self) -> bool:
        """Whether the reward does."""
        return TIME in self.reward.free_symbols


def rewarded(problem: SafetyProblem) -> RewardedProblem:
    """Reduce a problem to coordinates that decide what happens and what is rewarded.

    A frame in which the reward is no function of its coordinates is not used.

    Args:
        problem: with the start, noise and bounds in use.

    Raises:
        ConfigurationError: There are too many coordinates, or what happens depends on time.
    """
    frame = problem.frame
    small = reduced(problem, "plant") if frame is not None else None
    reward: Any = problem.plant.numeric(problem.reward)
    if small is not None and frame is not None and not small.note:
        section: Any = dict(zip(problem.plant.states, frame.section, strict=True))
        if _is_invariant(problem, frame, small, reward):
            return _checked(RewardedProblem(small, reward.xreplace(section)))
    small = reduced(replace(problem, frame=None), "plant")
    return _checked(RewardedProblem(small, _with_constants(problem, reward)))


def _checked(found: RewardedProblem) -> RewardedProblem:
    small = found.small
    name, symbols = small.problem.name, small.symbols
    names = ", ".join(map(str, symbols))
    if len(symbols) > MOST_COORDINATES:
        raise ConfigurationError(
            f"the return of {name} takes {len(symbols)} coordinates ({names}); a grid of returns"
            f" takes at most {MOST_COORDINATES}. A declared frame helps only if the reward is a"
            " function of its coordinates"
        )
    moving = found.reward.free_symbols - {*symbols, *small.inputs, TIME}
    if small.known or moving:
        moved = ", ".join(sorted({*map(str, small.known), *map(str, moving)}))
        raise ConfigurationError(
            f"the step, the sets or the reward of {name} change with {moved}, which moves by"
            " itself; returns are computed for problems in which only the reward depends on time"
        )
    return found


def _with_constants(problem: SafetyProblem, reward: Any) -> Any:
    """Return the reward with numbers in place of states that never change."""
    plant = problem.plant
    known = known_states(problem, plant)
    if not known:
        return reward
    _, moved = sub_step(plant, problem.dt / problem.substeps)
    _, constant = known_values(problem, known, dict(zip(plant.states, moved, strict=True)))
    return reward.xreplace(dict(constant))


def _is_invariant(problem: SafetyProblem, frame: Frame, small: ReducedProblem, reward: Any) -> bool:
    """Return whether states with equal coordinates get equal rewards, by a sample."""
    rng = np.random.default_rng(0)
    x = [rng.uniform(max(s.low, -_WIDE), min(s.high, _WIDE), _STATES) for s in problem.states]
    u = [rng.uniform(i.low, i.high, _STATES) for i in problem.inputs]
    t = rng.uniform(0.0, problem.duration, _STATES)
    section = compile_function(small.symbols, frame.section, "arrays")
    alike = section(*small.of_states(tuple(x)))
    function = compile_function((*problem.plant.states, *small.inputs, TIME), (reward,), "arrays")
    values = [
        filled(function(*state, *u, t)[0], (_STATES,))
        for state in (x, [filled(c, (_STATES,)) for c in alike])
    ]
    size = np.abs(values[0]).max()
    return bool(np.allclose(*values, rtol=_ALIKE, atol=_ALIKE * size))


_CUBIC_AXES = 2
"""Axes along which cubic polynomials are taken. On the coarse grids of more axes their overshoots,
which the best inputs look for, would grow from step to step."""

Points = list[np.ndarray]
"""An array for each coordinate."""


def weighted_means(
    grid: NodeGrid, reached: Points, weights: np.ndarray, table: np.ndarray
) -> np.ndarray:
    """Return the weighted sum over noises of interpolated values, shape (U, B).

    Args:
        grid: of the values.
        reached: points, arrays (U, B, W).
        weights: of them, shape (U, B, W).
        table: on the nodes; NaN where there is no value, whose share goes to the others.
    """
    kept = np.flatnonzero(weights)
    nodes, shares = grid.corners([each.reshape(-1)[kept] for each in reached])
    values = table[nodes]
    missing = np.isnan(values)
    if missing.any():
        shares, values = np.where(missing, 0.0, shares), np.where(missing, 0.0, values)
        total = shares.sum(axis=0)
        shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0.0)
    found = np.zeros(weights.size)
    found[kept] = weights.reshape(-1)[kept] * np.einsum("cb,cb->b", shares, values)
    return found.reshape(weights.shape).sum(axis=-1)


def weighted_matrix(
    grid: NodeGrid, reached: Points, weights: np.ndarray, known: np.ndarray | None
) -> Any:
    """Return the matrix that interpolates values where a step leads, with weights.

    Args:
        grid: of the values.
        reached: points, arrays (U, B, W).
        weights: of them, shape (U, B, W).
        known: place of each node in the values, -1 for none; its share goes to the others.
    """
    inputs, count, noises = weights.shape
    flat = weights.reshape(-1)
    kept = np.flatnonzero(flat)
    points: Sequence[np.ndarray] = [each.reshape(-1)[kept] for each in reached]
    if len(grid.counts) <= _CUBIC_AXES:
        nodes, shares = grid.around(points, None if known is None else known >= 0)
    else:
        nodes, shares = grid.corners(points)
    columns = grid.size
    if known is not None:
        columns = int(known.max()) + 1
        nodes = known[nodes]
        shares = np.where(nodes >= 0, shares, 0.0)
        total = shares.sum(axis=0)
        shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0.0)
        nodes = np.maximum(nodes, 0)
    rows = np.broadcast_to(kept // noises, nodes.shape)
    data = (shares * flat[kept]).astype(np.float32)
    used = data.reshape(-1) != 0.0
    entries = (
        data.reshape(-1)[used],
        (rows.reshape(-1)[used], nodes.reshape(-1)[used]),
    )
    return csr_matrix(entries, shape=(inputs * count, columns), dtype=np.float32)


_MOST_NODES = 81
_FEW_POINTS, _MANY_POINTS = 64, 256
_LEAST_WEIGHT = 1e-7
_WIDTHS = {1: 0.25, 2: 0.8}
_ENDS = {1: 4.75, 2: 4.4}


@dataclass(frozen=True)
class NoiseRule:
    """Nodes of standard normals, and their weights.

    Attributes:
        nodes: shape (d, W).
        weights: of sum 1, shape (W,).
        width: of the part that each node stands for, along each axis, within which noise may pass
            the edge of a set; 0 where each node stands for itself.
    """

    nodes: np.ndarray
    weights: np.ndarray
    width: float


def smooth_rule(normals: int) -> NoiseRule:
    """Return few nodes, exact for polynomials of degree 5 along each axis.

    Args:
        normals: number d of standard normals; quasi-random nodes are taken of many.
    """
    if not normals:
        return NoiseRule(np.zeros((0, 1)), np.ones(1), 0.0)
    if 3**normals > _MOST_NODES:
        return _points(normals, _FEW_POINTS)
    return _product(np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)]), np.array([1, 4, 1]) / 6, normals)


def edge_rule(normals: int) -> NoiseRule:
    """Return many nodes in boxes, of which parts may lie beyond the edge of a set."""
    if normals not in _WIDTHS:
        return _points(normals, _MANY_POINTS) if normals else smooth_rule(0)
    from scipy.special import ndtr

    width, end = _WIDTHS[normals], _ENDS[normals]
    edges = np.linspace(-end, end, round(2 * end / width) + 1)
    masses = np.diff(ndtr(edges))
    weights = masses / masses.sum()
    middles = 0.5 * (edges[1:] + edges[:-1])
    # Nodes of variance 1 keep the spread of what is averaged.
    nodes = middles / np.sqrt(weights @ middles**2)
    return _product(nodes, weights, normals, float(edges[1] - edges[0]))


def _product(nodes: np.ndarray, weights: np.ndarray, normals: int, width: float = 0.0) -> NoiseRule:
    found = np.array(list(itertools.product(nodes, repeat=normals))).T
    shares = np.array(list(itertools.product(weights, repeat=normals))).prod(axis=1)
    kept = shares > _LEAST_WEIGHT
    return NoiseRule(found[:, kept], shares[kept] / shares[kept].sum(), width)


def _points(normals: int, count: int) -> NoiseRule:
    """Return quasi-random normals and their mirror images, of variance 1."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    half = ndtri(qmc.Sobol(normals, rng=np.random.default_rng(0)).random(count // 2)).T
    half /= np.sqrt((half**2).mean(axis=1, keepdims=True))
    return NoiseRule(np.concatenate([half, -half], axis=1), np.full(count, 1.0 / count), 0.0)


_FAR = 5.5
"""Standard deviations of noise that must not reach an edge where few nodes are to suffice."""


@dataclass(frozen=True)
class Sides:
    """On which side of the edges points, or the boxes around them, lie: shares in [0, 1].

    Attributes:
        safe: within all barriers, and within the workspace if leaving it is a violation.
        going: where the episode goes on.
    """

    safe: np.ndarray
    going: np.ndarray


@dataclass(frozen=True, eq=False)
class Steps:
    """A control period from some nodes under each input; one entry for each input and node.

    Attributes:
        reward: expected reward, shape (U, nodes).
        exits: chance to become unsafe, shape (U, nodes).
        safe: takes values of the nodes of the safe part, (U nodes, values) sparse.
        violated: takes values of the nodes of the workspace; None where nothing reaches them.
    """

    reward: np.ndarray
    exits: np.ndarray
    safe: Any
    violated: Any


@dataclass(frozen=True, eq=False)
class _Moves:
    """Where a control period leads: points, arrays (U, B, W), and their weights.

    Attributes:
        reached: the points.
        staying: weights of what goes on safely.
        lost: weights of what goes on after a violation.
        exits: chance of a violation, shape (U, B).
    """

    reached: Points
    staying: np.ndarray
    lost: np.ndarray
    exits: np.ndarray


class PricedStep:
    """A control period of a problem with a reward.

    Args:
        given: the problem.
        inputs: that are tried, shape (U, m).
        leaving: how leaving the workspace counts, see `ValueSettings`.
    """

    def __init__(self, given: RewardedProblem, inputs: np.ndarray, leaving: str) -> None:
        small = self._small = given.small
        self._inputs, self._stays = inputs, leaving == "violation"
        coordinates = small.symbols
        self._step = compile_function(
            (*coordinates, *small.inputs, *small.noise), small.step, "arrays"
        )
        goal = -1 if small.goal is None else small.goal
        self._sets = compile_function(coordinates, (*small.barriers, small.outside, goal), "arrays")
        self._reward = compile_function(
            (*coordinates, *small.inputs, TIME), (given.reward,), "arrays"
        )
        normals = len(small.noise) * small.substeps
        self._smooth, self._edge = smooth_rule(normals), edge_rule(normals)
        far = _FAR * np.eye(normals)
        nodes = np.concatenate([np.zeros((normals, 1)), far, -far], axis=1)
        self._reach = NoiseRule(nodes, np.ones(nodes.shape[1]), 0.0)

    def is_safe(self, q: Points) -> np.ndarray:
        """Return whether points are safe, for points of any shape."""
        safe, _ = self._margins(q)
        return np.all(safe, axis=0)

    def near_edge(self, q: Points) -> np.ndarray:
        """Return from which points noise may pass an edge within a period, shape (B,)."""
        margins = self._all_margins(self._reached(q, self._reach.nodes))
        return ~np.all([m > 0.0 for m in margins], axis=(0, 1, 3))

    def rewards(self, q: Points, k: int) -> np.ndarray:
        """Return the expected rewards of a period, shape (U, B).

        Args:
            q: points, arrays (B,).
            k: number of the period.

        Raises:
            ConfigurationError: A reward is not finite.
        """
        reached = self._reached(q, self._smooth.nodes)
        u = [each[:, None, None] for each in self._inputs.T]
        time = (k + 1) * self._small.problem.dt
        with np.errstate(all="ignore"):
            found = filled(self._reward(*reached, *u, time)[0], reached[0].shape)
        found = found @ self._smooth.weights
        if not np.isfinite(found).all():
            raise ConfigurationError(
                f"the reward of {self._small.problem.name} is not finite everywhere in its"
                " workspace"
            )
        return found

    def steps(
        self,
        q: Points,
        near: bool,
        safe_grid: NodeGrid,
        known: np.ndarray,
        whole_grid: NodeGrid,
    ) -> Steps:
        """Return a control period from safe points.

        Args:
            q: the points, arrays (B,).
            near: whether noise may pass an edge.
            safe_grid: nodes of values that are still safe.
            known: place of each of its nodes in these values, -1 for none.
            whole_grid: nodes of the values after a violation.
        """
        moves = self._moves(q, near)
        return Steps(
            self.rewards(q, 0),
            moves.exits,
            weighted_matrix(safe_grid, moves.reached, moves.staying, known),
            weighted_matrix(whole_grid, moves.reached, moves.lost, None) if near else None,
        )

    def expected(
        self,
        q: Points,
        near: bool,
        safe_grid: NodeGrid,
        known: np.ndarray,
        whole_grid: NodeGrid,
        values: tuple[np.ndarray, np.ndarray, float],
    ) -> np.ndarray:
        """Return the expected value of the next states, less the price, shape (U, B).

        Args:
            q: safe points, arrays (B,).
            near: see `steps`, as for the grids.
            safe_grid: see there.
            known: see there.
            whole_grid: see there.
            values: of the safe nodes, of the nodes of the workspace, and the price.
        """
        moves = self._moves(q, near)
        safe, after, price = values
        table = np.where(known >= 0, safe[np.maximum(known, 0)], np.nan)
        found = weighted_means(safe_grid, moves.reached, moves.staying, table)
        if near:
            found += weighted_means(whole_grid, moves.reached, moves.lost, after)
        return found - price * moves.exits

    def _moves(self, q: Points, near: bool) -> _Moves:
        rule = self._edge if near else self._smooth
        reached = self._reached(q, rule.nodes)
        if not near:
            shape = reached[0].shape
            none = np.zeros(shape[:2])
            return _Moves(reached, np.broadcast_to(rule.weights, shape), none, none)
        sides = self._sides(q, reached, rule)
        return _Moves(
            reached,
            rule.weights * np.minimum(sides.safe, sides.going),
            rule.weights * np.maximum(sides.going - sides.safe, 0.0),
            (1.0 - sides.safe) @ rule.weights,
        )

    def violated_steps(self, q: Points, whole_grid: NodeGrid) -> Steps:
        """Return a control period after a violation.

        Args:
            q: points, arrays (B,).
            whole_grid: nodes of the values after a violation.
        """
        rule = self._smooth
        reached = self._reached(q, rule.nodes)
        _, going = self._margins(reached)
        weights = rule.weights * np.all(going, axis=0)
        return Steps(
            self.rewards(q, 0),
            np.zeros((len(self._inputs), len(q[0]))),
            None,
            weighted_matrix(whole_grid, reached, weights, None),
        )

    def _reached(self, q: Points, noise: np.ndarray) -> Points:
        """Return where points go under all inputs and noises, arrays (U, B, W)."""
        small = self._small
        shape = (len(self._inputs), len(q[0]), noise.shape[1])
        x = [each[None, :, None] for each in q]
        u = [each[:, None, None] for each in self._inputs.T]
        with np.errstate(all="ignore"):
            for draws in np.split(noise, small.substeps):
                x = self._step(*x, *u, *(w[None, None] for w in draws))
        return [filled(each, shape) for each in x]

    def _margins(self, x: Points) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return which barriers are positive at points, and which ends have not come."""
        *barriers, left, goal = self._values(x)
        safe, inside = [h > 0.0 for h in barriers], left <= 0.0
        return safe + [inside] * self._stays, [inside, goal < 0.0]

    def _values(self, x: Points) -> list[np.ndarray]:
        with np.errstate(all="ignore"):
            return [filled(v, x[0].shape) for v in self._sets(*x)]

    def _all_margins(self, x: Points) -> list[np.ndarray]:
        *barriers, left, goal = self._values(x)
        return [*barriers, -left, -goal]

    def _sides(self, q: Points, reached: Points, rule: NoiseRule) -> Sides:
        if not rule.width:
            safe, going = self._margins(reached)
            return Sides(
                np.all(safe, axis=0).astype(np.float64), np.all(going, axis=0).astype(np.float64)
            )
        spreads: Any = 0.0
        for axis in np.eye(len(rule.nodes)):
            half = 0.5 * rule.width * axis[:, None]
            ends = [self._all_margins(self._reached(q, s * half)) for s in (1, -1)]
            spreads = spreads + np.abs(np.array(ends[0]) - np.array(ends[1]))
        shares = []
        for margin, spread in zip(self._all_margins(reached), spreads, strict=True):
            with np.errstate(all="ignore"):
                share = np.clip(0.5 + margin / spread, 0.0, 1.0)
            shares.append(np.where(spread > 0.0, share, margin > 0.0))
        *barriers, inside, unfinished = shares
        safe: Any = np.min([*barriers, *[inside] * self._stays], axis=0)
        return Sides(safe, np.minimum(inside, unfinished))


@dataclass(frozen=True)
class FrontierSettings:
    """What a frontier is asked for, next to a problem.

    Attributes:
        prices: number of prices, 0 among them.
        policies: number of prices whose policy is kept.
        cells: number of nodes along each coordinate; None for numbers that suit.
        leaving: how an episode counts that leaves the workspace in the safe set: as a "violation",
            or as "safe", which is how `evaluate` counts it.

    Raises:
        ConfigurationError: A value is not allowed.
    """

    prices: int = 12
    policies: int = 6
    cells: tuple[int, ...] | None = None
    leaving: str = "violation"

    def __post_init__(self) -> None:
        require_whole("prices", self.prices, 2)
        require_whole("policies", self.policies, 0)
        for count in self.cells or ():
            require_whole("cells", count, 4)
        if self.leaving not in LEAVING:
            raise ConfigurationError(
                f"leaving = {shown(self.leaving)}; choose one of {', '.join(LEAVING)}"
            )


@dataclass(frozen=True, eq=False)
class PricedValues:
    """Largest returns less the price of a violation, and inputs that attain them.

    Attributes:
        given: the problem.
        settings: what was asked for.
        prices: increasing, from 0, shape (P,).
        values: mean over the starts of the return less the price, shape (P,).
        inputs: that were tried, in physical units, shape (U, m).
        safe_grid: nodes around the safe set.
        whole_grid: nodes of the workspace.
        known: place of each node of `safe_grid` in the tables, -1 for none.
        step: a control period.
        of_policies: numbers of the prices whose policy can be asked for.
        safe_start: of the safe nodes at instant 0 for all prices, shape (safe nodes, P).
        violated_start: after a violation, at instant 0, shape (nodes, 1).
        safe_values: of the safe nodes at the instants 1 to K, shape (K, safe nodes, policies),
            float32.
        violated_values: after a violation, at the same instants, shape (K, nodes), float32.
        violated_choice: number of the best input then, at the instants 0 to K - 1, the same shape.
        seconds: that the computation took.
    """

    given: RewardedProblem
    settings: FrontierSettings
    prices: np.ndarray
    values: np.ndarray
    inputs: np.ndarray
    safe_grid: NodeGrid
    whole_grid: NodeGrid
    known: np.ndarray
    step: PricedStep
    of_policies: np.ndarray
    safe_start: np.ndarray
    violated_start: np.ndarray
    safe_values: np.ndarray
    violated_values: np.ndarray
    violated_choice: np.ndarray
    seconds: float

    @property
    def least_violations(self) -> float:
        """The smallest chance of a violation that the largest prices lead to."""
        slope = (self.values[-2] - self.values[-1]) / (self.prices[-1] - self.prices[-2])
        return float(np.clip(slope, 0.0, 1.0))

    def largest_return(self, violations: np.ndarray) -> np.ndarray:
        """Return the largest mean return at chances of a violation, concave in these.

        Args:
            violations: in [0, 1], any shape.
        """
        lines = self.values + np.asarray(violations)[..., None] * self.prices
        return lines.min(axis=-1)

    def at_starts(self, x: Components) -> np.ndarray:
        """Return the values of starts for all prices, shape (B, P).

        Args:
            x: n components of the states, (B,).
        """
        given = self.given.small.of_states(tuple(np.asarray(c, dtype=np.float64) for c in x))
        q = [filled(c, np.shape(x[0])) for c in given]
        numbers, shares = self.safe_grid.corners(q)
        places = self.known[numbers]
        shares = np.where(places >= 0, shares, 0.0)
        total = shares.sum(axis=0)
        found = np.einsum("cb,cbp->bp", shares, self.safe_start[np.maximum(places, 0)])
        found /= np.where(total > 0.0, total, 1.0)[:, None]
        lost = self.whole_grid.interpolated(self.violated_start, q) - self.prices
        return np.where(self.step.is_safe(q)[:, None], found, lost)

    def inputs_at(self, k: int, x: Components, violated: np.ndarray, price: int) -> np.ndarray:
        """Return the inputs that are best at states, by a step of look-ahead where all is safe.

        Args:
            k: control instant before K.
            x: n components of the states, (B,).
            violated: which episodes had a violation, shape (B,).
            price: place in `of_policies`.

        Returns:
            In physical units, shape (B, m).
        """
        given = self.given.small.of_states(tuple(np.asarray(c, dtype=np.float64) for c in x))
        q = [filled(c, violated.shape) for c in given]
        chosen = self.violated_choice[k, self.whole_grid.nearest(q)].astype(np.int64)
        values = (
            self.safe_values[k, :, price],
            self.violated_values[k],
            float(self.prices[self.of_policies[price]]),
        )
        safe = np.flatnonzero(~violated)
        near = self.step.near_edge([c[safe] for c in q]) if safe.size else np.zeros(0, bool)
        for is_near in (False, True):
            rows = safe[near == is_near]
            if not rows.size:
                continue
            own = [c[rows] for c in q]
            grids = (self.safe_grid, self.known, self.whole_grid)
            gain = self.step.expected(own, is_near, *grids, values) + self.step.rewards(own, k)
            chosen[rows] = gain.argmax(axis=0)
        return self.inputs[chosen]


_NODES = {1: (1001,), 2: (130, 110), 3: (44, 44, 40)}
_WHOLE = {1: (1001,), 2: (100, 100), 3: (36, 36, 32)}
_INPUTS = {1: 21, 2: 7}
_FEW_INPUTS = 3
_LEAST_PRICE, _LARGEST_PRICE = 0.01, 30.0
"""In parts of the largest difference of two returns."""

_ENTRIES = 3_000_000
"""Of points that are looked at at once."""

_BYTES = 1e9
"""Of the tables that policies need, unless cells are asked for."""

_MOST_BYTES = 4e9
"""Of the same tables, whatever is asked for."""

_STARTS = 20_000

Progress = Callable[[float], None]


def price_violations(
    problem: SafetyProblem,
    settings: FrontierSettings | None = None,
    progress: Progress | None = None,
) -> PricedValues:
    """Compute the largest returns at several prices of a violation.

    Args:
        problem: whose plant is controlled.
        settings: what is asked for.
        progress: called with the part of the work that is done.

    Returns:
        The values, and what their policies need.

    Raises:
        ConfigurationError: There are too many coordinates, what happens depends on time, or the
            tables do not fit the memory.
    """
    return _Frontier(problem, settings or FrontierSettings()).run(progress)


class _Part(NamedTuple):
    """Some nodes, and a control period from them."""

    rows: np.ndarray
    points: list[np.ndarray]
    steps: Steps


class _Frontier:
    def __init__(self, problem: SafetyProblem, settings: FrontierSettings) -> None:
        self._begun = time.perf_counter()
        self._settings = settings
        self._given = given = rewarded(problem)
        small = given.small
        self._inputs = scanned_inputs(small.box, _INPUTS.get(len(small.box), _FEW_INPUTS)).values
        self._step = PricedStep(given, self._inputs, settings.leaving)
        self._safe_grid, self._whole_grid = self._grids()
        nodes = _around(self._safe_grid, self._step)
        self._known = np.full(self._safe_grid.size, -1)
        self._known[nodes] = np.arange(len(nodes))
        self._nodes = nodes

    def _grids(self) -> tuple[NodeGrid, NodeGrid]:
        small, settings = self._given.small, self._settings
        n = len(small.coordinates)
        turning = [bool(c.period) for c in small.coordinates]
        hull = hull_of(small, Sets(small, "violation"))
        ends = [(float(edges[0]), float(edges[-1])) for edges in hull]
        if settings.cells is not None and len(settings.cells) != n:
            names = ", ".join(map(str, small.symbols))
            raise ConfigurationError(
                f"cells = {'x'.join(map(str, settings.cells))}; {small.problem.name} has the"
                f" coordinates {names}: give a number for each"
            )
        counts = np.array(settings.cells or _NODES[n])
        needed = 4.0 * math.prod(counts.tolist()) * small.steps * max(settings.policies, 1)
        if settings.cells is None and needed > _BYTES:
            counts = np.maximum((counts * (_BYTES / needed) ** (1 / n)).astype(int), 8)
        elif needed > _MOST_BYTES:
            raise ConfigurationError(
                f"cells = {'x'.join(map(str, settings.cells or ()))} take"
                f" {needed / 1e9:.3g} GB at {small.steps} steps; give fewer: at most"
                f" {_MOST_BYTES / 1e9:g} GB are taken"
            )
        whole = [
            (-0.5 * c.period, 0.5 * c.period) if c.period else (c.low, c.high)
            for c in small.coordinates
        ]
        around = _WHOLE[n] if settings.cells is None else counts
        return (
            NodeGrid.over(ends, counts.tolist(), turning),
            NodeGrid.over(whole, [int(c) for c in around], turning),
        )

    def run(self, progress: Progress | None) -> PricedValues:
        small, settings = self._given.small, self._settings
        with ThreadPoolExecutor(threads(), "safe_envs_frontier") as pool:
            safe, whole = self._safe_parts(pool), self._violated_parts(pool)
            prices = self._prices(safe, whole)
            kind = np.uint8 if len(self._inputs) <= 256 else np.uint16
            kept = _spread(settings.prices, settings.policies)
            safe_values = np.zeros((small.steps, len(self._nodes), len(kept)), np.float32)
            violated_values = np.zeros((small.steps, self._whole_grid.size), np.float32)
            violated_choice = np.zeros((small.steps, self._whole_grid.size), kind)
            ahead = np.zeros((len(self._nodes), settings.prices), np.float32)
            after = np.zeros((self._whole_grid.size, 1), np.float32)
            for k in range(small.steps - 1, -1, -1):
                safe_values[k], violated_values[k] = ahead[:, kept], after[:, 0]
                work = [pool.submit(self._best, part, k, ahead, after, prices) for part in safe] + [
                    pool.submit(self._best, part, k, None, after, None) for part in whole
                ]
                ahead, after = np.empty_like(ahead), np.empty_like(after)
                for i, (part, done) in enumerate(zip(safe + whole, work, strict=True)):
                    values, choice = done.result()
                    if i < len(safe):
                        ahead[part.rows] = values
                    else:
                        after[part.rows], violated_choice[k, part.rows] = values, choice[:, 0]
                if progress:
                    progress((small.steps - k) / small.steps)
        found = PricedValues(
            self._given,
            settings,
            prices,
            np.zeros(0),
            self._inputs,
            self._safe_grid,
            self._whole_grid,
            self._known,
            self._step,
            kept,
            ahead,
            after,
            safe_values,
            violated_values,
            violated_choice,
            0.0,
        )
        means = found.at_starts(draw_starts(small.problem, _STARTS, 0)).mean(axis=0)
        return replace(found, values=means, seconds=time.perf_counter() - self._begun)

    def _best(
        self, part: _Part, k: int, ahead: Any, after: np.ndarray, prices: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest values of some nodes, and the inputs that attain them."""
        steps = part.steps
        reward = self._step.rewards(part.points, k) if self._moves else steps.reward
        shape = reward.shape
        gain = reward.astype(np.float32)[:, :, None]
        if steps.violated is not None:
            gain = gain + (steps.violated @ after).reshape(*shape, 1)
        if prices is not None:
            gain = gain + (steps.safe @ ahead).reshape(*shape, -1)
            if steps.exits.any():
                gain -= (steps.exits[:, :, None] * prices).astype(np.float32)
        best = gain[0].copy()
        choice = np.zeros(best.shape, np.uint16)
        for u in range(1, len(gain)):
            better = gain[u] > best
            np.copyto(best, gain[u], where=better)
            choice[better] = u
        if prices is not None:
            _limit(best, prices.astype(np.float32))
        return best, choice

    @property
    def _moves(self) -> bool:
        return self._given.depends_on_time

    def _prices(self, safe: Sequence[_Part], whole: Sequence[_Part]) -> np.ndarray:
        rewards = [part.steps.reward for part in (*safe, *whole)]
        spread = max(float(r.max()) for r in rewards) - min(float(r.min()) for r in rewards)
        scale = (spread or 1.0) * self._given.small.steps
        further = np.geomspace(_LEAST_PRICE, _LARGEST_PRICE, self._settings.prices - 1)
        return np.concatenate([[0.0], scale * further])

    def _safe_parts(self, pool: ThreadPoolExecutor) -> list[_Part]:
        found = []
        points = self._safe_grid.points(self._nodes)
        near = np.concatenate(
            [
                self._step.near_edge([c[part] for c in points])
                for part in _pieces(len(self._nodes), self._size(16))
            ]
        )
        for is_near in (False, True):
            rows = np.flatnonzero(near == is_near)
            size = self._size(64 if is_near else 16)
            for part in _pieces(len(rows), size):
                own = rows[part]
                q = [c[own] for c in points]
                found.append((own, q, pool.submit(self._steps, q, is_near)))
        return [_Part(own, q, done.result()) for own, q, done in found]

    def _steps(self, q: list[np.ndarray], near: bool) -> Steps:
        return self._step.steps(q, near, self._safe_grid, self._known, self._whole_grid)

    def _violated_parts(self, pool: ThreadPoolExecutor) -> list[_Part]:
        points = self._whole_grid.points(np.arange(self._whole_grid.size))
        found = []
        for part in _pieces(self._whole_grid.size, self._size(16)):
            q = [c[part] for c in points]
            done = pool.submit(self._step.violated_steps, q, self._whole_grid)
            found.append((np.arange(part.start, part.stop), q, done))
        return [_Part(own, q, done.result()) for own, q, done in found]

    def _size(self, noises: int) -> int:
        return max(1, _ENTRIES // (noises * len(self._inputs) * 2 ** len(self._safe_grid.counts)))


def _limit(values: np.ndarray, prices: np.ndarray) -> None:
    """Remove what interpolation overshoots: a price costs between nothing and itself."""
    for i in range(1, len(prices)):
        before = values[:, i - 1]
        np.clip(values[:, i], before - (prices[i] - prices[i - 1]), before, out=values[:, i])


def _spread(prices: int, policies: int) -> np.ndarray:
    """Return which prices' policies are kept: the first, the last, and some between."""
    return np.unique(np.linspace(0, prices - 1, min(policies, prices)).round().astype(int))


def _pieces(count: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _around(grid: NodeGrid, step: PricedStep) -> np.ndarray:
    """Return the nodes that are safe, and those next to them."""
    safe = step.is_safe(grid.points(np.arange(grid.size)))
    if not safe.any():
        raise ConfigurationError(
            "no node of the grid of returns is safe: the safe set is too small or too narrow for"
            " it; give more cells"
        )
    return np.flatnonzero(grid.around_marked(safe))
