"""A system under a backup law, held over control periods: its map, and bounds of its slopes.

Coordinates y of the states close under the law: their rate under the input of an instant y_0,
r(y, y_0) = f(y) + g(y) k(y_0), depends on nothing else. A control period is `substeps` classical
steps of Runge and Kutta of r(., y_0) from y_0, as the env integrates without noise.

The coordinates fall into blocks, of which each depends on itself and on blocks before it: a
quadrotor's attitude on itself, its altitude on both. For a block, the blocks before are a
disturbance within known bounds. The Jacobian D = dy/dy_0 of a block's map follows the stages of the
step, with dr = (dr/dy) D + dr/dy_0, evaluated on intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from sympy.utilities.iterables import strongly_connected_components

from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.intervals import IntervalFunction, interval_function
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.backup import BackupLaw
from safe_envs.wrappers.backup_sets.ball_matrices import (
    BallMatrix,
    enclosing,
    exactly,
    interval_of,
    plus,
    scaled,
    times,
)


@dataclass(frozen=True)
class HeldPeriod:
    """What a control period does to boxes of a block's coordinates.

    Attributes:
        after: holds the states after it, shape (B, n).
        within: holds the states at all stages of the integration, shape (n,).
        slope: holds the Jacobians of the states after it, shape (B, n, n).
    """

    after: Interval
    within: Interval
    slope: BallMatrix


@dataclass(frozen=True)
class Disturbance:
    """Bounds of the coordinates of the blocks before.

    Attributes:
        held: at control instants, shape (k,).
        within: at all stages of the integration, shape (k,).
    """

    held: Interval
    within: Interval


@dataclass(frozen=True)
class Block:
    """Coordinates that depend on each other, under the held law.

    Attributes:
        symbols: the n coordinates of the block.
        held: their symbols at the last control instant.
        outer: the k coordinates of the blocks before.
        outer_held: theirs at the last control instant.
        rest: the equilibrium, shape (n,).
        rate: the rates, of all these symbols.
        step: of the integration, in s.
        substeps: how many of them make a control period.
    """

    symbols: tuple[sp.Symbol, ...]
    held: tuple[sp.Symbol, ...]
    outer: tuple[sp.Symbol, ...]
    outer_held: tuple[sp.Symbol, ...]
    rest: np.ndarray
    rate: tuple[sp.Expr, ...]
    step: float
    substeps: int

    @property
    def _arguments(self) -> tuple[sp.Symbol, ...]:
        return (*self.symbols, *self.held, *self.outer, *self.outer_held)

    @cached_property
    def _derivatives(self) -> list[sp.Expr]:
        return [r.diff(s) for r in self.rate for s in (*self.symbols, *self.held)]

    @cached_property
    def _rates_and_slopes(self) -> IntervalFunction:
        return interval_function(self._arguments, [*self.rate, *self._derivatives])

    @cached_property
    def nonlinear(self) -> np.ndarray:
        """Which coordinates the Jacobian of the rate depends on, shape (n,)."""
        used = set().union(*(e.free_symbols for e in self._derivatives))
        return np.array([bool({s, h} & used) for s, h in zip(self.symbols, self.held, strict=True)])

    def period(self, y: Interval, disturbed: Disturbance) -> HeldPeriod:
        """Enclose what a control period does.

        Args:
            y: boxes of the state at the beginning, shape (B, n).
            disturbed: by the blocks before.

        Returns:
            Enclosures of the states after it and within it, and of the Jacobians.
        """
        n = len(self.symbols)
        now, h = enclosing(y), self.step
        slope = exactly(np.broadcast_to(np.eye(n), (len(y.low), n, n)))
        seen = []
        for _ in range(self.substeps):
            at, by, stages = now, slope, []
            for fraction in (0.5 * h, 0.5 * h, h, None):
                seen.append(interval_of(at))
                k, dk = self._stage(seen[-1], y, disturbed, by)
                stages.append((k, dk))
                if fraction is not None:
                    at, by = plus(now, scaled(fraction, k)), plus(slope, scaled(fraction, dk))
            for (k, dk), weight in zip(stages, (h / 6.0, h / 3.0, h / 3.0, h / 6.0), strict=True):
                # The error of a weight that is no float is below what `scaled` allows.
                now, slope = plus(now, scaled(weight, k)), plus(slope, scaled(weight, dk))
        lowest = np.min([each.low.min(axis=0) for each in seen], axis=0)
        highest = np.max([each.high.max(axis=0) for each in seen], axis=0)
        return HeldPeriod(interval_of(now), Interval(lowest, highest), slope)

    def _stage(
        self, y: Interval, held: Interval, disturbed: Disturbance, slope: BallMatrix
    ) -> tuple[BallMatrix, BallMatrix]:
        """Enclose the rate and its derivative by the state at the control instant."""
        n, boxes = len(self.symbols), len(y.low)
        values = [*columns(y), *columns(held), *columns(disturbed.within), *columns(disturbed.held)]
        found = stacked(self._rates_and_slopes(values), boxes)
        rate = Interval(*(end[:, :n] for end in found))
        by = enclosing(Interval(*(end[:, n:].reshape(boxes, n, 2 * n) for end in found)))
        own = BallMatrix(by.center[..., :n], by.radius[..., :n])
        of_input = BallMatrix(by.center[..., n:], by.radius[..., n:])
        return enclosing(rate), plus(times(own, slope), of_input)


@dataclass(frozen=True)
class HeldLaw:
    """Coordinates under a held law, without bounds of the input.

    Attributes:
        blocks: in an order in which each depends on blocks before it only.
        law: the inputs that the law gives near the equilibrium, of the coordinates.
        switches: expressions that are >= 0 where `law` is the law: the differences between the
            larger or smaller argument of a Max or a Min and the others.
    """

    blocks: tuple[Block, ...]
    law: tuple[sp.Expr, ...]
    switches: tuple[sp.Expr, ...]


def held_law(system: ControlAffineSDE, law: BackupLaw, step: float, substeps: int) -> HeldLaw:
    """Derive the map of the coordinates of a law's terminal set.

    Args:
        system: the dynamics.
        law: with an equilibrium.
        step: of the integration, in s.
        substeps: how many of them make a control period.

    Returns:
        The map, block by block, and what has to hold for it to be that of the law.

    Raises:
        SystemDefinitionError: the coordinates do not close under the law, or it jumps.
    """
    y = tuple(law.equilibrium)
    for entry in law.law:
        _require_closed(law, "the law itself", entry, (*y, *system.parameters))
    rest = {s: system.numeric(e) for s, e in law.equilibrium.items()}
    then = {s: sp.Dummy(f"{s.name}_0", real=True) for s in y}
    now = {h: s for s, h in then.items()}
    switches: list[sp.Expr] = []
    near: list[Any] = [_near(e, system, rest, switches) for e in law.law]
    effect = sp.Matrix(system.input_matrix) * sp.Matrix([e.subs(then) for e in near])
    rates = {}
    for s in y:
        i = system.states.index(s)
        # Expanded with its symbols: what cancels between the inputs cancels exactly.
        rates[s] = system.numeric(system.drift[i] + sp.expand(effect[i]))
        _require_closed(law, f"the rate of {s}", rates[s], (*y, *now))
        if rates[s].has(sp.atan2):  # Its slopes do not show where it jumps.
            raise SystemDefinitionError(
                f"the rate of {s} under backup law {law.name} holds atan2, which jumps; write it"
                " with atan, or state the terminal set in place of the equilibrium"
            )
    uses = [(s, now.get(t, t)) for s, r in rates.items() for t in r.free_symbols]
    blocks, before = [], ()
    for members in strongly_connected_components((list(y), uses)):
        own = tuple(s for s in y if s in members)
        blocks.append(
            Block(
                symbols=own,
                held=tuple(then[s] for s in own),
                outer=before,
                outer_held=tuple(then[s] for s in before),
                rest=np.array([float(rest[s]) for s in own]),
                rate=tuple(rates[s] for s in own),
                step=step,
                substeps=substeps,
            )
        )
        before = (*before, *own)
    return HeldLaw(
        tuple(blocks),
        tuple(system.numeric(e) for e in near),
        tuple(system.numeric(e) for e in switches),
    )


def columns(box: Interval) -> list[Interval]:
    """Return the coordinates of boxes one by one.

    Args:
        box: shape (B, n) or (n,).
    """
    return [Interval(box.low[..., i], box.high[..., i]) for i in range(box.low.shape[-1])]


def stacked(found: Sequence[Interval], boxes: int) -> Interval:
    """Return values of several functions on boxes as arrays (B, functions).

    Args:
        found: the values, one function after the other.
        boxes: B.
    """
    ends = [
        np.stack([np.broadcast_to(end, (boxes,)) for end in ends], axis=1)
        for ends in zip(*found, strict=True)
    ]
    return Interval(*ends)


def _require_closed(law: BackupLaw, what: str, e: Any, known: Sequence[sp.Symbol]) -> None:
    strange = ", ".join(sorted(str(each) for each in e.free_symbols - set(known)))
    if strange:
        raise SystemDefinitionError(
            f"equilibrium of backup law {law.name} names {', '.join(map(str, law.equilibrium))},"
            f" but {what} depends on {strange} too; name these states as well, or give a law and"
            " coordinates that form a system of their own"
        )


def _near(e: Any, system: ControlAffineSDE, rest: Any, switches: list[sp.Expr]) -> Any:
    """Return an expression with the argument of each Max and Min that counts at the equilibrium."""
    if not e.has(sp.Max, sp.Min):
        return e
    if not isinstance(e, sp.Max | sp.Min):
        return e.func(*(_near(part, system, rest, switches) for part in e.args))
    values = [float(system.numeric(part).subs(rest)) for part in e.args]
    at = int(np.argmax(values) if isinstance(e, sp.Max) else np.argmin(values))
    chosen = _near(e.args[at], system, rest, switches)
    sign = 1 if isinstance(e, sp.Max) else -1
    switches.extend(sign * (chosen - other) for k, other in enumerate(e.args) if k != at)
    return chosen
