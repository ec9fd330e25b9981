"""The proof that a level set of a quadratic form is kept by a held law, safely and unclipped.

Let E = {y : |L'(y - e)|^2 <= c} with L invertible, F the map of a control period under the law k, and
q_1, q_2, ... functions that are to be >= 0: barriers, and the distances of k from the input bounds.

**Theorem.** Let M(y) = L' J(y) L'^-1 with the Jacobian J of F, |M(y)| <= rho for all y in E, and |L'
(F(e) - e)| <= d. If rho sqrt(c) + d <= sqrt(c), then F maps E into E. If q_i(e) >= sqrt(c) |L^-1 grad
q_i(y)| for all y in E, then q_i >= 0 on E.

*Proof.* E is convex. For y in E the segment from e to y is in E, so that F(y) - F(e) = A (y - e)
with the average A of J over it (the integral form of the mean value theorem). |L' A L'^-1| <= rho,
since a norm of an average is at most the largest norm. Hence |L'(F(y) - e)| <= rho |L'(y - e)| + d <=
sqrt(c). Likewise q_i(y) = q_i(e) + b'(y - e) with the average b of the gradient, and |b'(y - e)| =
|(L^-1 b)' L'(y - e)| <= |L^-1 b| sqrt(c). As k is within the input bounds on E, clipping changes
nothing there, and F is the map that is executed. QED

All is evaluated on cells that cover the bounding box of E, in arithmetic that is rounded outwards;
cells outside of E are left out. The gradients are taken on the whole box; where that does not show
q_i >= 0, the values of q_i on each cell may.

Rounding in the simulation itself is not part of the theorem; rho is asked to be smaller by a
billionth than needed, which is a million times what rounding moves a state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.intervals import IntervalFunction
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
from safe_envs.wrappers.backup_sets.closed_loop import ClosedLoop, box_values

_MARGIN = 1e-9
_MOST_CELLS = 4000


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
        defect = plus(
            exactly(np.eye(len(near))),
            scaled(-1.0, times(exactly(self.root.T), exactly(near))),
        )
        size = float(frobenius(defect))
        share = size / (1.0 - size) if size < 0.5 else np.inf
        error = share * float(frobenius(exactly(near)))
        return BallMatrix(near, np.full_like(near, error * (1.0 + 1e-12)))

    def half_widths(self) -> np.ndarray:
        """Return upper bounds of |y_i - e_i| on the set: sqrt(c) times the norms of rows."""
        w = self.inverse()
        rows = np.sqrt(((np.abs(w.center) + w.radius) ** 2).sum(axis=1))
        return np.sqrt(self.level) * rows * (1.0 + 1e-12)


@dataclass(frozen=True)
class Conditions:
    """Functions of the coordinates that are to be >= 0.

    Attributes:
        values: the q_i.
        slopes: their gradients, one after the other; NaN for a function with kinks.
        count: how many.
    """

    values: IntervalFunction
    slopes: IntervalFunction
    count: int

    def unsettled(self, e: Ellipsoid, inverse: BallMatrix, box: Interval) -> np.ndarray:
        """Return which of the functions their gradients do not show to be >= 0 on a set.

        Args:
            e: the set.
            inverse: L'^-1.
            box: that holds it, shape (1, n).
        """
        point = Interval(e.center[None, :], e.center[None, :])
        least = box_values(self.values, point, self.count).low[0]
        n = len(e.center)
        found = box_values(self.slopes, box, self.count * n)
        slopes = enclosing(Interval(*(end.reshape(self.count, n) for end in found)))
        # L^-1 b is the transpose of b' L'^-1.
        moved = times(slopes, inverse)
        reach = np.sqrt(((np.abs(moved.center) + moved.radius) ** 2).sum(axis=1))
        with np.errstate(invalid="ignore"):
            return ~(least >= np.sqrt(e.level) * reach * (1.0 + 1e-12))


def is_kept(loop: ClosedLoop, conditions: Conditions, e: Ellipsoid) -> bool:
    """Return whether the law is proved to keep an ellipsoid, safely and within the input bounds.

    Args:
        loop: the law's map.
        conditions: what is to be >= 0 in the set.
        e: the set.
    """
    half = e.half_widths()
    if not np.isfinite(half).all():
        return False
    inverse = e.inverse()
    cells = Interval((e.center - half)[None, :], (e.center + half)[None, :])
    unsettled = conditions.unsettled(e, inverse, cells)
    most = 1.0 - _MARGIN - _displacement(loop, e) / (np.sqrt(e.level) * (1.0 - 1e-12))
    nonlinear = loop.nonlinear | unsettled.any()
    while True:
        slope = _seen_by(e, inverse, loop.period(cells)[1])
        values = box_values(conditions.values, cells, conditions.count).low
        good = (norm_bound(slope) <= most) & ((values >= 0.0) | ~unsettled).all(axis=1)
        if good.all():
            return True
        if not nonlinear.any() or 2 * (~good).sum() > _MOST_CELLS:
            return False
        cells = _meeting(e, _bisected(cells, ~good, half, nonlinear))
        if not len(cells.low):
            return True
        if _fails_somewhere(loop, conditions, e, inverse, cells, most):
            return False


def _displacement(loop: ClosedLoop, e: Ellipsoid) -> float:
    """Return an upper bound of |L'(F(e) - e)|."""
    point = Interval(e.center[None, :], e.center[None, :])
    after = enclosing(loop.period(point)[0])
    moved = plus(after, exactly(-e.center[None, :]))
    return float(frobenius(times(moved, exactly(e.root))))


def _seen_by(e: Ellipsoid, inverse: BallMatrix, slope: BallMatrix) -> BallMatrix:
    """Return M = L' J L'^-1."""
    return times(times(exactly(e.root.T), slope), inverse)


def _bisected(
    cells: Interval, which: np.ndarray, half: np.ndarray, nonlinear: np.ndarray
) -> Interval:
    """Return some of the cells, each cut into two across its widest coordinate."""
    low, high = cells.low[which], cells.high[which]
    widths = np.where(nonlinear, (high - low) / half, -1.0)
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
    loop: ClosedLoop,
    conditions: Conditions,
    e: Ellipsoid,
    inverse: BallMatrix,
    cells: Interval,
    most: float,
) -> bool:
    """Return whether the claim is false at the middle of a cell in E, so that cutting is vain."""
    middle = 0.5 * cells.low + 0.5 * cells.high
    middle = middle[np.linalg.norm((middle - e.center) @ e.root, axis=1) <= np.sqrt(e.level)]
    if not len(middle):
        return False
    points = Interval(middle, middle)
    norms = norm_bound(_seen_by(e, inverse, loop.period(points)[1]))
    values = box_values(conditions.values, points, conditions.count).low
    return bool((norms > most).any() or (values < 0.0).any())
