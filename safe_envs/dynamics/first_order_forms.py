"""First-order forms: enclosures of functions on many boxes that follow their slopes.

On a box the states are x_i = mid_i + rad_i t_i with t_i in [-1, 1]. A form encloses a function as
center + sum_i slopes_i t_i + e with |e| <= radius, and has its range as an interval too. The error
of a smooth function falls with the square of the width of a box, that of interval arithmetic alone
with the width. These are Taylor models of first order (Makino and Berz 2003), or affine arithmetic
with the states as its only symbols (de Figueiredo and Stolfi 2004).

Every operation notes where it is not known to be twice continuously differentiable on the whole
closed box: where it meets a pole, a branch cut, the end of its domain, a kink or a jump. That is
seen by evaluation, so that no name and no form hides it.

Rounding: the operations on centers and slopes are off by a few units in the last place of the
absolute values that enter; these are added to the radius. The ranges are rounded outwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safe_envs.dynamics.interval_arithmetic import Interval, negative

EPS = 2.0**-52
TINY = 1e-300
SMALLEST = 5e-324
MORE = 1.0 + 64 * EPS


class Form(NamedTuple):
    """Enclosures of a function on B boxes of n states.

    Attributes:
        center: shape (B,).
        slopes: shape (n, B).
        radius: of the error, infinite where only the range is known; shape (B,).
        range: lower and upper ends, shape (B,) each.
        smooth: whether it is twice continuously differentiable on the closed box, shape (B,).
    """

    center: np.ndarray
    slopes: np.ndarray
    radius: np.ndarray
    range: Interval
    smooth: np.ndarray


def variables(low: np.ndarray, high: np.ndarray) -> list[Form]:
    """Return the forms of the states themselves.

    Args:
        low: lower ends of the boxes, shape (n, B); may be infinite.
        high: upper ends, shape (n, B).
    """
    found = []
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        mid, rad = middle(a, b)
        finite = np.isfinite(rad)
        slopes = np.zeros(low.shape)
        slopes[i] = np.where(finite, rad, 0.0)
        error = np.where(finite, EPS * (np.abs(mid) + rad) + TINY, np.inf)
        found.append(
            Form(
                np.where(finite, mid, 0.0),
                slopes,
                error,
                Interval(a, b),
                np.ones(len(a), dtype=bool),
            )
        )
    return found


def middle(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return midpoints and half widths, not finite where an interval is not.

    Args:
        low: lower ends.
        high: upper ends.
    """
    with np.errstate(invalid="ignore"):
        return 0.5 * low + 0.5 * high, 0.5 * high - 0.5 * low


def points(values: np.ndarray, n: int) -> Form:
    """Return the form of a number for each box.

    Args:
        values: shape (B,).
        n: number of states.
    """
    nothing = np.zeros(len(values))
    smooth = np.ones(len(values), dtype=bool)
    return Form(values, np.zeros((n, len(values))), nothing, Interval(values, values), smooth)


def with_range(
    center: np.ndarray,
    slopes: np.ndarray,
    radius: np.ndarray,
    known: Interval,
    smooth: np.ndarray,
) -> Form:
    """Return a form, with the range that follows from it cut to the one that is known.

    Args:
        center: see `Form`.
        slopes: see `Form`.
        radius: see `Form`; may be NaN where nothing is known.
        known: range.
        smooth: see `Form`.
    """
    radius = np.where(np.isfinite(center + radius), radius * MORE + TINY, np.inf)
    lost = ~(np.isfinite(radius) & np.isfinite(slopes).all(axis=0))
    if lost.any():
        center, radius = np.where(lost, 0.0, center), np.where(lost, np.inf, radius)
        slopes = np.where(lost, 0.0, slopes)
    reach = (np.abs(slopes).sum(axis=0) + radius) * MORE
    slack = EPS * (np.abs(center) + reach)
    low = np.maximum(known.low, center - reach - slack)
    high = np.minimum(known.high, center + reach + slack)
    return Form(center, slopes, radius, Interval(low, high), smooth)


def opposite(a: Form) -> Form:
    """Return -a."""
    return Form(-a.center, -a.slopes, a.radius, negative(a.range), a.smooth)


def merged(where: np.ndarray, a: Form, b: Form) -> Form:
    """Return a on some boxes and b on the others.

    Args:
        where: flags of the boxes, shape (B,).
        a: taken where they are true.
        b: taken where they are not.
    """
    return Form(
        np.where(where, a.center, b.center),
        np.where(where, a.slopes, b.slopes),
        np.where(where, a.radius, b.radius),
        Interval(
            np.where(where, a.range.low, b.range.low), np.where(where, a.range.high, b.range.high)
        ),
        np.where(where, a.smooth, b.smooth),
    )


def is_finite(a: Interval) -> np.ndarray:
    """Return where both ends are finite, shape (B,)."""
    return np.isfinite(a.low) & np.isfinite(a.high)
