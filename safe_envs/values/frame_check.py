"""Whether a problem closes in the coordinates of its frame, judged on a sub-step of the simulation.

That the generator closes is not enough. A point that is driven around the origin at a speed which
depends on the angle keeps its distance in continuous time, but an Euler step from distance 1 ends
at sqrt(1 + (speed h)^2), which depends on the angle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, filled
from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.frame import Frame
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable, excess

Rule = tuple[np.ndarray, np.ndarray]
"""Nodes of shape (channels, count), and their weights, of sum 1."""

_SMOOTH_NODES, _MOST_SMOOTH_NODES = 28, 1 << 14


def normal_rules(channels: int) -> tuple[Rule, ...]:
    """Return quadratures over independent standard normals, of more and more nodes.

    Args:
        channels: number of normals; without any there is one rule of one node.
    """
    if not channels:
        return (_tensor(1, 0),)
    most = min(_SMOOTH_NODES, int(_MOST_SMOOTH_NODES ** (1 / channels)))
    return tuple(_tensor(max(most * part // 8, 1), channels) for part in (4, 5, 6, 8))


def _tensor(count: int, channels: int) -> Rule:
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    weights = weights / weights.sum()
    shape = (count**channels, channels)
    grid = np.array(list(itertools.product(nodes, repeat=channels))).reshape(shape)
    shares = np.array(list(itertools.product(weights, repeat=channels))).reshape(shape)
    return grid.T, shares.prod(axis=1)


TOLERANCE = 1e-9
"""By which expectations at a state and at its partner may differ."""

_STATES = 24
_DEGREES = {4: 5, 3: 8, 2: math.inf}
"""Most test functions of which products of so many are compared."""
_FEWEST = 8
_PROPOSALS = 1 << 13
_REACH = 10.0
_FAR = (1e-6, 1e-3, 0.03, 0.3, 1.0, 10.0)
"""How far outside the workspace states are tried, in widths of it."""


@dataclass(frozen=True)
class World:
    """The expressions of a problem that a frame has to agree with.

    Attributes:
        symbols: states, with uncertain parameters as further ones.
        inputs: symbols of the inputs.
        noise: symbols of the normals of a sub-step.
        moved: the states after a sub-step.
        barriers: of the states.
        goal: of the states and the time, or None.
        regions: further sets that matter, of the states.
        ranges: where a state may be, low and high for each, possibly infinite.
    """

    symbols: tuple[sp.Symbol, ...]
    inputs: tuple[sp.Symbol, ...]
    noise: tuple[sp.Symbol, ...]
    moved: tuple[sp.Expr, ...]
    barriers: tuple[sp.Expr, ...]
    goal: sp.Expr | None
    regions: tuple[sp.Expr, ...]
    ranges: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class FrameVerdict:
    """What a check of a frame has found.

    Attributes:
        reason: why the frame cannot be used; "" if it can.
        bounds: the states outside whose workspace a state may be safe; the coordinates tell whether
            it is outside.
    """

    reason: str = ""
    bounds: tuple[Variable, ...] = ()


def check_frame(frame: Frame, problem: SafetyProblem, world: World) -> FrameVerdict:
    """Check that coordinates decide what happens, at random safe states.

    Each state x is compared with the state that the section gives for its coordinates. Barriers,
    goal and the expectations of functions of the coordinates after a sub-step, under several
    inputs, must be equal, and the workspace must contain all safe states or be a function of the
    coordinates. Expectations are quadratures by Gauss and Hermite; those that fewer nodes change do
    not count.

    Args:
        frame: the coordinates.
        problem: the ranges and input bounds of which are used.
        world: the expressions.

    Returns:
        The verdict; states are drawn by a fixed seed.
    """
    pairs = _Pairs(frame, problem, world)
    everywhere, x = pairs.states()
    if x.shape[1] < _FEWEST:
        return FrameVerdict("too few safe states were found to check it")
    beyond = pairs.outside_states()
    crossed = {v: s for v, s in beyond.items() if (pairs.barriers(s) >= 0.0).any()}
    reason = (
        pairs.flaw_of_section(x)
        or pairs.flaw_of_ranges(x)
        or pairs.flaw_of_readings(everywhere)
        or pairs.flaw_of_bounds(tuple(crossed), np.hstack((x, *crossed.values())))
        or pairs.flaw_of_law(x)
    )
    return FrameVerdict(reason, tuple(crossed))


class _Pairs:
    """States and their partners, and the formulas that are evaluated at both."""

    def __init__(self, frame: Frame, problem: SafetyProblem, world: World) -> None:
        self._frame, self._problem, self._world = frame, problem, world
        self._random = np.random.default_rng(0)
        symbols, plant = world.symbols, problem.plant
        section = dict(zip(plant.states, frame.section, strict=True))
        # Within their ranges, so that a period that is none of the law shows.
        at = {
            c.symbol: value - period * sp.ceiling((value - c.high) / period) if period else value
            for c, period, value in zip(frame.coordinates, frame.periods, frame.values, strict=True)
        }
        self._section = [section.get(s, s).xreplace(at) for s in symbols]
        self._tested: list[Any] = []
        self._names: list[str] = []
        for c, period, value in zip(frame.coordinates, frame.periods, frame.values, strict=True):
            self._test(c, period, value)
        following = dict(zip(symbols, world.moved, strict=True))
        for state in problem.states:
            if state.symbol in frame.unchanged(plant.states):
                moves = following[state.symbol] != state.symbol
                self._test(state, 0.0, state.symbol if moves else sp.S.Zero)
        count = len(self._names)
        degree = next(d for d, most in _DEGREES.items() if count <= most)
        self._products = [
            chosen
            for d in range(1, degree + 1)
            for chosen in itertools.combinations_with_replacement(range(count), d)
        ]

    def _test(self, coordinate: Variable, period: float, value: Any) -> None:
        """Take functions of a coordinate whose products tell laws apart."""
        # Products such as r cos(phi) and r^2 cos(phi)^2 are smooth where a distance r is not.
        if value == 0:
            return
        width = coordinate.high - coordinate.low
        unit = 2 * math.pi / period if period else 1 / width if math.isfinite(width) else 0.1
        turn = value if unit == 1.0 else sp.Float(unit, 17) * value
        found = [sp.cos(turn), sp.sin(turn)]
        found = found if period else [turn, sp.cos(3 * turn), sp.sin(3 * turn)]
        self._tested += found
        self._names += [coordinate.symbol.name] * len(found)

    def values(self, expressions: Sequence[Any], x: Any) -> np.ndarray:
        """Return expressions of the states at states, shape (len(expressions), ...)."""
        return _evaluated(self._world.symbols, expressions, x)

    def partners(self, x: np.ndarray) -> np.ndarray:
        """Return the states that the section gives for the coordinates of others."""
        return self.values(self._section, x)

    def barriers(self, x: np.ndarray) -> np.ndarray:
        """Return the smallest barrier at states."""
        return self.values(self._world.barriers, x).min(axis=0)

    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """Return random states, and safe ones, shapes (n, count)."""
        domain = self._region()
        x = np.array([self._random.uniform(low, high, _PROPOSALS) for low, high in domain])
        starts = self._problem.starts[self._problem.start].proposals(_PROPOSALS // 8).T
        more = x[:, : starts.shape[1]].copy()
        more[: len(starts)] = starts
        x = np.hstack((more, x))
        safe = x[:, self.barriers(x) > 0.0]
        return x, safe[:, self._random.permutation(safe.shape[1])[:_STATES]]

    def outside_states(self) -> dict[Variable, np.ndarray]:
        """Return states outside the workspace of a state, near and far, shapes (n, count)."""
        found = {}
        for i, v in enumerate(self._problem.states):
            for end, sign in ((v.low, -1.0), (v.high, 1.0)):
                if not math.isfinite(end):
                    continue
                width = v.high - v.low if math.isfinite(v.high - v.low) else _REACH
                for far in _FAR:
                    x = np.array([self._random.uniform(a, b, 256) for a, b in self._region(far)])
                    x[i] = end + sign * far * width
                    found[v] = np.hstack((found[v], x)) if v in found else x
        return found

    def flaw_of_section(self, x: np.ndarray) -> str:
        """Say where the coordinates of a state are not those of its partner."""
        return self._difference("the section has another", self._tested, x)

    def flaw_of_ranges(self, x: np.ndarray) -> str:
        """Say where a coordinate of a safe state is outside its range."""
        q = self.values(self._frame.values, x)
        for c, period, value in zip(self._frame.coordinates, self._frame.periods, q, strict=True):
            if not period and not ((c.low <= value) & (value <= c.high)).all():
                return f"safe states have a {c.symbol} outside [{c.low:g}, {c.high:g}]"
        return ""

    def flaw_of_readings(self, x: np.ndarray) -> str:
        """Say where barriers, goal or regions are no functions of the coordinates."""
        goal = [] if self._world.goal is None else [self._world.goal]
        timed = [e.xreplace({s: sp.Float(1.7) for s in self._times(e)}) for e in goal]
        sets = [*self._world.barriers, *timed, *self._world.regions]
        return self._difference("barrier, goal or a region differ at equal", sets, x)

    def flaw_of_bounds(self, bounds: tuple[Variable, ...], x: np.ndarray) -> str:
        """Say where bounds of the workspace are no functions of the coordinates."""
        what = "safe states may be outside the workspace, which differs at equal"
        return self._difference(what, [excess(bounds)], x)

    def flaw_of_law(self, x: np.ndarray) -> str:
        """Say where the law of the coordinates after a step differs between partners."""
        partners = self.partners(x)
        settled = np.zeros(len(self._products), dtype=int)
        for u in self._inputs():
            rules = normal_rules(len(self._world.noise))
            found = np.array(
                [[self._expected(side, u, *rule) for side in (x, partners)] for rule in rules]
            )
            at_x, at_partners = found[-1]
            scale = TOLERANCE * np.maximum(1.0, abs(at_x))
            # Two rules may agree by chance where neither is near the mean, several do not.
            sure = np.ptp(found, axis=0).max(axis=0) < 0.1 * scale
            wrong = sure & (abs(at_x - at_partners) > scale)
            if wrong.any():
                i, j = np.argwhere(wrong)[0].tolist()
                names = " and ".join(dict.fromkeys(self._names[k] for k in self._products[i]))
                at = ", ".join(f"{v:.3g}" for v in x[:, j])
                return (
                    f"the law of {names} after a step is another at ({at}) than at a state with"
                    " the same coordinates"
                )
            settled += sure.sum(axis=1)
        shown = {
            self._names[k]
            for chosen, count in zip(self._products, settled, strict=True)
            for k in chosen
            if count >= _FEWEST
        }
        if shown == set(self._names):
            return ""
        return "the law of a step could not be computed exactly enough to compare it"

    def _difference(self, what: str, expressions: Sequence[Any], x: np.ndarray) -> str:
        a, b = self.values(expressions, x), self.values(expressions, self.partners(x))
        same = abs(a - b) <= TOLERANCE * np.maximum(1.0, abs(a))
        names = ", ".join(s.name for s in self._frame.symbols)
        return "" if same.all() else f"{what} {names}"

    def _expected(self, x: np.ndarray, u: Sequence[float], nodes: Any, weights: Any) -> Any:
        """Return the means of products of test functions after a step, shape (products, states)."""
        world = self._world
        moved = _evaluated(
            (*world.symbols, *world.inputs, *world.noise),
            world.moved,
            (*x[:, :, None], *u, *nodes[:, None, :]),
        )
        functions = self.values(self._tested, moved)
        return np.array([functions[list(p)].prod(axis=0) @ weights for p in self._products])

    def _inputs(self) -> Iterator[tuple[float, ...]]:
        box = np.array(self._problem.input_bounds).T
        for share in (0.5, 0.0, 1.0):
            yield tuple((box[0] + share * (box[1] - box[0])).tolist())
        yield tuple(self._random.uniform(*box).tolist())

    def _region(self, margin: float = 0.0) -> list[tuple[float, float]]:
        """Return where states are drawn."""
        # That is the workspace and a margin around it, and for unbounded states where the system is
        # sampled.
        try:
            explored: Any = self._problem.sampling_domain.region
        except SystemDefinitionError:
            explored = ()
        explored = (*explored, *[(-_REACH, _REACH)] * len(self._world.ranges))
        found = []
        for (low, high), (a, b) in zip(self._world.ranges, explored, strict=False):
            low, high = (low, high) if math.isfinite(high - low) else (float(a), float(b))
            found.append((low - margin * (high - low), high + margin * (high - low)))
        return found

    def _times(self, expression: Any) -> set[Any]:
        return expression.free_symbols - set(self._world.symbols)


def _evaluated(symbols: Sequence[sp.Symbol], expressions: Sequence[Any], x: Any) -> np.ndarray:
    function: Callable[..., Components] = compile_function(symbols, expressions, "arrays")
    with np.errstate(all="ignore"):
        found = function(*x)
    shape = np.broadcast_shapes(*(np.shape(v) for v in (*x, *found)))
    return np.array([filled(v, shape) for v in found]).reshape(len(found), *shape)
