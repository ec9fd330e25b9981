"""Bounds of the normal distribution function hold it, and are next to it."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np

from safe_envs.values.smoothing import normal_above, normal_below


def exact(z: float) -> Any:
    with mpmath.workdps(40):
        return mpmath.ncdf(mpmath.mpf(z))


def test_they_hold_the_function():
    rng = np.random.default_rng(0)
    nodes = np.arange(-72, 73) / 8
    # The polynomial is worst halfway between two nodes.
    z = np.concatenate([rng.normal(scale=4, size=1500), nodes, nodes + 1 / 16, nodes - 1 / 16])
    z = np.append(z, [0.0, -0.0, 9.0, -9.0, np.nextafter(9, 10), np.nextafter(-9, -10), 30, -30])
    low, high = normal_below(z), normal_above(z)
    for a, b, value in zip(low, high, map(exact, z), strict=True):
        assert 0 <= a <= value <= b <= 1
    assert (high - low <= 9.1e-16).all()


def test_infinite_arguments():
    assert normal_below([-np.inf, np.inf])[0] == 0
    assert normal_above([-np.inf, np.inf])[1] == 1
