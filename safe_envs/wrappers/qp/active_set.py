"""The nearest of the least-violating actions, for one state and any number of constraints.

Two steps. The least sum of squared slacks comes from bounded least squares; where it is zero, the
constraints can be met. The slacks are the same at all its minimisers, so that these are the actions
inside the input bounds which violate no constraint by more. Among them the nearest one to the
proposal is found by a primal active-set method, which begins at the one at hand and never leaves
them (Nocedal and Wright, Numerical Optimization, Sec. 16.5). Distances are those of y = sqrt(w) u,
where the objective is |y - y_v|^2 and constraints have unit length.

Rounding counts: with constraints or inputs whose sizes differ by more than about a million, the
action may be somewhat worse than the best. It stays within the input bounds, and is flagged where a
constraint is missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.qp.bounded_least_squares import least_violating
from safe_envs.wrappers.qp.rounding import tolerances

_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""

_PARALLEL = 1e-13
"""Part of a step along which a constraint changes by rounding only."""

_NOTHING = 1e-13
"""Part of the way to the proposal that is rounding."""

_LOST = 4.0
"""How many tolerances of a constraint the way to the nearest action may cost."""

_CORRECTIONS = 2
"""How often the constraints that hold the action are evaluated there: the first time takes back the
rounding of the way to it."""


def project(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    """Return the nearest action (m,) of those that violate the constraints least.

    It is NaN where the numbers are too large to say.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
    """
    u = np.clip(v, low, high)
    # An input on which no constraint depends keeps its proposal, and a constraint that depends on
    # no input has no say.
    rows, inputs = (a != 0.0).any(axis=1), (a != 0.0).any(axis=0)
    if not rows.any():
        return u
    try:
        u[inputs] = _project(
            a[np.ix_(rows, inputs)],
            b[rows],
            v[inputs],
            low[inputs],
            high[inputs],
            w[inputs],
            priority[rows],
        )
    except np.linalg.LinAlgError:
        u[inputs] = np.nan
    return u


def _project(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    start = least_violating(a, b, low, high, priority, np.clip(v, low, high))
    margin = a @ start + b
    slack = np.where(margin < -tolerances(a.T, b, start), -margin, 0.0)
    unit, roots = np.abs(a).max(axis=1), np.sqrt(w)
    normals = a / unit[:, None] / roots
    lengths = np.linalg.norm(normals, axis=1)
    normals, unit = normals / lengths[:, None], unit * lengths
    held = _nearest(
        normals,
        np.maximum(margin + slack, 0.0) / unit,
        (v - start) * roots,
        (low - start) * roots,
        (high - start) * roots,
    )
    u = np.where(held.low, low, np.where(held.high, high, start + held.step / roots))
    free, binding = ~(held.low | held.high), held.rows
    for _ in range(_CORRECTIONS):
        excess = (a @ u + b + slack)[binding] / unit[binding]
        u[free] -= np.linalg.lstsq(normals[np.ix_(binding, free)], excess)[0] / roots[free]
    u = np.clip(u, low, high)
    # Where constraints or inputs differ by many orders of magnitude, rounding may lead astray: then
    # the least-violating action itself is safer.
    worse = np.maximum(-(a @ u + b), 0.0) - np.maximum(-margin, 0.0)
    return (
        u if (worse <= _LOST * (tolerances(a.T, b, u) + tolerances(a.T, b, start))).all() else start
    )


class _Held(NamedTuple):
    """End of a step (m,), with the constraints (k,) and bounds (m,) that hold it."""

    step: np.ndarray
    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _nearest(
    normals: np.ndarray, spare: np.ndarray, way: np.ndarray, low: np.ndarray, high: np.ndarray
) -> _Held:
    """Return the step nearest to the proposal that the constraints and bounds allow.

    It has normals . step + spare >= 0 and low <= step <= high; 0 is such a step.

    Where no step leads nearer, the rest of the way is a sum of the normals of what holds the step.
    What has the wrong sign in it is let go.
    """
    k, m = normals.shape
    step, rows, at = np.zeros(m), np.zeros(k, dtype=bool), np.zeros(m)
    for _ in range(_STEPS * (k + m)):
        free = at == 0.0
        rest = way - step
        working = normals[np.ix_(rows, free)].T
        pull = np.linalg.lstsq(working, rest[free])[0]
        move = np.zeros(m)
        move[free] = rest[free] - working @ pull
        move[free] -= working @ np.linalg.lstsq(working, move[free])[0]
        size = np.abs(move).max(initial=0.0)
        if size > _NOTHING * np.abs(rest[free]).max(initial=0.0):
            ends = np.where(move > 0.0, high, low)
            to_ends = np.divide(ends - step, move, out=np.full(m, np.inf), where=move != 0.0)
            change, left = normals @ move, normals @ step + spare
            to_rows = np.divide(
                np.maximum(left, 0.0),
                -change,
                out=np.full(k, np.inf),
                where=~rows & (change < -_PARALLEL * size),
            )
            length = min(to_ends.min(), to_rows.min(initial=np.inf), 1.0)
            stops = to_ends <= length
            step = np.where(stops, ends, np.clip(step + length * move, low, high))
            if length < 1.0:
                # One at a time, so that the normals stay independent.
                if stops.any():
                    at = np.where(stops, np.sign(move), at)
                else:
                    rows[to_rows.argmin()] = True
                continue
        against = np.zeros(k)
        against[rows] = pull
        pressed = np.where(free, 0.0, -at * (way - step - normals[rows].T @ pull))
        if max(against.max(initial=0.0), pressed.max()) <= _NOTHING * np.abs(way).max():
            break
        if against.max(initial=0.0) >= pressed.max():
            rows[against.argmax()] = False
        else:
            at[pressed.argmax()] = 0.0
    return _Held(step, rows, at < 0.0, at > 0.0)
