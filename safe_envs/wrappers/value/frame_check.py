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

TOLERANCE = 1e-9
"""By which expectations at a state and at its partner may differ."""

_STATES = 32
_FEWEST = 8
_PROPOSALS = 1 << 13
_MOST_NODES = 1 << 14
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
        ranges: where a state may be, low and high for each, possibly infinite.
    """

    symbols: tuple[sp.Symbol, ...]
    inputs: tuple[sp.Symbol, ...]
    noise: tuple[sp.Symbol, ...]
    moved: tuple[sp.Expr, ...]
    barriers: tuple[sp.Expr, ...]
    goal: sp.Expr | None
    ranges: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class FrameVerdict:
    """What a check of a frame has found.

    Attributes:
        reason: why the frame cannot be used; "" if it can.
        workspace_matters: whether a state outside the workspace may be safe, which the coordinates
            then tell from those inside.
    """

    reason: str = ""
    workspace_matters: bool = False


def check_frame(frame: Frame, problem: SafetyProblem, world: World) -> FrameVerdict:
    """Check that coordinates decide what happens, at random safe states.

    Each state x is compared with the state that the section gives for its coordinates. Barriers,
    goal and the expectations of functions of the coordinates after a sub-step, under several
    inputs, must be equal, and the workspace must contain all safe states or be a function of the
    coordinates. Expectations are quadratures by Gauss and Hermite; where those are not settled,
    which can be seen by fewer nodes, states do not count.

    Args:
        frame: the coordinates.
        problem: the ranges and input bounds of which are used.
        world: the expressions.

    Returns:
        The verdict; states are drawn by a fixed seed.
    """
    pairs = _Pairs(frame, problem, world)
    x = pairs.safe_states()
    if x.shape[1] < _FEWEST:
        return FrameVerdict("too few safe states were found to check it")
    partners = pairs.partners(x)
    outside = pairs.outside_states()
    matters = bool((pairs.values(world.barriers, outside).min(axis=0) >= 0.0).any())
    reason = (
        pairs.flaw_of_section(x, partners)
        or pairs.flaw_of_ranges(x)
        or pairs.flaw_of_readings(x, partners)
        or (pairs.flaw_of_workspace(np.hstack((x, outside))) if matters else "")
        or pairs.flaw_of_law(x, partners)
    )
    return FrameVerdict(reason, matters)


class _Pairs:
    """States and their partners, and the formulas that are evaluated at both."""

    def __init__(self, frame: Frame, problem: SafetyProblem, world: World) -> None:
        self._frame, self._problem, self._world = frame, problem, world
        self._random = np.random.default_rng(0)
        symbols, plant = world.symbols, problem.plant
        section = dict(zip(plant.states, frame.section, strict=True))
        at = dict(zip(frame.symbols, frame.values, strict=True))
        self._section = [section.get(s, s).xreplace(at) for s in symbols]
        scaled: list[Any] = []
        names: list[str] = []
        for c, period, value in zip(frame.coordinates, frame.periods, frame.values, strict=True):
            names += [c.symbol.name] * 2
            unit = 2 * sp.pi / period if period else 1 / sp.Float((c.high - c.low) or 1.0)
            turn = unit * value
            scaled += [sp.cos(turn), sp.sin(turn)] if period else [turn, sp.cos(3 * turn)]
        kept = frame.unchanged(plant.states)
        moved = [s for s in kept if plant.drift[plant.states.index(s)] != 0]
        names += [s.name for s in moved]
        self._tested = [*scaled, *moved]
        # Means of functions and of products of two tell laws apart.
        two = itertools.combinations_with_replacement(range(len(names)), 2)
        pairs = list(two)
        self._functions = [*self._tested, *(self._tested[i] * self._tested[j] for i, j in pairs)]
        self._names = [
            *names,
            *(names[i] if names[i] == names[j] else f"{names[i]} and {names[j]}" for i, j in pairs),
        ]

    def values(self, expressions: Sequence[Any], x: Any) -> np.ndarray:
        """Return expressions of the states at states, shape (len(expressions), ...)."""
        return _evaluated(self._world.symbols, expressions, x)

    def partners(self, x: np.ndarray) -> np.ndarray:
        """Return the states that the section gives for the coordinates of others."""
        return self.values(self._section, x)

    def safe_states(self) -> np.ndarray:
        """Return random safe states, shape (n, count)."""
        domain = self._region()
        x = np.array([self._random.uniform(low, high, _PROPOSALS) for low, high in domain])
        starts = self._problem.starts[self._problem.start].proposals(_PROPOSALS // 8).T
        more = x[:, : starts.shape[1]].copy()
        more[: len(starts)] = starts
        x = np.hstack((more, x))
        safe = x[:, self.values(self._world.barriers, x).min(axis=0) > 0.0]
        return safe[:, self._random.permutation(safe.shape[1])[:_STATES]]

    def outside_states(self) -> np.ndarray:
        """Return states outside the workspace, near and far, shape (n, count)."""
        found = []
        for i, (low, high) in enumerate(self._world.ranges[: self._problem.plant.n]):
            for end, sign in ((low, -1.0), (high, 1.0)):
                if not math.isfinite(end):
                    continue
                width = high - low if math.isfinite(high - low) else _REACH
                for far in _FAR:
                    x = np.array([self._random.uniform(a, b, 256) for a, b in self._region(far)])
                    x[i] = end + sign * far * width
                    found.append(x)
        return np.hstack(found) if found else np.empty((len(self._world.symbols), 0))

    def flaw_of_section(self, x: np.ndarray, partners: np.ndarray) -> str:
        """Say where the coordinates of a state are not those of its partner."""
        return self._difference("the section has another", self._tested, x, partners)

    def flaw_of_ranges(self, x: np.ndarray) -> str:
        """Say where a coordinate of a safe state is outside its range."""
        q = self.values(self._frame.values, x)
        for c, period, value in zip(self._frame.coordinates, self._frame.periods, q, strict=True):
            if not period and not ((c.low <= value) & (value <= c.high)).all():
                return f"safe states have a {c.symbol} outside [{c.low:g}, {c.high:g}]"
        return ""

    def flaw_of_readings(self, x: np.ndarray, partners: np.ndarray) -> str:
        """Say where barriers or goal are no functions of the coordinates."""
        goal = [] if self._world.goal is None else [self._world.goal]
        timed = [e.xreplace({s: sp.Float(1.7) for s in self._times(e)}) for e in goal]
        return self._difference(
            "barrier or goal differ at equal", [*self._world.barriers, *timed], x, partners
        )

    def flaw_of_workspace(self, x: np.ndarray) -> str:
        """Say where the workspace is no function of the coordinates, though that matters."""
        left = [self._problem.outside]
        what = "safe states may be outside the workspace, which differs at equal"
        return self._difference(what, left, x, self.partners(x))

    def flaw_of_law(self, x: np.ndarray, partners: np.ndarray) -> str:
        """Say where the law of the coordinates after a step differs between partners."""
        settled = 0
        for u in self._inputs():
            rules = _rules(len(self._world.noise))
            coarse, fine = (
                (self._expected(x, u, *rule), self._expected(partners, u, *rule)) for rule in rules
            )
            error = np.maximum(*(abs(a - b) for a, b in zip(coarse, fine, strict=True)))
            sure = (error < 0.1 * TOLERANCE).all(axis=0)
            settled += int(sure.sum())
            apart = abs(fine[0] - fine[1]) - (10.0 * error + TOLERANCE)
            if (apart > 0.0).any():
                i, j = np.unravel_index(int(apart.argmax()), apart.shape)
                at = ", ".join(f"{v:.3g}" for v in x[:, j])
                return (
                    f"the law of {self._names[i]} after a step is another at ({at}) than at a state"
                    " with the same coordinates"
                )
        return "" if settled >= _FEWEST else "the laws of a step could not be computed exactly"

    def _difference(
        self, what: str, expressions: Sequence[Any], x: np.ndarray, partners: np.ndarray
    ) -> str:
        a, b = self.values(expressions, x), self.values(expressions, partners)
        same = abs(a - b) <= TOLERANCE * np.maximum(1.0, abs(a))
        names = ", ".join(s.name for s in self._frame.symbols)
        return "" if same.all() else f"{what} {names}"

    def _expected(self, x: np.ndarray, u: Sequence[float], nodes: Any, weights: Any) -> Any:
        """Return the means of test functions after a step, shape (functions, states)."""
        world = self._world
        moved = _evaluated(
            (*world.symbols, *world.inputs, *world.noise),
            world.moved,
            (*x[:, :, None], *u, *nodes[:, None, :]),
        )
        return self.values(self._functions, moved) @ weights

    def _inputs(self) -> Iterator[tuple[float, ...]]:
        box = np.array(self._problem.box).T
        for share in (0.5, 0.0, 1.0, 0.37):
            yield tuple((box[0] + share * (box[1] - box[0])).tolist())
        yield tuple(self._random.uniform(*box).tolist())

    def _region(self, margin: float = 0.0) -> list[tuple[float, float]]:
        """Return where states are drawn.

        That is the workspace and a margin around it, and for unbounded states where the system is
        sampled.
        """
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


def _rules(channels: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return two quadratures over standard normals, the second with more nodes."""
    most = min(32, int(_MOST_NODES ** (1 / channels))) if channels else 1
    return tuple(_tensor(count, channels) for count in (max(most // 2, 1), most))


def _tensor(count: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    weights = weights / weights.sum()
    shape = (count**channels, channels)
    grid = np.array(list(itertools.product(nodes, repeat=channels))).reshape(shape)
    shares = np.array(list(itertools.product(weights, repeat=channels))).reshape(shape)
    return grid.T, shares.prod(axis=1)


def _evaluated(symbols: Sequence[sp.Symbol], expressions: Sequence[Any], x: Any) -> np.ndarray:
    function: Callable[..., Components] = compile_function(symbols, expressions, "arrays")
    with np.errstate(all="ignore"):
        found = function(*x)
    shape = np.broadcast_shapes(*(np.shape(v) for v in (*x, *found)))
    return np.array([filled(v, shape) for v in found]).reshape(len(found), *shape)
