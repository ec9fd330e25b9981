"""`safe_envs.wrappers.qp.majorant` for one state."""

from __future__ import annotations

from math import sqrt

import numpy as np

NO_WIDTH = 1e-300
"""A distance that can divide."""


def work_of_majorant(m: int) -> int:
    """Return the length of the scratch array of `majorant_plane`: the corners of the bounds.

    Args:
        m: number of inputs.
    """
    return 2**m


def majorant_plane(
    q: np.ndarray, low: np.ndarray, high: np.ndarray, slopes: np.ndarray, work: np.ndarray
) -> float:
    """Find a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within input bounds.

    Args:
        q: symmetric Q, shape (1 + m, 1 + m).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        slopes: receives c, shape (m,).
        work: scratch of `work_of_majorant`.

    Returns:
        c_0.
    """
    m = len(low)
    corners = 1 << m
    for c in range(corners):
        square = 0.0
        for i in range(m + 1):
            for j in range(m + 1):
                product = entry_of_corner(c, i, low, high) * entry_of_corner(c, j, low, high)
                square += q[i, j] * product
        work[c] = sqrt(0.0 if square < 0.0 else square)
    for j in range(m):
        rise = 0.0
        for c in range(corners):
            rise += work[c] if c >> j & 1 else -work[c]
        # An input that is held, its two bounds being equal, has two equal faces and no slope.
        slopes[j] = rise / (0.5 * corners * max(high[j] - low[j], NO_WIDTH))
    above = 0.0
    for c in range(corners):
        plane = 0.0
        for j in range(m):
            plane += slopes[j] * entry_of_corner(c, j + 1, low, high)
        gap = work[c] - plane
        above = gap if c == 0 or gap > above else above
    return above


def entry_of_corner(c: int, i: int, low: np.ndarray, high: np.ndarray) -> float:
    """Return entry i of [1, u] at corner c of the input bounds.

    Args:
        c: the corner, whose bit j says whether input j is at its upper bound.
        i: the entry.
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
    """
    if i == 0:
        return 1.0
    return high[i - 1] if c >> (i - 1) & 1 else low[i - 1]
