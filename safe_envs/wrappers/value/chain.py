"""The coordinates of a problem, and a sub-step, the barriers and the goal in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.frame import Frame
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import excess
from safe_envs.wrappers.value.frame_check import World, check_frame
from safe_envs.wrappers.value.one_step import Intervals, tidied


@dataclass(frozen=True)
class Coordinate:
    """An axis of the grid.

    Attributes:
        symbol: of the coordinate in the expressions of a `ReducedProblem`.
        low: end of its range.
        high: other end.
        period: after which everything repeats, 0 if nothing does.
        expression: the coordinate, of the states.
    """

    symbol: sp.Symbol
    low: float
    high: float
    period: float
    expression: sp.Expr


@dataclass(frozen=True)
class Chain:
    """A problem in coordinates; all expressions are of these and of states that are known.

    Attributes:
        coordinates: the axes.
        step: each coordinate one sub-step later.
        barriers: what is safe.
        goal: reached where it is >= 0; None without one.
        outside: positive where the workspace is left.
        regions: that matter, by name, >= 0 inside.
    """

    coordinates: tuple[Coordinate, ...]
    step: tuple[sp.Expr, ...]
    barriers: tuple[sp.Expr, ...]
    goal: sp.Expr | None
    outside: sp.Expr
    regions: Mapping[str, sp.Expr]

    @property
    def expressions(self) -> tuple[sp.Expr, ...]:
        """All of them, those of the step first."""
        goal = () if self.goal is None else (self.goal,)
        return (*self.step, *self.barriers, *goal, self.outside, *self.regions.values())

    def with_numbers(self, numbers: Mapping[sp.Symbol, sp.Expr]) -> Chain:
        """Return the chain with numbers in place of states that never change."""

        def put(e: Any) -> Any:
            return sp.sympify(e).xreplace(dict(numbers))

        return Chain(
            self.coordinates,
            tuple(map(put, self.step)),
            tuple(map(put, self.barriers)),
            None if self.goal is None else put(self.goal),
            put(self.outside),
            {name: put(e) for name, e in self.regions.items()},
        )

    def with_periods(self) -> Chain:
        """Return the chain with the period 2 pi for coordinates without bounds that have it.

        Raises:
            ConfigurationError: A coordinate has neither bounds nor that period.
        """
        return replace(
            self, coordinates=tuple(map(self._with_period, range(len(self.coordinates))))
        )

    def _with_period(self, i: int) -> Coordinate:
        c = self.coordinates[i]
        if math.isfinite(c.low) and math.isfinite(c.high):
            return c
        shift = {c.symbol: c.symbol + 2 * sp.pi}
        if not all(
            is_zero(e.xreplace(shift) - e - (2 * sp.pi if j == i else 0))
            for j, e in enumerate(self.expressions)
        ):
            raise ConfigurationError(
                f"{c.symbol} lacks finite bounds and does not repeat after 2 pi, so that no grid"
                " can cover it; give the state a workspace"
            )
        return replace(c, low=-math.pi, high=math.pi, period=2 * math.pi)


@dataclass(frozen=True)
class Derivation:
    """What the coordinates of a problem are derived from.

    Attributes:
        problem: the problem.
        system: plant or model, with its uncertain parameters as further states.
        uncertain: their intervals.
        noise: symbols of the normals of a sub-step.
        moved: the states after a sub-step.
        known: the states that are known in advance, which are no coordinates.
        regions: names of those that matter.
    """

    problem: SafetyProblem
    system: ControlAffineSDE
    uncertain: Intervals
    noise: tuple[sp.Symbol, ...]
    moved: tuple[sp.Expr, ...]
    known: frozenset[sp.Symbol]
    regions: tuple[str, ...] = ()

    @property
    def following(self) -> dict[sp.Symbol, sp.Expr]:
        """Each state after a sub-step, by its symbol."""
        return dict(zip(self.system.states, self.moved, strict=True))

    def coordinates(self, states: Iterable[sp.Symbol]) -> tuple[Coordinate, ...]:
        """Return those of some states that are not known in advance, as coordinates."""
        return tuple(
            Coordinate(v.symbol, v.low, v.high, 0.0, v.symbol)
            for v in self.problem.states
            if v.symbol in states and v.symbol not in self.known
        )

    def in_states(self) -> Chain:
        """Return the problem in its states."""
        problem, following = self.problem, self.following
        free = self.coordinates(problem.plant.states)
        return Chain(
            free,
            tuple(following[c.symbol] for c in free),
            tuple(b.expression for b in problem.barriers),
            problem.goal,
            problem.outside,
            self._regions,
        )

    def in_frame(self, frame: Frame) -> tuple[Chain | None, str]:
        """Return the problem in a frame, or None and the reason why that cannot be used."""
        problem = self.problem
        verdict = check_frame(frame, problem, self._world())
        if verdict.reason:
            return None, f"the frame of {problem.name} is not used: {verdict.reason}"
        states = problem.plant.states
        section: Any = dict(zip(states, frame.section, strict=True))
        following: Any = {s: e.xreplace(section) for s, e in self.following.items()}
        rest = self.coordinates(frame.unchanged(states))
        own = tuple(
            Coordinate(c.symbol, c.low, c.high, period, value)
            for c, period, value in zip(frame.coordinates, frame.periods, frame.values, strict=True)
        )
        stepped: Any = [c.expression.xreplace(following) for c in own]
        outside: Any = excess(verdict.bounds)
        return Chain(
            (*own, *rest),
            (*stepped, *(following[c.symbol] for c in rest)),
            tuple(tidied(b.expression.xreplace(section)) for b in problem.barriers),
            None if problem.goal is None else tidied(problem.goal.xreplace(section)),
            outside.xreplace(section),
            {name: tidied(e.xreplace(section)) for name, e in self._regions.items()},
        ), ""

    @property
    def _regions(self) -> dict[str, sp.Expr]:
        return {name: self.problem.regions[name] for name in self.regions}

    def _world(self) -> World:
        problem = self.problem
        return World(
            symbols=self.system.states,
            inputs=self.system.inputs,
            noise=self.noise,
            moved=self.moved,
            barriers=tuple(b.expression for b in problem.barriers),
            goal=problem.goal,
            regions=tuple(self._regions.values()),
            ranges=(*((v.low, v.high) for v in problem.states), *self.uncertain.values()),
        )
