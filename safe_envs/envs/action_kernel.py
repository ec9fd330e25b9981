"""Actions in [-1, 1] and bounded numbers, as kernels."""

from __future__ import annotations


def scaled_action(action: float, center: float, half_width: float) -> float:
    """Return the physical input of an action, clipped to [-1, 1].

    Args:
        action: of one input.
        center: midpoint of the input's bounds.
        half_width: distance from it to both bounds.
    """
    if action > 1.0:
        return center + half_width
    if action < -1.0:
        return center - half_width
    return center + half_width * action


def within(value: float, low: float, high: float) -> float:
    """Return a number, clipped to an interval; NaN stays.

    Args:
        value: the number.
        low: lower end.
        high: upper end.
    """
    if value < low:
        return low
    if value > high:
        return high
    return value
