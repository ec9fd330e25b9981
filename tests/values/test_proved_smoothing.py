"""Proved bounds of smoothed values against sums with many digits."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
import pytest

from safe_envs.values.grid import Axis, Grid
from safe_envs.values.proved import ProvedSmoothing

RNG = np.random.default_rng(1)


def expected(axis: Axis, values: np.ndarray, mean: float, size: float) -> Any:
    """Return E f(mean + size v) of a function that is constant on cells."""
    with mpmath.workdps(20):
        turns = range(-7, 8) if axis.period else (0,)
        edges = [mpmath.mpf(float(e)) for e in axis.edges]
        if axis.period:
            edges[-1] = edges[0] + 2 * mpmath.pi
        total = mpmath.mpf(0)
        for turn in turns:
            shift = 2 * mpmath.pi * turn - mpmath.mpf(mean)
            passed = [mpmath.ncdf((e + shift) / mpmath.mpf(size)) for e in edges]
            for value, a, b in zip(values, passed[:-1], passed[1:], strict=True):
                total += mpmath.mpf(float(value)) * (b - a)
        return total


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("axis", "size"),
    [
        (Axis(np.linspace(-1.0, 2.0, 31)), 0.13),
        (Axis(np.sort(RNG.random(40))), 0.004),
        (Axis(np.linspace(-np.pi, np.pi, 16), 2 * np.pi), 0.3),
        (Axis(np.linspace(-np.pi, np.pi, 16), 2 * np.pi), 4.0),
    ],
)
def test_bounds_are_below_and_close_at_the_worst_mean(axis, size, sign):
    values = sign * RNG.random(axis.count)
    smoothing = ProvedSmoothing(Grid((axis,)), [size])
    bounds = smoothing.smoothed(values)
    means = smoothing.means.axes[0]
    for cell in RNG.choice(means.count, size=3, replace=False):
        low, high = means.edges[cell], means.edges[cell + 1]
        inner = [expected(axis, values, m, size) for m in np.linspace(low, high, 3)]
        assert mpmath.mpf(float(bounds[cell])) <= min(inner)
        # The formula is no worse than the change of each step over the cell.
        assert min(inner) - float(bounds[cell]) < 1.2 * 12 * (high - low) / size
    assert smoothing.beyond < 2e-12


def test_constants_lose_nothing_but_rounding():
    axis = Axis(np.linspace(-5.0, 5.0, 1001))
    smoothing = ProvedSmoothing(Grid((axis, axis)), [0.05, 0.02])
    found = smoothing.smoothed(np.ones(axis.count**2))
    middle = tuple(n // 2 for n in found.shape)
    assert 1.0 - 1e-12 < found[middle] < 1.0
