"""From an allowed input on towards a proposed one, along what the plans leave free.

With several inputs the segment from a backup input to the proposed one is a poor choice: to save an
altitude it gives up the heading too. From an allowed input p, let l_i(u) be the smallest value of
barrier i on the plan after u. The slopes of l_i at p, by differences, make it linear, and of the
inputs that keep the linear l_i above the floor, w is the nearest to the proposed one. Points
between p and w are then tried as all others are: what is executed is verified, however wrong the
slopes may be.

w is found by ascent in the multipliers y_i of the dual: w = clip(u + A'y), y_i = max(0, y_i + (c_i
- a_i w)/|a_i|^2), one after the other (Hildreth's method, with the clipped primal of the bounds).
"""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.wrappers.backup.plans import Plans

DIFFERENCE = 1e-3
"""Of inputs, in parts of the width of their bounds."""

LEFT = 0.1
"""Part of the room above the floor that the linear model is to leave."""

SWEEPS = 20
"""Of the dual ascent; a rest only makes w another input that is tried."""


def aims(
    plans: Plans,
    law: int,
    x: Components,
    given: tuple[Components, Components],
    floor: float,
) -> Components:
    """Return the inputs w of a law's plans, m components (R,) within their bounds.

    Args:
        plans: that are simulated.
        law: its index.
        x: p components (R,) of the states.
        given: m components (R,) of allowed inputs p, and of the proposed ones.
        floor: below which no barrier may be.
    """
    point, wanted = (np.array(part) for part in given)
    m, size = point.shape
    low, high = (np.array(ends)[:, None] for ends in plans.bounds)
    step = DIFFERENCE * (high - low)
    step = np.where(point + step > high, -step, step)
    tried = np.repeat(point[:, None, :], m + 1, axis=1)
    tried[np.arange(m), np.arange(1, m + 1)] += step
    at = tuple([np.tile(c, m + 1) for c in x])
    _, lows = plans.whole(law, at, tuple(tried.reshape(m, -1)))
    lows = lows.reshape(plans.count, m + 1, size)
    slopes = (lows[:, 1:] - lows[:, :1]) / step
    slopes = np.where(np.isfinite(slopes.sum(axis=1))[:, None], slopes, 0.0)
    room = (1.0 - LEFT) * np.maximum(lows[:, 0] - floor, 0.0)
    needed = (slopes * point).sum(axis=1) - room
    squares = (slopes**2).sum(axis=1)
    counts, squares = squares > 0.0, np.where(squares > 0.0, squares, 1.0)
    found, multipliers = wanted, np.zeros((plans.count, size))
    for _ in range(SWEEPS):
        for i in range(plans.count):
            missing = needed[i] - (slopes[i] * found).sum(axis=0)
            change = np.where(counts[i], missing / squares[i], 0.0)
            multipliers[i] = np.maximum(0.0, multipliers[i] + change)
            found = np.clip(wanted + (slopes * multipliers[:, None]).sum(axis=0), low, high)
    return tuple(found)
