"""One constraint row and a box: the exact projection, in closed form, for one state or a batch.

    min 1/2 sum_j w_j (u_j - v_j)^2   subject to   a . u + b >= 0,   low <= u <= high

The minimiser is u(l) = clip(v + l a / w) for the smallest multiplier l >= 0 at which phi(l) = a . u(l) + b reaches 0.
phi is nondecreasing and piecewise linear, with a kink wherever a component enters or leaves its interval. If phi stays
negative, no action meets the row; u(infinity), which maximises a . u + b over the box, violates it least.

u(l) carries the rounding of v, which a proposal far beyond the box makes large. So the row is evaluated at the result, and what
it misses or exceeds there is divided among the components that may still move along a / w.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from wrappers.qp.rows import ROUNDING, tolerance, tolerances, total

_LARGEST = sys.float_info.max
_EXCESS = 1e3
"""A row that holds with so many times its rounding to spare is not on the nearest action: the proposal's rounding was larger."""
_CORRECTIONS = 3
"""How often more than once for each component a row is corrected: each time its miss shrinks to rounding."""


def project_floats(
    a: Sequence[float], b: float, u: Sequence[float], low: Sequence[float], high: Sequence[float], w: Sequence[float]
) -> tuple[list[float], float, bool, bool]:
    """Project the input u of one state.

    Returns:
        The minimiser (m floats), its margin a . u + b, whether the row had to act, and whether it can be met.
    """
    if len(u) == 1:
        return _project_scalar(a[0], b, u[0], low[0], high[0])
    v = u
    u = [min(max(vj, lo), hi) for vj, lo, hi in zip(v, low, high, strict=True)]
    margin = b + sum([aj * uj for aj, uj in zip(a, u, strict=True)])
    if margin >= 0.0:
        return u, margin, False, True
    u = _follow_multiplier(a, b, v, low, high, w)
    margin = b + sum([aj * uj for aj, uj in zip(a, u, strict=True)])
    allowed = tolerance(a, b, u)
    if not -allowed <= margin <= _EXCESS * allowed:
        u, margin, allowed = _corrected(a, b, v, u, low, high, w)
    return u, margin, True, margin >= -allowed


def _corrected(
    a: Sequence[float], b: float, v: Sequence[float], u: list[float], low: Sequence[float], high: Sequence[float], w: Sequence[float]
) -> tuple[list[float], float, float]:
    """The inputs moved until the row holds with equality, as far as their ways from the clipped proposal to the far bounds allow."""
    size = max([abs(aj) for aj in a]) or 1.0
    ways = [
        (aj / size, aj / size / wj, min(max(vj, lo), hi), hi if aj > 0.0 else lo)
        for aj, vj, lo, hi, wj in zip(a, v, low, high, w, strict=True)
    ]
    for _ in range(len(a) + _CORRECTIONS):
        margin, allowed = b + sum([aj * uj for aj, uj in zip(a, u, strict=True)]), tolerance(a, b, u)
        if -allowed <= margin <= allowed:
            break
        moving = [dj if uj != (far if margin < 0.0 else near) else 0.0 for (_, dj, near, far), uj in zip(ways, u, strict=True)]
        slope = sum([aj * dj for (aj, *_), dj in zip(ways, moving, strict=True)])
        if not slope > 0.0:
            break
        step = -(margin / size) / slope
        u = [
            min(max(uj + step * dj, min(near, far)), max(near, far)) if dj else uj
            for uj, dj, (*_, near, far) in zip(u, moving, ways, strict=True)
        ]
    return u, b + sum([aj * uj for aj, uj in zip(a, u, strict=True)]), tolerance(a, b, u)


def _project_scalar(a: float, b: float, v: float, low: float, high: float) -> tuple[list[float], float, bool, bool]:
    """A single input: the root of the row, if the box holds it, and the end of the box next to it if not."""
    u = low if v < low else high if v > high else v
    margin = a * u + b
    if margin >= 0.0:
        return [u], margin, False, True
    if a == 0.0:
        return [u], margin, True, False
    root = -b / a
    u = low if root < low else high if root > high else root
    product = a * u
    margin = product + b
    return [u], margin, True, margin >= -ROUNDING * abs(b) - ROUNDING * abs(product)


def _follow_multiplier(
    a: Sequence[float], b: float, v: Sequence[float], low: Sequence[float], high: Sequence[float], w: Sequence[float]
) -> list[float]:
    size = max([abs(aj) for aj in a]) or 1.0
    a, b = [aj / size for aj in a], b / size  # so that products neither overflow nor vanish
    d = [aj / wj for aj, wj in zip(a, w, strict=True)]
    enter, leave = [0.0] * len(a), [0.0] * len(a)
    for j, (dj, vj, lo, hi) in enumerate(zip(d, v, low, high, strict=True)):
        if dj != 0.0:
            near, far = (lo, hi) if dj > 0.0 else (hi, lo)
            enter[j], leave[j] = max((near - vj) / dj, 0.0), max((far - vj) / dj, 0.0)

    def inputs(multiplier: float) -> list[float]:
        # An input without a say stays where it is, also where the multiplier is infinite.
        return [min(max(vj + multiplier * dj if dj else vj, lo), hi) for vj, dj, lo, hi in zip(v, d, low, high, strict=True)]

    kink, phi = max(
        [(k, p) for k in (0.0, *enter, *leave) if (p := b + sum([aj * uj for aj, uj in zip(a, inputs(k), strict=True)])) < 0.0],
        default=(0.0, -0.0),
    )
    slope = sum([aj * dj for aj, dj, e, x in zip(a, d, enter, leave, strict=True) if e <= kink < x])
    if slope > 0.0:
        return inputs(kink - phi / slope)
    return [hi if aj > 0.0 else lo if aj < 0.0 else u for aj, lo, hi, u in zip(a, low, high, inputs(0.0), strict=True)]


def project_arrays(
    a: Sequence[Any], b: Any, v: Sequence[np.ndarray], low: Sequence[Any], high: Sequence[Any], w: Sequence[Any]
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Project the inputs of a batch of B states. A flat row divides by zero: the caller silences that warning.

    Args:
        a: m entries of the row, each a float or an array (B,).
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
        part = [np.array([np.broadcast_to(cj, active.shape)[wrong] for cj in c]) for c in (a, (b,), v, u, low, high, w)]
        found, margin[wrong], feasible[wrong] = _all_corrected(*part)
        for uj, component in zip(u, found, strict=True):
            uj[wrong] = component
    return u, margin, active, feasible


def _project_scalars(a: Any, b: Any, v: np.ndarray, low: Any, high: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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


def _dot(a: Sequence[Any], u: Sequence[np.ndarray]) -> np.ndarray:
    total = a[0] * u[0]
    for aj, uj in zip(a[1:], u[1:], strict=True):
        total = total + aj * uj
    return total


def _follow_multipliers(
    a: Sequence[Any],
    b: Any,
    v: Sequence[np.ndarray],
    u: list[np.ndarray],
    low: Sequence[Any],
    high: Sequence[Any],
    w: Sequence[Any],
    rows: np.ndarray,
) -> tuple[list[np.ndarray], np.ndarray]:
    """The inputs, and which of the states in `rows` have components that can still move (R,).

    Components are in front: shape (m, R), kinks in a third axis (m, R, 2m + 1).
    """
    batch = u[0].shape
    ar, vr, lo, hi, wr = [np.array([np.broadcast_to(cj, batch)[rows] for cj in c]) for c in (a, v, low, high, w)]
    size = np.abs(ar).max(axis=0)
    size[size == 0.0] = 1.0
    ar, br = ar / size, np.broadcast_to(b, batch)[rows] / size  # so that products neither overflow nor vanish
    d = ar / wr
    near, far = np.where(d > 0.0, lo, hi), np.where(d > 0.0, hi, lo)
    free = d != 0.0
    # Finite, for an input without a say stays where it is.
    enter = np.clip(np.divide(near - vr, d, out=np.zeros_like(d), where=free), 0.0, _LARGEST)
    leave = np.clip(np.divide(far - vr, d, out=np.zeros_like(d), where=free), 0.0, _LARGEST)
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


def _all_corrected(
    a: np.ndarray, b: np.ndarray, v: np.ndarray, u: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_corrected` for components in front, shape (m, R), and b of the shape (1, R): inputs, margins and whether the row is met."""
    size = np.abs(a).max(axis=0)
    unit, ways = a / size, a / size / w
    near, far = np.clip(v, low, high), np.where(a > 0.0, high, low)
    lower, upper = np.minimum(near, far), np.maximum(near, far)
    for _ in range(len(a) + _CORRECTIONS):
        margin, allowed = total(a * u) + b[0], tolerances(a, b[0], u)
        moving = np.where(u != np.where(margin < 0.0, far, near), ways, 0.0)
        slope = total(unit * moving)
        wrong = ~(np.abs(margin) <= allowed) & (slope > 0.0)
        if not np.count_nonzero(wrong):
            break
        step = np.where(wrong, -(margin / size) / slope, 0.0)
        u = np.where(moving != 0.0, np.minimum(np.maximum(u + step * moving, lower), upper), u)
    margin = total(a * u) + b[0]
    return u, margin, margin >= -tolerances(a, b[0], u)
