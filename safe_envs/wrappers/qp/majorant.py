"""Affine bounds of uncertain constraints with several inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.wrappers.qp.rounding import added

_TINY = 1e-300
"""A distance that can divide."""


def majorant(
    q: Sequence[Sequence[Any]], low: Sequence[Any], high: Sequence[Any]
) -> tuple[list[Any], Any]:
    """Return a plane c_0 + c . u above sqrt([1, u]' Q [1, u]) within input bounds.

    A constraint less the plane is on the safe side.

    Its slopes are the mean differences between the faces of the input bounds, and c_0 is as small
    as the corners allow: the root is convex, so that it is below the plane everywhere if it is at
    the corners.

    Args:
        q: symmetric Q, (1 + m) x (1 + m), floats or arrays (B,).
        low: m lower bounds.
        high: m upper bounds.

    Returns:
        c, m entries, and c_0, of the shape of the entries of Q.
    """
    m = len(low)
    corners = [[high[j] if k >> j & 1 else low[j] for j in range(m)] for k in range(2**m)]
    roots = []
    for corner in corners:
        w = (1.0, *corner)
        square: Any = added([q[i][j] * (w[i] * w[j]) for i in range(m + 1) for j in range(m + 1)])
        roots.append(np.sqrt(np.maximum(square, 0.0)))
    half = 2.0 ** (m - 1)
    # An input that is held, its two bounds being equal, has two equal faces and no slope.
    slopes = [
        added([r if k >> j & 1 else -r for k, r in enumerate(roots)])
        / (half * np.maximum(high[j] - low[j], _TINY))
        for j in range(m)
    ]
    above = [
        r - added([c * e for c, e in zip(slopes, corner, strict=True)])
        for r, corner in zip(roots, corners, strict=True)
    ]
    return slopes, np.maximum.reduce(above)
