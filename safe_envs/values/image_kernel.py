"""Where a step takes states, as a kernel, and operations on intervals of two floats for it.

The operations round outwards as `safe_envs.enclosures.intervals` does, where the reasons
are: a sum or product s is off by at most 2^-52 |s|, a product by the smallest number besides.
"""

from __future__ import annotations

from math import atan2, ceil, cos, exp, floor, inf, pi, sin, sqrt

import numpy as np

_LAST = 2.0**-52
_LEAST = 5e-324
_FUNCTION = 5.0 * 2.0**-52
_ANGLE = 3.1415926535897936

Ends = tuple[float, float]


def state_images(  # noqa: PLR0913
    a: int,
    points: np.ndarray,
    known: np.ndarray,
    worlds: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    inputs: np.ndarray,
    images: np.ndarray,
    effects: np.ndarray,
) -> None:
    """Fill in where a step takes a state; each program has its own.

    Args:
        a: the state.
        points: coordinates, shape (n, B).
        known: states that are known in advance, shape (K,).
        worlds: ends of the uncertain parameters, shape (R, S, 2).
        low: least entries of the boxes of noise, shape (c, W).
        high: largest entries.
        inputs: ends of the inputs, shape (1 or B, V, m, 2).
        images: receives the images; see `bellman_kernel`.
        effects: receives the effects.
    """
    raise NotImplementedError


def point_images(  # noqa: PLR0913
    first: int,
    last: int,
    points: np.ndarray,
    known: np.ndarray,
    worlds: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    inputs: np.ndarray,
    images: np.ndarray,
    effects: np.ndarray,
) -> None:
    """Fill in where a step takes states.

    Args:
        first: state to begin with.
        last: state to end before.
        points: see `state_images`, as for all others.
        known: see there.
        worlds: see there.
        low: see there.
        high: see there.
        inputs: see there.
        images: see there.
        effects: see there.
    """
    for a in range(first, last):
        state_images(a, points, known, worlds, low, high, inputs, images, effects)


def ends_outward(low: float, high: float, relative: float, tiny: float) -> Ends:
    """Return ends moved outwards; without bounds where they are no numbers.

    Args:
        low: computed lower end.
        high: computed upper end.
        relative: error as a part of the ends.
        tiny: error in addition.
    """
    low, high = low - (abs(low) * relative + tiny), high + (abs(high) * relative + tiny)
    return (low if low == low else -inf), (high if high == high else inf)


def ends_sum(a: Ends, b: Ends) -> Ends:
    """Return the interval of sums.

    Args:
        a: one interval.
        b: the other one.
    """
    return ends_outward(a[0] + b[0], a[1] + b[1], _LAST, 0.0)


def ends_product(a: Ends, b: Ends) -> Ends:
    """Return the interval of products; of an infinite and a zero end nothing is known.

    Args:
        a: one interval.
        b: the other one.
    """
    p, q, s, t = a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]
    if p != p or q != q or s != s or t != t:
        return -inf, inf
    return ends_outward(min(min(p, q), min(s, t)), max(max(p, q), max(s, t)), _LAST, _LEAST)


def ends_magnitude(a: Ends) -> Ends:
    """Return the interval of absolute values."""
    return max(max(a[0], -a[1]), 0.0), max(-a[0], a[1])


def ends_square(a: Ends) -> Ends:
    """Return the interval of squares."""
    low, high = ends_magnitude(a)
    low, high = ends_outward(low * low, high * high, _LAST, _LEAST)
    return max(low, 0.0), high


def ends_root(a: Ends) -> Ends:
    """Return the interval of square roots; nothing is known where it reaches below 0."""
    if not a[0] >= 0.0:
        return -inf, inf
    low, high = ends_outward(sqrt(a[0]), sqrt(a[1]), _LAST, 0.0)
    return max(low, 0.0), high


def ends_reciprocal(a: Ends) -> Ends:
    """Return the interval of reciprocals; nothing is known where it holds 0."""
    if not (a[0] > 0.0 or a[1] < 0.0):
        return -inf, inf
    return ends_outward(1.0 / a[1], 1.0 / a[0], _LAST, _LEAST)


def ends_exponential(a: Ends) -> Ends:
    """Return the interval of exponentials."""
    low, high = ends_outward(exp(a[0]), exp(a[1]), _FUNCTION, _LEAST)
    return max(low, 0.0), high


def ends_larger(a: Ends, b: Ends) -> Ends:
    """Return the interval of the larger of two numbers.

    Args:
        a: one interval.
        b: the other one.
    """
    return max(a[0], b[0]), max(a[1], b[1])


def ends_smaller(a: Ends, b: Ends) -> Ends:
    """Return the interval of the smaller of two numbers.

    Args:
        a: one interval.
        b: the other one.
    """
    return min(a[0], b[0]), min(a[1], b[1])


def holds_phase(a: Ends, phase: float) -> bool:
    """Return whether an interval holds a whole number of turns and a phase, or nearly so.

    Args:
        a: the interval.
        phase: in turns.
    """
    first, last = a[0] / (2.0 * pi), a[1] / (2.0 * pi)
    first = first - phase - 4.0 * _LAST * (abs(first) + 1.0)
    last = last - phase + 4.0 * _LAST * (abs(last) + 1.0)
    return not ceil(first) > floor(last)


def ends_wave(a: Ends, one: float, other: float, peak: float) -> Ends:
    """Return the interval of sines or cosines.

    Args:
        a: the angles.
        one: value at their lower end.
        other: value at their upper end.
        peak: where the function is 1, in turns.
    """
    if not (a[1] - a[0] < 4.0 and abs(a[0]) < 1e9):
        return -1.0, 1.0
    low, high = ends_outward(min(one, other), max(one, other), _FUNCTION, _LEAST)
    low, high = max(low, -1.0), min(high, 1.0)
    if a[1] > a[0]:
        low = -1.0 if holds_phase(a, peak + 0.5) else low
        high = 1.0 if holds_phase(a, peak) else high
    return low, high


def ends_sine(a: Ends) -> Ends:
    """Return the interval of sines."""
    return ends_wave(a, sin(a[0]), sin(a[1]), 0.25)


def ends_cosine(a: Ends) -> Ends:
    """Return the interval of cosines."""
    return ends_wave(a, cos(a[0]), cos(a[1]), 0.0)


def ends_angle(y: Ends, x: Ends) -> Ends:
    """Return the interval of angles of vectors; all where they may point to -x.

    Args:
        y: their second entry.
        x: their first one.
    """
    if x[0] <= 0.0 and y[0] <= 0.0 and y[1] >= 0.0:
        return -_ANGLE, _ANGLE
    side = x[1] if y[0] >= 0.0 else x[0]
    low = atan2(y[0] if side >= 0.0 else y[1], side)
    side = x[0] if y[1] > 0.0 else x[1]
    high = atan2(y[1] if side >= 0.0 else y[0], side)
    low, high = ends_outward(low, high, _FUNCTION, _LEAST)
    return max(low, -_ANGLE), min(high, _ANGLE)
