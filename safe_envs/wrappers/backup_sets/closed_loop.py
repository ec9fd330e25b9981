"""A system under a backup law, held over control periods: its map, and bounds of its slopes.

Coordinates y of the states close under the law: their rate under the input of an instant y_0,
r(y, y_0) = f(y) + g(y) k(y_0), depends on nothing else. A control period is `substeps` classical
steps of Runge and Kutta of r(., y_0) from y_0, as the env integrates without noise. The Jacobian D
= dy/dy_0 follows the same stages, with dr = (dr/dy) D + dr/dy_0, evaluated on intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

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
class ClosedLoop:
    """Coordinates under a held law, without bounds of the input.

    Attributes:
        symbols: the n coordinates y.
        held: the symbols of y_0.
        rest: the equilibrium, shape (n,).
        rate: r(y, y_0).
        law: the inputs that the law gives near the equilibrium, of y.
        switches: expressions of y that are >= 0 where `law` is the law: the differences between the
            larger or smaller argument of a Max or a Min and the others.
        step: of the integration, in s.
        substeps: how many of them make a control period.
    """

    symbols: tuple[sp.Symbol, ...]
    held: tuple[sp.Symbol, ...]
    rest: np.ndarray
    rate: tuple[sp.Expr, ...]
    law: tuple[sp.Expr, ...]
    switches: tuple[sp.Expr, ...]
    step: float
    substeps: int

    @cached_property
    def _rates(self) -> IntervalFunction:
        return interval_function((*self.symbols, *self.held), self.rate)

    @cached_property
    def _slopes(self) -> IntervalFunction:
        known = (*self.symbols, *self.held)
        return interval_function(known, [r.diff(s) for r in self.rate for s in known])

    @cached_property
    def nonlinear(self) -> np.ndarray:
        """Which coordinates the Jacobian of the rate depends on, shape (n,)."""
        pairs = list(zip(self.symbols, self.held, strict=True))
        known = (*self.symbols, *self.held)
        used: set[sp.Symbol] = set()
        for slope in (r.diff(s) for r in self.rate for s in known):
            used |= slope.free_symbols
        return np.array([bool(used & set(pair)) for pair in pairs])

    def period(self, y: Interval) -> tuple[Interval, BallMatrix]:
        """Enclose the state after a control period, and its Jacobian, on boxes.

        Args:
            y: boxes of the state at the beginning, shape (B, n).

        Returns:
            Boxes (B, n) that hold the states, and matrices (B, n, n) that hold the Jacobians.
        """
        n = len(self.symbols)
        now = enclosing(y)
        slope = exactly(np.broadcast_to(np.eye(n), (len(y.low), n, n)))
        h, held = self.step, y
        for _ in range(self.substeps):
            stages = [self._stage(interval_of(now), held, slope)]
            for fraction in (0.5 * h, 0.5 * h, h):
                k, dk = stages[-1]
                at = plus(now, scaled(fraction, k))
                stages.append(self._stage(interval_of(at), held, plus(slope, scaled(fraction, dk))))
            for i, weight in enumerate((h / 6.0, h / 3.0, h / 3.0, h / 6.0)):
                # h/6 and h/3 are floats near them: a relative error of an ulp is in `scaled`.
                now = plus(now, scaled(weight, stages[i][0]))
                slope = plus(slope, scaled(weight, stages[i][1]))
        return interval_of(now), slope

    def _stage(
        self, y: Interval, held: Interval, slope: BallMatrix
    ) -> tuple[BallMatrix, BallMatrix]:
        """Enclose r and dr/dy_0 on boxes."""
        values = [*_columns(y), *_columns(held)]
        n, boxes = len(self.symbols), len(y.low)
        rate = _stacked(self._rates(values), boxes)
        parts = _stacked(self._slopes(values), boxes)
        by = enclosing(Interval(*(end.reshape(boxes, n, 2 * n) for end in parts)))
        own = BallMatrix(by.center[..., :n], by.radius[..., :n])
        of_input = BallMatrix(by.center[..., n:], by.radius[..., n:])
        return enclosing(rate), plus(times(own, slope), of_input)


def closed_loop(system: ControlAffineSDE, law: BackupLaw, step: float, substeps: int) -> ClosedLoop:
    """Derive the map of the coordinates of a law's terminal set.

    Args:
        system: the dynamics.
        law: with an equilibrium.
        step: of the integration, in s.
        substeps: how many of them make a control period.

    Raises:
        SystemDefinitionError: the coordinates do not close under the law.
    """
    y = tuple(law.equilibrium)
    rest = {s: system.numeric(e) for s, e in law.equilibrium.items()}
    held = tuple(sp.Dummy(f"{s.name}_0", real=True) for s in y)
    switches: list[sp.Expr] = []
    near: list[Any] = [_near(e, system, rest, switches) for e in law.law]
    then = dict(zip(y, held, strict=True))
    effect = sp.Matrix(system.input_matrix) * sp.Matrix([e.subs(then) for e in near])
    rate = []
    for s in y:
        i = system.states.index(s)
        # Expanded with its symbols: what cancels between the inputs cancels exactly.
        entry = system.numeric(system.drift[i] + sp.expand(effect[i]))
        rate.append(entry)
        strange = entry.free_symbols - {*y, *held}
        if strange:
            names = ", ".join(sorted(str(each) for each in strange))
            raise SystemDefinitionError(
                f"equilibrium of backup law {law.name} names {', '.join(map(str, y))}, but under"
                f" the law the rate of {s} depends on {names} too; name these states as well"
            )
    return ClosedLoop(
        symbols=y,
        held=held,
        rest=np.array([float(rest[s]) for s in y]),
        rate=tuple(rate),
        law=tuple(system.numeric(e) for e in near),
        switches=tuple(system.numeric(e) for e in switches),
        step=step,
        substeps=substeps,
    )


def box_values(function: IntervalFunction, box: Interval, count: int) -> Interval:
    """Return the values of several functions on boxes, shape (B, count).

    Args:
        function: of n coordinates.
        box: shape (B, n).
        count: how many functions.
    """
    found = _stacked(function(_columns(box)), len(box.low))
    return Interval(*(end.reshape(len(box.low), count) for end in found))


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
    for k, other in enumerate(e.args):
        if k != at:
            switches.append(system.numeric(sign * (chosen - other)))
    return chosen


def _columns(box: Interval) -> list[Interval]:
    return [Interval(box.low[:, i], box.high[:, i]) for i in range(box.low.shape[1])]


def _stacked(found: Sequence[Interval], boxes: int) -> Interval:
    ends = [
        np.stack([np.broadcast_to(end, (boxes,)) for end in ends], axis=1)
        for ends in zip(*found, strict=True)
    ]
    return Interval(*ends)
