"""The proof that a level set of a quadratic form is kept by a held law, safely and unclipped.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.intervals import IntervalFunction, interval_function
from safe_envs.dynamics.lie import has_kinks
from safe_envs.wrappers.backup_sets.ball_matrices import (
    BallMatrix,
    enclosing,
    exactly,
    frobenius,
    norm_bound,
    plus,
    scaled,
    times,
)
from safe_envs.wrappers.backup_sets.held_law import Block, Disturbance, columns, stacked

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
    """Return the cells without those that are surely outside of the ellipsoid.

    On a cell with the midpoint m and the half widths r, |L'(y - e)| >= |L'(m - e)| - | |L'| r |.
    """
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
