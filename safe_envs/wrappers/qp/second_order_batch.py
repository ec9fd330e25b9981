"""`second_order_constraint` for a batch of states, with the same formulas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.wrappers.qp.rounding import ROUNDING, Entries, Floats, stack, total

_BISECTIONS = 64
"""As many as halve an interval of doubles down to neighbours."""


@np.errstate(all="ignore")
def project_arrays(
    a: Entries,
    b: Entries,
    q: Sequence[Entries],
    v: np.ndarray,
    low: Any,
    high: Any,
    priority: Floats,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project the input of each of B states.

    Args:
        a: k coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        q: k forms, whose entries are likewise.
        v: proposed inputs, shape (B,).
        low: lower bound, a float or an array (B,).
        high: upper bound, likewise.
        priority: k positive weights of the squared slacks.

    Returns:
        Inputs (B,), margins c_i (k, B), constraints that bind or cannot be met (k, B), and whether
        all constraints can be met (B,).
    """
    size = len(v)
    slope, offset = stack(a, size), stack(b, size)
    form = np.stack([stack([row[j] for row in q], size) for j in range(3)])
    u = np.minimum(np.maximum(v, low), high)
    margin = _margins(slope, offset, form, u)
    active, feasible = np.zeros(margin.shape, dtype=bool), np.ones(size, dtype=bool)
    acting = np.flatnonzero(~(margin >= 0.0).all(axis=0))
    if acting.size:
        slope, offset, form, wish = (
            slope[:, acting],
            offset[:, acting],
            form[:, :, acting],
            v[acting],
        )
        in_unit = _in_unit(slope, offset, form)
        starts, ends = _intervals(*in_unit)
        low, high = [np.broadcast_to(end, size)[acting] for end in (low, high)]
        lo, hi = np.maximum(starts.max(axis=0), low), np.minimum(ends.min(axis=0), high)
        met = lo - hi <= ROUNDING * np.minimum(abs(lo), abs(hi))
        found = np.maximum(np.minimum(np.maximum(wish, lo), hi), low)
        apart = np.flatnonzero(~met)
        if apart.size:
            row, interval = (
                tuple(part[..., apart] for part in in_unit),
                (starts[:, apart], ends[:, apart]),
            )
            nearest = _nearest(row, interval, wish[apart], low[apart], high[apart])
            lost = slope[:, apart], offset[:, apart], form[:, :, apart]
            found[apart] = (
                nearest[0]
                if len(slope) == 1
                else _least_violating(*lost, nearest, wish[apart], priority)
            )
        u[acting] = found
        margin[:, acting] = reached = _margins(slope, offset, form, found)
        allowed = _tolerances(slope, offset, form, found)
        active[:, acting] = (reached <= allowed) | (found == starts) | (found == ends)
        feasible[acting] = (reached >= -allowed).all(axis=0)
    return u, margin, active, feasible


def _margins(a: np.ndarray, b: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    return a * u + b - np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))


def _tolerances(a: np.ndarray, b: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """`_tolerance` for arrays (k, B), with the same formulas."""
    linear, terms = 2.0 * q[1] * u, q[2] * u * u
    form, terms = (
        np.maximum(q[0] + linear + terms, 0.0),
        ROUNDING * (np.abs(q[0]) + np.abs(linear) + terms),
    )
    return ROUNDING * np.abs(b) + ROUNDING * np.abs(a * u) + np.sqrt(form + terms) - np.sqrt(form)


def _in_unit(
    a: np.ndarray, b: np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_in_unit` for arrays (k, B), with the same formulas."""
    unit = np.maximum(
        np.maximum(abs(a), abs(b)), np.maximum(np.sqrt(abs(q[0])), np.sqrt(abs(q[2])))
    )
    unit = np.where(unit == 0.0, 1.0, unit)
    return a / unit, b / unit, q / unit / unit


def _intervals(a: np.ndarray, b: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_interval` for arrays (k, B), with the same formulas."""
    q0, q1, q2 = q
    leading, middle, last = a * a - q2, a * b - q1, b * b - q0
    discriminant = a * a * q0 - 2.0 * a * b * q1 + b * b * q2 - (q0 * q2 - q1 * q1)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    t = -(middle + np.copysign(root, middle))
    first, second = np.where(t == 0.0, 0.0, t / leading), np.where(t == 0.0, 0.0, last / t)
    first, second = np.minimum(first, second), np.maximum(first, second)
    least, linear, rising = np.sqrt(np.maximum(q0, 0.0)) - b, q2 == 0.0, a > 0.0
    level, flat = linear & (a == 0.0), leading == 0.0
    end = np.where(linear, least / a, -last / (2.0 * middle))
    ray = linear | flat
    start = np.select(
        [level, ray & rising, ray, leading < 0.0, rising],
        [-np.inf, end, -np.inf, first, second],
        -np.inf,
    )
    stop = np.select(
        [level, ray & rising, ray, leading < 0.0, rising],
        [np.inf, np.inf, end, second, np.inf],
        first,
    )
    between = (discriminant >= 0.0) & (b - a * middle / leading >= 0.0)
    met = np.select(
        [level, linear, flat, leading < 0.0], [least <= 0.0, True, middle * a > 0.0, between], True
    )
    return np.where(met, start, np.inf), np.where(met, stop, np.inf)


def _nearest(
    row: tuple[np.ndarray, ...],
    interval: tuple[np.ndarray, np.ndarray],
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """`_nearest` for arrays (k, B), with the same formulas."""
    start, end = interval
    u = np.where(
        start == np.inf,
        _maximisers(row[0], row[2], v, low, high),
        np.maximum(np.minimum(v, end), start),
    )
    return np.minimum(np.maximum(u, low), high)


def _maximisers(
    a: np.ndarray, q: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """`_maximiser` for arrays (k, B), with the same formulas."""
    q0, q1, q2 = q
    t, kink = a / np.sqrt(q2), -q1 / q2
    inside = kink + t * np.sqrt(np.maximum(q0 - q1 * q1 / q2, 0.0) / q2) / np.sqrt(1.0 - t * t)
    still = np.where(a > 0.0, np.maximum(v, kink), np.minimum(v, kink))
    end, level = np.where(a > 0.0, high, low), (t * t == 1.0) & (q0 * q2 <= q1 * q1)
    return np.select(
        [q2 == 0.0, t * t < 1.0, level], [np.where(a == 0.0, v, end), inside, still], end
    )


def _least_violating(
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    nearest: np.ndarray,
    v: np.ndarray,
    priority: Floats,
) -> np.ndarray:
    """Return the minimiser of the sum of squared slacks nearest to v.

    It lies between the nearest ones of each constraint.
    """
    weights = np.asarray(priority)[:, None]

    def derivative(u: np.ndarray) -> np.ndarray:
        spread = np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))
        rate = a - np.where(spread > 0.0, (q[1] + q[2] * u) / spread, 0.0)
        return total(weights * np.minimum(a * u + b - spread, 0.0) * rate)

    ends = []
    for rises in (np.greater_equal, np.greater):
        lo, hi = nearest.min(axis=0), nearest.max(axis=0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (lo + hi)
            beyond = rises(derivative(middle), 0.0)
            lo, hi = np.where(beyond, lo, middle), np.where(beyond, middle, hi)
        ends.append(0.5 * (lo + hi))
    return np.minimum(np.maximum(v, ends[0]), ends[1])
