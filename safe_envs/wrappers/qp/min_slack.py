"""The least sum of squared slacks of constraints on two inputs, for a batch of states.

The sum is convex and piecewise quadratic. A Newton step goes to the minimiser, over the input
bounds, of the quadratic that the constraints violated now define; the sum is then minimised along
the step. Near the minimiser the violated constraints no longer change and the step is exact. A
state is done when the forces of the constraints, slack times coefficient, balance with those of the
input bounds.

Constraints count in their own units, so that one may be 1e9 times as steep as another: its slack at
the minimiser is then below the rounding of its margin, and it acts as a wall. What the other
constraints ask for along the wall must not drown in its rounding. Hence the frame of a step is that
of the steepest constraint, and a force is known as an interval, judged along the walls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.qp import bounded_least_squares, interval
from safe_envs.wrappers.qp.rounding import ROUNDING, total

_STEPS = 20
_SURELY = 100.0
"""A constraint violated by so many times its rounding surely has a slack: one that binds may
be violated by a few."""
_FAR = 1e150
"""A line further off than this meets no box. How far does not matter, and its square would
overflow."""


class _Rows(NamedTuple):
    """Constraints x u_1 + y u_2 + r in units of the steepest (k, B), bounds and inputs (2, B)."""

    x: np.ndarray
    y: np.ndarray
    r: np.ndarray
    low: np.ndarray
    high: np.ndarray
    u: np.ndarray

    def take(self, states: np.ndarray) -> _Rows:
        return _Rows(*[part[:, states] for part in self])


def least_violating(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """Minimise sum_i priority_i max(0, -(a_i . u + b_i))^2 over a box of two inputs.

    Args:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        low: lower bounds, shape (2, B).
        high: upper bounds, shape (2, B).
        priority: positive weights, shape (k,).
        start: inputs to begin with, shape (2, B), inside the input bounds.

    Returns:
        Minimisers, shape (2, B).
    """
    units = np.sqrt(priority)[:, None]
    size = (units * np.abs(a)).max(axis=(0, 1))
    size = np.where(size > 0.0, size, 1.0)  # so that squares neither overflow nor vanish
    u, left = start.copy(), np.arange(start.shape[1])
    rows = _Rows(
        a[0] * units / size,
        a[1] * units / size,
        np.clip(b * units / size, -_FAR, _FAR),
        low,
        high,
        u,
    )
    for _ in range(_STEPS):
        margin, error = _margin(rows)
        # The smallest and the largest slack of each constraint that rounding allows.
        least, most = np.maximum(-margin - error, 0.0), np.maximum(-margin + error, 0.0)
        moving = np.flatnonzero(~_balanced(rows, least, most))
        if not moving.size:
            return u
        left, rows = left[moving], rows.take(moving)
        u[:, left] = _newton(
            rows, margin[:, moving], error[:, moving], least[:, moving], most[:, moving]
        )
        rows = rows._replace(u=u[:, left])
    for i in left.tolist():
        fit = bounded_least_squares.least_violating(
            a[:, :, i].T, b[:, i], low[:, i], high[:, i], priority, start[:, i]
        )
        missed = [
            np.linalg.norm(units[:, 0] * np.minimum(a[:, :, i].T @ end + b[:, i], 0.0))
            for end in (u[:, i], fit)
        ]
        u[:, i] = u[:, i] if missed[0] <= missed[1] else fit
    return u


def is_unique(a: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return whether minimisers u (2, B) are the only actions with their slacks, shape (B,).

    They are if the constraints that they violate cross.

    Args:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        u: the minimisers.
    """
    first, second = a[0] * u[0], a[1] * u[1]
    rounding = ROUNDING * (np.abs(first) + np.abs(second) + np.abs(b))
    violated = first + second + b < -_SURELY * rounding
    _, _, along = _frame(np.where(violated, a[0], 0.0), np.where(violated, a[1], 0.0))
    return np.any(along != 0.0, axis=0)


def _margin(rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
    """Margins of the constraints and what rounding may make of them."""
    first, second = rows.x * rows.u[0], rows.y * rows.u[1]
    return first + second + rows.r, ROUNDING * (np.abs(first) + np.abs(second) + np.abs(rows.r))


def _balanced(rows: _Rows, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return whether the forces cancel (B,), along both inputs and along each constraint.

    A constraint has no part in the force along itself.
    """
    nothing = np.zeros_like(rows.u[:1])
    along = (
        np.concatenate([nothing + 1.0, nothing, -rows.y]),
        np.concatenate([nothing, nothing + 1.0, rows.x]),
    )
    first, second = along[0] * rows.x[:, None], along[1] * rows.y[:, None]
    share, error = first + second, ROUNDING * (np.abs(first) + np.abs(second))
    ends = share * least[:, None], share * most[:, None]
    error *= most[:, None]
    down, up = total(np.minimum(*ends) - error), total(np.maximum(*ends) + error)
    for j in (0, 1):
        # A face of the input bounds pushes inwards, as strongly as it takes.
        down = np.where(
            (rows.u[j] <= rows.low[j]) & (along[j] < 0.0)
            | (rows.u[j] >= rows.high[j]) & (along[j] > 0.0),
            -np.inf,
            down,
        )
        up = np.where(
            (rows.u[j] <= rows.low[j]) & (along[j] > 0.0)
            | (rows.u[j] >= rows.high[j]) & (along[j] < 0.0),
            np.inf,
            up,
        )
    return np.all((down <= 0.0) & (up >= 0.0), axis=0)


def _newton(
    rows: _Rows, margin: np.ndarray, error: np.ndarray, least: np.ndarray, most: np.ndarray
) -> np.ndarray:
    part = least > 0.0
    while True:
        x, y, r, doubt = [np.where(part, entry, 0.0) for entry in (rows.x, rows.y, margin, error)]
        goal = _least_squares(rows._replace(x=x, y=y, r=r), doubt)
        step = goal - rows.u
        change = rows.x * step[0] + rows.y * step[1]
        # A wall, whose slack may be mere rounding, takes part if the step would go through it.
        hit = (most > 0.0) & (change < 0.0) & ~part
        if not hit.any():
            break
        part |= hit
    nothing = np.zeros(goal.shape[1])
    length = interval.least_violating(change, margin, nothing, nothing + 1.0, np.ones(len(margin)))
    return np.where(
        length == 1.0, goal, np.minimum(np.maximum(rows.u + length * step, rows.low), rows.high)
    )


def _least_squares(rows: _Rows, error: np.ndarray) -> np.ndarray:
    """Minimise |x d_1 + y d_2 + r|^2, r being known up to an error, with u + d within its bounds.

    The minimum is inside, or else on an edge.
    """
    goal = rows.u + _unbounded(rows)
    outside = np.flatnonzero(~((goal >= rows.low) & (goal <= rows.high)).all(axis=0))
    if outside.size:
        goal[:, outside] = _best_edge(rows.take(outside), error[:, outside])
    return goal


def _frame(
    x: np.ndarray, y: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Return the steepest constraint (2, B), and each one's components across and along it.

    The latter are zero where the constraints are parallel.
    """
    steepest = np.maximum(np.abs(x), np.abs(y)).argmax(axis=0)[None]
    n1, n2 = [np.take_along_axis(part, steepest, axis=0)[0] for part in (x, y)]
    first, second = y * n1, x * n2
    along = first - second
    return (
        (n1, n2),
        x * n1 + y * n2,
        np.where(np.abs(along) > ROUNDING * (np.abs(first) + np.abs(second)), along, 0.0),
    )


def _unbounded(rows: _Rows) -> np.ndarray:
    """Return the least-squares step (2, B), in the frame of the steepest constraint.

    It is across that alone where all are parallel.
    """
    (n1, n2), across, along = _frame(rows.x, rows.y)
    square = total(across * across)
    square = np.where(square > 0.0, square, 1.0)
    common = total(across * along) / square
    rest = along - common * across
    lone = total(rest * rest)
    first = -total(across * rows.r) / square
    second = np.where(lone > 0.0, -total(rest * (rows.r + first * across)) / lone, 0.0)
    first = first - common * second
    return np.array([first * n1 - second * n2, first * n2 + second * n1])


def _best_edge(rows: _Rows, error: np.ndarray) -> np.ndarray:
    """Return the point of the four edges whose multiplier has the right sign.

    If several do up to rounding, it is that of the least sum, and the nearest.
    """
    u, low, high = rows.u, rows.low, rows.high
    best, least_wrong, least_sum = (
        u.copy(),
        np.full(u.shape[1], np.inf),
        np.full(u.shape[1], np.inf),
    )
    nearer = u - low <= high - u
    for j, near in ((0, True), (1, True), (0, False), (1, False)):
        fixed, moving = (rows.x, rows.y) if j == 0 else (rows.y, rows.x)
        end, sign = np.where(
            nearer[j] == near, (low[j], -np.ones_like(low[j])), (high[j], np.ones_like(low[j]))
        )
        shift = fixed * (end - u[j])
        square = total(moving * moving)
        step = np.where(square > 0.0, -total(moving * (rows.r + shift)) / square, 0.0)
        along = np.minimum(np.maximum(u[1 - j] + step, low[1 - j]), high[1 - j])
        turn = moving * (along - u[1 - j])
        margin = rows.r + shift + turn
        doubt = error + ROUNDING * (np.abs(shift) + np.abs(turn))
        force = sign * total(fixed * margin)
        wrong = np.where(force > total(np.abs(fixed) * doubt), force, 0.0) / np.sqrt(
            total(fixed * fixed)
        )
        missed = total(np.where(np.abs(margin) > doubt, margin * margin, 0.0))
        better = (wrong < least_wrong) | (wrong == least_wrong) & (missed < least_sum)
        least_wrong, least_sum = (
            np.where(better, wrong, least_wrong),
            np.where(better, missed, least_sum),
        )
        best[j], best[1 - j] = np.where(better, end, best[j]), np.where(better, along, best[1 - j])
    return best
