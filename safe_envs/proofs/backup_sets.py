"""Terminal sets of backup laws, and the proof that they are kept.

The shape of a set comes from a Lyapunov equation, its size from the proof: the largest level that
is proved within the extent that the law gives.

**Shape.** With the Jacobian A of a block's control period at the equilibrium, and the extents w, P
= LL' = sum_k (A/r)'^k Q (A/r)^k with Q = diag(1/w^2). As (A/r)' P (A/r) = P - Q <= P, A contracts
by r < 1 in the norm of P. Several r between the spectral radius of A and 1 are tried. Where A has a
basis of eigenvectors, P = sum_i |a_i|^2/s_i^2 is tried too, with a_i the parts of y along them and
s_i how far each reaches within the extents: it does not cut slow directions short. The set of the
largest volume is taken.

Let E = {y : |L'(y - e)|^2 <= c} with L invertible, F_d the map of a control period under the law k
while the blocks before move as d, for d in their bounds, and q_1, q_2, ... functions of y and d
that are to be >= 0: barriers, and the distances of k from the input bounds.

**Theorem.** Let |L' J L'^-1| <= rho for the Jacobians J of F_d on E, and |L'(F_d(e) - e)| <= s. If
rho sqrt(c) + s <= sqrt(c), then F_d maps E into E. If q_i(e, d) >= sqrt(c) |L^-1 b| for the
gradients b of q_i by y on E, then q_i >= 0 on E.

*Proof.* E is convex. For y in E the segment from e to y is in E, so that F_d(y) - F_d(e) = A (y -
e) with the average A of the Jacobian over it (the integral form of the mean value theorem). |L' A
L'^-1| <= rho, since the norm of an average is at most the largest norm. Hence |L'(F_d(y) - e)| <=
rho |L'(y - e)| + s <= sqrt(c). Likewise q_i(y, d) = q_i(e, d) + b'(y - e) with the average b of the
gradient, and |b'(y - e)| = |(L^-1 b)' L'(y - e)| <= |L^-1 b| sqrt(c). QED

Block by block, the product of such sets is kept: the blocks before stay in theirs whatever this one
does, so that d is within its bounds for good. As k is within the input bounds there, clipping
changes nothing, and F is what is executed.

All is evaluated on cells that cover the bounding box of E, in arithmetic that is rounded outwards;
cells outside of E are left out. The gradients are taken on the whole box; where that does not show
q_i >= 0, the values of q_i on each cell may. Rounding in the simulation itself is not part of the
theorem; rho is asked to be smaller by a billionth than needed, a million times what rounding moves
a state.

Coordinates y of the states close under the law: their rate under the input of an instant y_0,
r(y, y_0) = f(y) + g(y) k(y_0), depends on nothing else. A control period is `substeps` classical
steps of Runge and Kutta of r(., y_0) from y_0, as the env integrates without noise.

The coordinates fall into blocks, of which each depends on itself and on blocks before it: a
quadrotor's attitude on itself, its altitude on both. For a block, the blocks before are a
disturbance within known bounds. The Jacobian D = dy/dy_0 of a block's map follows the stages of the
step, with dr = (dr/dy) D + dr/dy_0, evaluated on intervals.

A ball matrix [C - R, C + R] holds every matrix that differs from C by at most R, entry by entry.
Products are enclosed by |AB - A_c B_c| <= |A_c| B_r + A_r (|B_c| + B_r), and what rounding adds.

Rounding: a computed sum of n products is off by at most n u/(1 - n u) times the sum of their
absolute values, u = 2^-53, in whatever order it is added (Higham 2002, Sec. 3.1). All bounds here
allow a multiple of that. Numbers so small that products underflow are covered by `_TINY`.

Source: Rump 1999, "Fast and parallel interval arithmetic".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from sympy.utilities.iterables import strongly_connected_components

from safe_envs.dynamics.lie import has_kinks
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.enclosures.intervals import Interval, IntervalFunction, interval_function
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.backup import Backup, BackupLaw, backup_of

_ULP = 2.0**-52
_TINY = 1e-290
_MORE = 1.0 + 1e-13
_QUIET = np.errstate(invalid="ignore", over="ignore")
"""What is infinite or NaN says that nothing is known."""


class BallMatrix(NamedTuple):
    """Matrices within a radius of a center, entry by entry; shapes (..., n, m)."""

    center: np.ndarray
    radius: np.ndarray


@_QUIET
def enclosing(a: Interval) -> BallMatrix:
    """Return the ball matrix that holds an interval of matrices; NaN where nothing is known."""
    center = 0.5 * a.low + 0.5 * a.high
    radius = np.maximum(a.high - center, center - a.low) * _MORE
    return BallMatrix(center, radius + _ULP * np.abs(center) + _TINY)


@_QUIET
def interval_of(a: BallMatrix) -> Interval:
    """Return the interval that holds a ball matrix; the whole line where nothing is known."""
    radius = a.radius * _MORE + _ULP * np.abs(a.center) + _TINY
    unknown = np.isnan(a.center + radius)
    return Interval(
        np.where(unknown, -np.inf, a.center - radius), np.where(unknown, np.inf, a.center + radius)
    )


@_QUIET
def plus(a: BallMatrix, b: BallMatrix) -> BallMatrix:
    """Return a + b.

    Args:
        a: shapes (..., n, m).
        b: likewise.
    """
    center = a.center + b.center
    return BallMatrix(center, (a.radius + b.radius) * _MORE + _ULP * np.abs(center) + _TINY)


@_QUIET
def scaled(factor: float, a: BallMatrix) -> BallMatrix:
    """Return the product of a float and a ball matrix.

    Args:
        factor: the float.
        a: the matrices.
    """
    center = factor * a.center
    return BallMatrix(center, abs(factor) * a.radius * _MORE + 2 * _ULP * np.abs(center) + _TINY)


@_QUIET
def times(a: BallMatrix, b: BallMatrix) -> BallMatrix:
    """Return the matrix product a b; NaN where nothing is known of a factor.

    Args:
        a: shapes (..., n, k).
        b: shapes (..., k, m).
    """
    center = a.center @ b.center
    sizes = np.abs(a.center), np.abs(b.center)
    rounding = 4 * a.center.shape[-1] * _ULP * (sizes[0] @ sizes[1])
    radius = sizes[0] @ b.radius + a.radius @ (sizes[1] + b.radius) + rounding
    return BallMatrix(center, radius * _MORE + _TINY)


def exactly(a: np.ndarray) -> BallMatrix:
    """Return the ball matrix of one matrix."""
    return BallMatrix(a, np.zeros_like(a))


@_QUIET
def norm_bound(a: BallMatrix) -> np.ndarray:
    """Return an upper bound of the largest singular value of every matrix in a.

    With computed factors U, s, V of the center, |C| <= |U| max(s) |V| + |C - U diag(s) V|, and
    |U|^2 <= 1 + |U'U - I|: nothing depends on how the factors were found.

    Args:
        a: shapes (..., n, m).

    Returns:
        Shape (...); infinite where a is not finite.
    """
    finite = np.asarray(np.isfinite(a.center + a.radius).all(axis=(-2, -1), keepdims=True))
    center = np.where(finite, a.center, 0.0)
    left, s, right = np.linalg.svd(center, full_matrices=False)
    product = times(exactly(left * s[..., None, :]), exactly(right))
    rest = plus(exactly(center), scaled(-1.0, product))
    slack = rest.radius + 4 * _ULP * np.abs(left * s[..., None, :]) @ np.abs(right)
    of_rest = frobenius(BallMatrix(rest.center, slack))
    bound = s.max(axis=-1) * _stretch(left) * _stretch(np.swapaxes(right, -1, -2)) + of_rest
    bound = (bound + frobenius(a, of_radius=True)) * _MORE + _TINY
    return np.where(finite[..., 0, 0], bound, np.inf)


@_QUIET
def frobenius(a: BallMatrix, of_radius: bool = False) -> np.ndarray:
    """Return an upper bound of the Frobenius norm of every matrix in a.

    Args:
        a: shapes (..., n, m).
        of_radius: of the differences from the center only.
    """
    sizes = a.radius if of_radius else np.abs(a.center) + a.radius
    return np.sqrt((sizes**2).sum(axis=(-2, -1))) * _MORE + _TINY


def _stretch(factor: np.ndarray) -> np.ndarray:
    """Return an upper bound of the norm of matrices whose columns are nearly orthonormal."""
    gram = times(exactly(np.swapaxes(factor, -1, -2)), exactly(factor))
    defect = frobenius(plus(gram, exactly(-np.eye(factor.shape[-1]))))
    return np.sqrt(1.0 + defect) * _MORE


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


_MARGIN = 1e-9
_MOST_CELLS = 512
_UP = 1.0 + 1e-12
_NO_SLOPE = sp.Float(1e100)


@dataclass(frozen=True)
class Ellipsoid:
    """{y : |L'(y - e)|^2 <= c}.

    Attributes:
        center: e, shape (n,).
        root: L, shape (n, n).
        level: c.
    """

    center: np.ndarray
    root: np.ndarray
    level: float

    def inverse(self) -> BallMatrix:
        """Enclose L'^-1.

        With W near it and E = I - L' W, L'^-1 - W = W E (I - E)^-1.
        """
        near = np.linalg.inv(self.root.T)
        product = times(exactly(self.root.T), exactly(near))
        size = float(frobenius(plus(exactly(np.eye(len(near))), scaled(-1.0, product))))
        share = size / (1.0 - size) if size < 0.5 else np.inf
        return BallMatrix(near, np.full_like(near, share * float(frobenius(exactly(near))) * _UP))

    def box(self) -> Interval:
        """Return the bounding box, shape (n,).

        |y_i - e_i| <= sqrt(c) |L^-1 b_i| with the unit vectors b_i.
        """
        w = self.inverse()
        rows = np.sqrt(((np.abs(w.center) + w.radius) ** 2).sum(axis=1))
        half = np.sqrt(self.level) * rows * _UP + 1e-15 * np.abs(self.center)
        return Interval(self.center - half, self.center + half)


class Conditions:
    """Functions of a block's coordinates and of those of the blocks before, which are to be >= 0.

    Attributes:
        count: how many.
    """

    def __init__(self, block: Block, expressions: Sequence[Any]) -> None:
        """Compile the functions.

        Args:
            block: the block.
            expressions: of its coordinates and those before.
        """
        symbols = (*block.symbols, *block.outer)
        self.count, self._n = len(expressions), len(block.symbols)
        slopes = [
            _NO_SLOPE if _has_kinks_in(e, block.symbols) else e.diff(s)
            for e in expressions
            for s in block.symbols
        ]
        self._values: IntervalFunction = interval_function(symbols, expressions)
        self._slopes: IntervalFunction = interval_function(symbols, slopes)

    def least(self, cells: Interval, disturbed: Disturbance) -> np.ndarray:
        """Return lower bounds on cells, shape (B, count).

        Args:
            cells: shape (B, n).
            disturbed: bounds of the blocks before.
        """
        if not self.count:
            return np.zeros((len(cells.low), 0))
        found = self._values([*columns(cells), *columns(disturbed.held)])
        return stacked(found, len(cells.low)).low

    def unsettled(self, e: Ellipsoid, box: Interval, disturbed: Disturbance) -> np.ndarray:
        """Return which of the functions their gradients do not show to be >= 0 on a set.

        Args:
            e: the set.
            box: that holds it, shape (1, n).
            disturbed: the bounds of the blocks before.
        """
        if not self.count:
            return np.zeros(0, dtype=bool)
        least = self.least(Interval(e.center[None, :], e.center[None, :]), disturbed)[0]
        found = stacked(self._slopes([*columns(box), *columns(disturbed.held)]), 1)
        slopes = enclosing(Interval(*(end.reshape(self.count, self._n) for end in found)))
        # L^-1 b is the transpose of b' L'^-1.
        moved = times(slopes, e.inverse())
        reach = np.sqrt(((np.abs(moved.center) + moved.radius) ** 2).sum(axis=1))
        with np.errstate(invalid="ignore"):
            return ~(least >= np.sqrt(e.level) * reach * _UP)


def is_kept(block: Block, conditions: Conditions, e: Ellipsoid, disturbed: Disturbance) -> bool:
    """Return whether the law is proved to keep an ellipsoid, safely and within the input bounds.

    Args:
        block: the law's map.
        conditions: what is to be >= 0 in the set.
        e: the set.
        disturbed: bounds of the blocks before.
    """
    low, high = e.box()
    if not (np.isfinite(low) & np.isfinite(high)).all():
        return False
    inverse, cells = e.inverse(), Interval(low[None, :], high[None, :])
    unsettled = conditions.unsettled(e, cells, disturbed)
    moved = _displacement(block, e, disturbed)
    most = 1.0 - _MARGIN - moved / (np.sqrt(e.level) * (1.0 - 1e-12))
    cut = block.nonlinear | unsettled.any()
    while len(cells.low):
        slope = _seen_by(e, inverse, block.period(cells, disturbed).slope)
        settled = (conditions.least(cells, disturbed) >= 0.0) | ~unsettled
        bad = ~((norm_bound(slope) <= most) & settled.all(axis=1))
        if not bad.any():
            return True
        if not cut.any() or 2 * bad.sum() > _MOST_CELLS:
            return False
        cells = _meeting(e, _bisected(Interval(cells.low[bad], cells.high[bad]), high - low, cut))
        if _fails_somewhere(block, e, inverse, cells, disturbed, most):
            return False
    return True


def _has_kinks_in(e: Any, symbols: Sequence[sp.Symbol]) -> bool:
    """Return whether a function has kinks in some of its symbols, or may jump."""
    return any(
        part.free_symbols & set(symbols)
        and (
            isinstance(part, sp.Piecewise | sp.atan2)
            or has_kinks(part.func(*(sp.Dummy() for _ in part.args)))
        )
        for part in e.atoms(sp.Function, sp.Max, sp.Min)
    )


def _displacement(block: Block, e: Ellipsoid, disturbed: Disturbance) -> float:
    """Return an upper bound of |L'(F_d(e) - e)|."""
    point = Interval(e.center[None, :], e.center[None, :])
    after = enclosing(block.period(point, disturbed).after)
    moved = plus(after, exactly(-e.center[None, :]))
    return float(frobenius(times(moved, exactly(e.root))))


def _seen_by(e: Ellipsoid, inverse: BallMatrix, slope: BallMatrix) -> BallMatrix:
    """Return L' J L'^-1."""
    return times(times(exactly(e.root.T), slope), inverse)


def _bisected(cells: Interval, width: np.ndarray, cut: np.ndarray) -> Interval:
    """Return the cells, each cut into two across its widest coordinate."""
    low, high = cells
    widths = np.where(cut, (high - low) / width, -1.0)
    rows, across = np.arange(len(low)), widths.argmax(axis=1)
    middle = 0.5 * low[rows, across] + 0.5 * high[rows, across]
    lower, upper = high.copy(), low.copy()
    lower[rows, across] = upper[rows, across] = middle
    return Interval(np.concatenate([low, upper]), np.concatenate([lower, high]))


def _meeting(e: Ellipsoid, cells: Interval) -> Interval:
    """Return the cells without those that are surely outside of the ellipsoid."""
    # On a cell with the midpoint m and the half widths r, |L'(y - e)| >= |L'(m - e)| - | |L'| r |.
    middle = 0.5 * cells.low + 0.5 * cells.high
    radius = np.maximum(cells.high - middle, middle - cells.low)
    distance = np.linalg.norm((middle - e.center) @ e.root, axis=1)
    reach = np.linalg.norm(radius @ np.abs(e.root), axis=1)
    near = distance - reach <= np.sqrt(e.level) + 1e-9 * (distance + reach)
    return Interval(cells.low[near], cells.high[near])


def _fails_somewhere(
    block: Block,
    e: Ellipsoid,
    inverse: BallMatrix,
    cells: Interval,
    disturbed: Disturbance,
    most: float,
) -> bool:
    """Return whether the map does not contract at the middle of a cell: cutting is vain then."""
    middle = 0.5 * cells.low + 0.5 * cells.high
    middle = middle[np.linalg.norm((middle - e.center) @ e.root, axis=1) <= np.sqrt(e.level)]
    if not len(middle):
        return False
    slope = block.period(Interval(middle, middle), disturbed).slope
    return bool((norm_bound(_seen_by(e, inverse, slope)) > most).any())


_SHARES = (0.2, 0.45, 0.7)
_SHRINKING = (1.0, 0.5, 0.25, 0.125)
_LEAST = 1e-4
_CLOSE = 1.1
_WORST_CONDITION = 1e4
_WIDTHS = (1e-30, 1e30)

BlockSet = tuple[tuple[sp.Symbol, ...], Ellipsoid]
"""Coordinates of a block, and the set that they stay in."""


def with_terminal_sets(
    problem: Any, system: ControlAffineSDE, margin: float = 0.0
) -> Backup | None:
    """Return the backup of a problem, each law with its terminal set as an expression.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed: its plant or its model.
        margin: which the barriers keep in sets that are derived.

    Returns:
        The backup with laws and terminal sets of the states alone, numbers in place of parameters;
        None if the problem states none.

    Raises:
        SystemDefinitionError: a law does not fit what its equilibrium claims.
        ConfigurationError: no set around an equilibrium could be proved.
    """
    stated = backup_of(problem)
    if stated is None:
        return None
    laws = tuple(
        BackupLaw(
            law.name,
            tuple(system.numeric(e) for e in law.law),
            system.numeric(law.terminal)
            if law.terminal is not None
            else sp.Min(*(_of_block(*kept) for kept in derived_sets(problem, system, law, margin))),
        )
        for law in stated.laws
    )
    return replace(stated, laws=laws)


def derived_sets(
    problem: Any, system: ControlAffineSDE, law: BackupLaw, margin: float = 0.0
) -> tuple[BlockSet, ...]:
    """Return sets around a law's equilibrium, whose product is proved to be kept.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed.
        law: with an equilibrium.
        margin: that no barrier falls below in the sets.

    Raises:
        SystemDefinitionError: the coordinates of the equilibrium do not close, a barrier needs
            others, or one without a finite workspace has no extent.
        ConfigurationError: the law does not hold the equilibrium, or nothing could be proved.
    """
    widths = {v.symbol: 0.5 * (v.high - v.low) for v in problem.states}
    extent = {s: law.extent.get(s, widths[s]) for s in law.equilibrium}
    endless = [str(s) for s, width in extent.items() if not math.isfinite(width)]
    if endless:
        raise SystemDefinitionError(
            f"backup law {law.name} needs an extent of {', '.join(endless)}, whose workspace is"
            " unbounded: say how far its terminal set may reach, like extent={x: 0.5}"
        )
    if not all(_WIDTHS[0] <= width <= _WIDTHS[1] for width in extent.values()):
        raise ConfigurationError(
            f"extent of backup law {law.name} = {extent}; give numbers in [{_WIDTHS[0]:g},"
            f" {_WIDTHS[1]:g}], in other units if need be"
        )
    return _derived(
        system,
        (law.name, law.law, tuple(law.equilibrium.items())),
        tuple(extent.items()),
        tuple(b.expression - sp.Float(margin, 17) for b in problem.barriers)
        if margin
        else tuple(b.expression for b in problem.barriers),
        problem.input_bounds,
        (problem.dt / problem.substeps, problem.substeps),
    )


def _of_block(symbols: Sequence[sp.Symbol], e: Ellipsoid) -> Any:
    """Return 1 - |L'(y - e)|^2/c, with the floats as they are."""
    away = [s - sp.Float(c, 17) for s, c in zip(symbols, e.center.tolist(), strict=True)]
    scale = sp.Float(1.0 / math.sqrt(e.level), 17)
    rows = [
        sum(scale * sp.Float(r, 17) * d for r, d in zip(column, away, strict=True) if r)
        for column in e.root.T.tolist()
    ]
    return 1 - sum(row**2 for row in rows)


@lru_cache(maxsize=64)
def _derived(
    system: ControlAffineSDE,
    stated: tuple[str, tuple[sp.Expr, ...], tuple[tuple[sp.Symbol, sp.Expr], ...]],
    extents: tuple[tuple[sp.Symbol, float], ...],
    barriers: tuple[sp.Expr, ...],
    box: tuple[tuple[float, float], ...],
    timing: tuple[float, int],
) -> tuple[BlockSet, ...]:
    name, laws, equilibrium = stated
    loop = held_law(system, BackupLaw(name, laws, None, dict(equilibrium)), *timing)
    expressions: list[Any] = [*barriers, *loop.switches]
    for entry, (low, high) in zip(loop.law, box, strict=True):
        expressions += [entry - sp.Float(low, 17), sp.Float(high, 17) - entry]
    known = tuple(s for s, _ in equilibrium)
    for e in expressions:
        what = f"what the terminal set of backup law {name} has to keep,"
        system.require_known(what, e.free_symbols, known)
    checked = []
    for block in reversed(loop.blocks):  # A condition belongs to the last block that is in it.
        own = [e for e in expressions if e.free_symbols & set(block.symbols)]
        expressions = [e for e in expressions if e not in own]
        checked.append((block, Conditions(block, own)))
    if not all(float(e) >= 0.0 for e in expressions):  # These are constants.
        raise _unproved(name, equilibrium)
    for shrinking in _SHRINKING:
        found = _product(checked[::-1], {s: shrinking * w for s, w in extents}, name)
        if found is not None:
            return found
    raise _unproved(name, equilibrium)


def _unproved(name: str, equilibrium: Sequence[tuple[sp.Symbol, Any]]) -> ConfigurationError:
    return ConfigurationError(
        f"backup law {name} could not be proved to keep any set around its equilibrium"
        f" {dict(equilibrium)}; look whether it is one, whether it is safe and within the input"
        " bounds, and whether the law holds it with this control period"
    )


def _product(
    blocks: Sequence[tuple[Block, Conditions]], extent: dict[sp.Symbol, float], name: str
) -> tuple[BlockSet, ...] | None:
    """Return sets of the blocks, each within an extent; None where one could not be proved."""
    nothing = Interval(np.zeros(0), np.zeros(0))
    disturbed, sets = Disturbance(nothing, nothing), []
    for block, conditions in blocks:
        widths = np.array([extent[s] for s in block.symbols])
        e = _largest(block, conditions, disturbed, widths, name)
        if e is None:
            return None
        sets.append((block.symbols, e))
        box = e.box()
        within = block.period(Interval(box.low[None, :], box.high[None, :]), disturbed).within
        disturbed = Disturbance(_joined(disturbed.held, box), _joined(disturbed.within, within))
    return tuple(sets)


def _largest(
    block: Block, conditions: Conditions, disturbed: Disturbance, widths: np.ndarray, name: str
) -> Ellipsoid | None:
    """Return the set of the largest volume that is proved; None without any."""
    point = Interval(block.rest[None, :], block.rest[None, :])
    a = block.period(point, disturbed).slope.center[0]
    if not np.isfinite(a).all():
        return None
    radius = float(abs(np.linalg.eigvals(a)).max())
    if not radius < 1.0:
        raise ConfigurationError(
            f"backup law {name} does not bring {', '.join(map(str, block.symbols))} back to the"
            f" equilibrium: held for control periods, deviations are multiplied by {radius:.4g} in"
            " each; give a law that brings them back, or a shorter dt"
        )
    if (conditions.least(point, disturbed) < 0.0).any():
        return None
    best: tuple[float, Ellipsoid] | None = None
    for p, root in _with_roots(_shapes(a, radius, widths)):
        most = float((widths**2 / np.diag(np.linalg.inv(p))).min())
        level = _largest_level(block, conditions, disturbed, root, most)
        if level is not None:
            volume = 0.5 * len(root) * math.log(level) - float(np.linalg.slogdet(root)[1])
            if best is None or volume > best[0]:
                best = volume, Ellipsoid(block.rest, root, level)
    return None if best is None else best[1]


def _shapes(a: np.ndarray, radius: float, widths: np.ndarray) -> list[np.ndarray]:
    """Return forms P in whose norms a map contracts."""
    from scipy.linalg import solve_discrete_lyapunov

    shapes = []
    for share in _SHARES:
        scale = radius + share * (1.0 - radius)
        shapes.append(solve_discrete_lyapunov((a / scale).T, np.diag(1.0 / widths**2)))
    right = np.linalg.eig(a)[1]
    if np.linalg.cond(right / widths[:, None]) < _WORST_CONDITION:
        sizes = (widths[:, None] / np.maximum(np.abs(right), 1e-300)).min(axis=0)
        modes = np.linalg.inv(right * sizes)
        shapes.append((modes.conj().T @ modes).real)
    return [0.5 * (p + p.T) for p in shapes]


def _with_roots(shapes: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield P and L of each P = LL' that has an L in floating point."""
    for p in shapes:
        with suppress(np.linalg.LinAlgError):
            yield p, np.linalg.cholesky(p)


def _largest_level(
    block: Block, conditions: Conditions, disturbed: Disturbance, root: np.ndarray, most: float
) -> float | None:
    """Return the largest level up to a given one that is proved, to a tenth; None without any."""

    def proved(level: float) -> bool:
        return is_kept(block, conditions, Ellipsoid(block.rest, root, level), disturbed)

    if proved(most):
        return most
    low, high = 0.0, most
    level = 0.25 * most
    while high > _CLOSE * low:
        if proved(level):
            low = level
        elif level < _LEAST * most:
            return None
        else:
            high = level
        level = math.sqrt(low * high) if low else 0.25 * high
    return low


def _joined(a: Interval, b: Interval) -> Interval:
    return Interval(np.concatenate([a.low, b.low]), np.concatenate([a.high, b.high]))
