"""The exact projection onto one constraint and input bounds, in closed form.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a . u + b >= 0,   low <= u <= high

The minimiser is u(l) = clip(v + l a / w) for the smallest multiplier l >= 0 at which phi(l) = a .
u(l) + b reaches 0. phi is nondecreasing and piecewise linear, with a kink wherever a component
enters or leaves its interval. If phi stays negative, no action meets the constraint; u(infinity),
which maximises a . u + b over the input bounds, violates it least.

A component whose proposal lies beyond its near bound stays there until l enters, and is measured
from there: a proposal of 1e16 does not drown it. What rounding leaves of the miss at the result is
divided among the components that are free.
"""

from __future__ import annotations

import sys
from operator import mul
from typing import Any

import numpy as np

from safe_envs.engine.qp.kernels.one_constraint import project_scalar, project_two_inputs
from safe_envs.engine.qp.rounding import (
    ROUNDING,
    Arrays,
    Entries,
    Floats,
    added,
    tolerance,
    tolerances,
)

_EXCESS = 1e3
"""A constraint that holds with so many times its rounding to spare is not on the nearest action:
the rounding of the way there was larger. Then, and where that makes it miss, a state of a batch is
solved by itself."""
_CORRECTIONS = 3
"""How often the rounding of a long way is taken back: each time it shrinks by a factor of 1e16."""


def project_floats(
    a: Floats, b: float, u: Floats, low: Floats, high: Floats, w: Floats
) -> tuple[list[float], float, bool, bool]:
    """Project the input of one state.

    Args:
        a: m entries of the constraint.
        b: the offset.
        u: m proposed inputs.
        low: m lower bounds.
        high: m upper bounds.
        w: m positive weights.

    Returns:
        The minimiser (m floats), its margin a . u + b, whether the constraint had to act, and
        whether it can be met.
    """
    if len(u) == 1:
        found, margin, active, feasible = project_scalar(a[0], b, u[0], low[0], high[0])
        return [found], margin, active, feasible
    if len(u) == 2:
        (a1, a2), (v1, v2), (l1, l2), (h1, h2), (w1, w2) = a, u, low, high, w
        solved, u1, u2, margin, active = project_two_inputs(
            a1, a2, b, v1, v2, l1, l2, h1, h2, w1, w2
        )
        if solved:
            return [u1, u2], margin, active, True
    v = u
    u = [min(max(vj, lo), hi) for vj, lo, hi in zip(v, low, high, strict=True)]
    margin = b + added(map(mul, a, u))
    if margin >= 0.0:
        return u, margin, False, True
    u, ways = _follow_multiplier(a, b, v, low, high, w)
    margin, allowed = b + added(map(mul, a, u)), tolerance(a, b, u)
    for _ in range(_CORRECTIONS):
        slope = 0.0 if -allowed <= margin <= allowed else added(map(mul, a, ways))
        if not slope > 0.0:
            break
        step = margin / slope
        u = [
            min(max(uj - step * way, lo), hi) if way else uj
            for uj, way, lo, hi in zip(u, ways, low, high, strict=True)
        ]
        margin, allowed = (
            b + added(map(mul, a, u)),
            tolerance(a, b, u),
        )
    return u, margin, True, margin >= -allowed


def _follow_multiplier(
    a: Floats, b: float, v: Floats, low: Floats, high: Floats, w: Floats
) -> tuple[list[float], list[float]]:
    """Return the minimiser, and the way of each component along a / w, 0 for those not free."""
    size = max([abs(aj) for aj in a]) or 1.0
    a, b = [aj / size for aj in a], b / size  # so that products neither overflow nor vanish
    d = [aj / wj for aj, wj in zip(a, w, strict=True)]
    start = [min(max(vj, lo), hi) for vj, lo, hi in zip(v, low, high, strict=True)]
    far, enter, leave = start.copy(), [0.0] * len(a), [0.0] * len(a)
    for j, (dj, vj, lo, hi) in enumerate(zip(d, v, low, high, strict=True)):
        if dj != 0.0:
            near, far[j] = (lo, hi) if dj > 0.0 else (hi, lo)
            enter[j], leave[j] = max((near - vj) / dj, 0.0), max((far[j] - vj) / dj, 0.0)
    parts = list(zip(start, far, d, enter, leave, strict=True))

    def inputs(multiplier: float) -> list[float]:
        return [
            s if multiplier <= e else f if multiplier >= x else s + (multiplier - e) * dj
            for s, f, dj, e, x in parts
        ]

    kink, phi = max(
        [(k, p) for k in (0.0, *enter, *leave) if (p := b + added(map(mul, a, inputs(k)))) < 0.0],
        default=(0.0, -0.0),
    )
    # Where a component is so far off that it enters and leaves at the same multiplier, up to
    # rounding, it is free there.
    ways = [dj if s != f and (e <= kink < x or e == kink == x) else 0.0 for s, f, dj, e, x in parts]
    slope = added(map(mul, a, ways))
    if not slope > 0.0:
        return far, ways
    step = phi / slope
    return [
        min(max(uj - step * way, lo), hi) if way else uj
        for uj, way, lo, hi in zip(inputs(kink), ways, low, high, strict=True)
    ], ways


def project_arrays(
    a: Entries, b: Any, v: Arrays, low: Entries, high: Entries, w: Entries
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Project the inputs of a batch of B states.

    A flat constraint divides by zero: the caller silences that warning.

    Args:
        a: m entries of the constraint, each a float or an array (B,).
        b: the offset, a float or an array (B,).
        v: m arrays (B,) of proposed inputs.
        low: m lower bounds, each a float or an array (B,).
        high: m upper bounds, likewise.
        w: m positive weights, likewise.

    Returns:
        As `project_floats`, with arrays (B,) for every number.
    """
    if len(v) == 1:
        u, margin, active, feasible = _project_scalars(a[0], b, v[0], low[0], high[0])
        return [u], margin, active, feasible
    u = [np.minimum(np.maximum(vj, lo), hi) for vj, lo, hi in zip(v, low, high, strict=True)]
    margin = _dot(a, u) + b
    active = margin < 0.0
    if not np.count_nonzero(active):
        return u, margin, active, ~active
    states = np.flatnonzero(active)
    u, movable = _follow_multipliers(a, b, v, u, low, high, w, states)
    margin, allowed = _dot(a, u) + b, tolerances(a, b, u)
    feasible = margin >= -allowed
    wrong = states[(~feasible[states] & movable) | (margin[states] > _EXCESS * allowed[states])]
    if wrong.size:
        problems = [
            np.array([np.broadcast_to(cj, active.shape)[wrong] for cj in c]).T.tolist()
            for c in (a, (b,), v, low, high, w)
        ]
        for i, aj, (bi,), *rest in zip(wrong.tolist(), *problems, strict=True):
            found, margin[i], _, feasible[i] = project_floats(aj, bi, *rest)
            for uj, component in zip(u, found, strict=True):
                uj[i] = component
    return u, margin, active, feasible


def _project_scalars(
    a: Any, b: Any, v: np.ndarray, low: Any, high: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    u = np.minimum(np.maximum(v, low), high)
    margin = a * u + b
    active = margin < 0.0
    if not np.count_nonzero(active):
        return u, margin, active, ~active
    nearest = np.minimum(np.maximum(-b / a, low), high)
    moving = active if np.count_nonzero(a) == np.size(a) else active & (a != 0.0)
    u = np.where(moving, nearest, u)
    product = a * u
    margin = product + b
    # As `tolerances`, in place.
    np.abs(product, out=product)
    product *= ROUNDING
    product += ROUNDING * np.abs(b)
    return u, margin, active, margin >= -product


def _dot(a: Entries, u: Arrays) -> np.ndarray:
    total = a[0] * u[0]
    for aj, uj in zip(a[1:], u[1:], strict=True):
        total = total + aj * uj
    return total


def _follow_multipliers(
    a: Entries,
    b: Any,
    v: Arrays,
    u: list[np.ndarray],
    low: Entries,
    high: Entries,
    w: Entries,
    rows: np.ndarray,
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the inputs, and which states in `rows` have components that can still move (R,).

    Components are in front: shape (m, R), kinks in a third axis (m, R, 2m + 1).
    """
    batch = u[0].shape
    ar, vr, lo, hi, wr = [
        np.array([np.broadcast_to(cj, batch)[rows] for cj in c]) for c in (a, v, low, high, w)
    ]
    size = np.abs(ar).max(axis=0)
    size[size == 0.0] = 1.0
    ar, br = (
        ar / size,
        np.broadcast_to(b, batch)[rows] / size,
    )  # so that products neither overflow nor vanish
    d = ar / wr
    near, far = np.where(d > 0.0, lo, hi), np.where(d > 0.0, hi, lo)
    free = d != 0.0
    # Finite, for an input without a say stays where it is.
    enter = np.clip(
        np.divide(near - vr, d, out=np.zeros_like(d), where=free), 0.0, sys.float_info.max
    )
    leave = np.clip(
        np.divide(far - vr, d, out=np.zeros_like(d), where=free), 0.0, sys.float_info.max
    )
    kinks = np.concatenate([np.zeros((1, rows.size)), enter, leave]).T
    at_kinks = np.clip(vr[:, :, None] + kinks * d[:, :, None], lo[:, :, None], hi[:, :, None])
    phi = (ar[:, :, None] * at_kinks).sum(axis=0) + br[:, None]
    last = np.where(phi < 0.0, kinks, -1.0).argmax(axis=1)[:, None]
    kink = np.take_along_axis(kinks, last, axis=1)[:, 0]
    phi = np.take_along_axis(phi, last, axis=1)[:, 0]
    slope = np.where((enter <= kink) & (kink < leave), ar * d, 0.0).sum(axis=0)
    rises = slope > 0.0
    multiplier = kink - np.divide(phi, slope, out=np.zeros_like(phi), where=rises)
    solved = np.clip(vr + np.where(free, multiplier * d, 0.0), lo, hi)
    result = [uj.copy() for uj in u]
    for j, component in enumerate(np.where(rises | ~free, solved, far)):
        result[j][rows] = component
    return result, rises
