"""Bounds of expected values under noise along axes, against the normal distribution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from safe_envs.values.grid import Axis, Grid
from safe_envs.values.smoothing import Smoothing, rounded_down


def exact(axis, values, counts, size, mean):
    """Return the expected value at some means, of values on cells; 0 outside."""
    edges = axis.edges
    total = np.zeros(len(mean))
    turns = np.arange(-60, 61) * axis.period if axis.period else [0.0]
    for turn in turns:
        passed = ndtr((edges + turn - mean[:, None]) / size)
        total += np.diff(passed, axis=1) @ (values * counts)
    return total


UNEVEN = np.array([-1, -1 + 1e-9, -0.5, -0.2, 0.1, 0.7, 0.75, 1.0])


@pytest.mark.parametrize("period", [0.0, 2.0])
@pytest.mark.parametrize("size", [1e-12, 1e-3, 0.1, 20.0])
@pytest.mark.parametrize("edges", [UNEVEN, np.linspace(-1, 1, 120)])
@pytest.mark.parametrize("sign", [1, -1])
def test_bounds_along_one_axis(period, size, edges, sign):
    rng = np.random.default_rng(0)
    axis = Axis(edges, period)
    smoothing = Smoothing(Grid((axis,)), [size])
    assert smoothing.means.cells < 5000
    values = sign * rng.random(axis.count).astype(np.float32)
    counts = rng.random(smoothing.fine.cells) < 0.8
    found = smoothing.smoothed(values, counts)
    means = smoothing.means.axes[0]
    fine = smoothing.fine.axes[0]
    mean = np.sort(rng.uniform(means.edges[0], means.edges[-1], 500))
    wanted = exact(fine, np.repeat(values, smoothing.parts[0]), counts, size, mean)
    cells = means.cell_of(mean)
    assert (found[cells] <= wanted + 1e-9).all()
    # What the blocks hold is the least of the cells that begin there.
    least = smoothing.least_around(found)
    follow = np.roll(found, -1) if period else np.append(found[1:], found[-1])
    wanted = np.minimum(found, follow) if smoothing.parts[0] == 2 else found
    np.testing.assert_array_equal(least, wanted)


@pytest.mark.parametrize("size", [0.02, 0.1, 1.0])
def test_bounds_are_close_for_values_with_one_hill(size):
    axis = Axis(np.linspace(-1, 1, 301))
    smoothing = Smoothing(Grid((axis,)), [size])
    values = np.cos(1.5 * axis.edges[:-1]).astype(np.float32)
    found = smoothing.smoothed(values, np.ones(smoothing.fine.cells, dtype=bool))
    mean = np.linspace(-0.999, 0.999, 200)
    wanted = exact(axis, values, 1, size, mean)
    slack = wanted - found[smoothing.means.cell_of([mean])]
    assert 0 <= slack.max() < 0.01 * min(8, 0.1 / size + 1)


def test_several_axes_are_bounded_one_after_the_other():
    rng = np.random.default_rng(1)
    grid = Grid((Axis(np.linspace(0, 1, 20)), Axis(np.linspace(0, 2, 5)), Axis(UNEVEN, 2.0)))
    smoothing = Smoothing(grid, [0.1, 0.0, 0.3])
    assert smoothing.parts[1] == 1
    assert 0 < smoothing.beyond < 1e-9
    table = rng.random(grid.cells).astype(np.float32)
    counts = rng.random(smoothing.fine.cells) < 0.9
    found = smoothing.smoothed(table, counts).reshape(smoothing.means.shape)
    values = table.reshape(grid.shape).repeat(smoothing.parts[0], 0).repeat(smoothing.parts[2], 2)
    values = np.where(counts.reshape(values.shape), values, 0)
    draws = rng.normal(size=(2, 40_000))
    fine = smoothing.fine
    for _ in range(5):
        at = [rng.uniform(a.edges[0], a.edges[-1]) for a in grid.axes]
        moved = [at[0] + 0.1 * draws[0], np.full(40_000, at[1]), at[2] + 0.3 * draws[1]]
        cells = fine.cell_of(moved)
        mean = np.where(cells >= 0, values.ravel()[cells], 0.0).mean()
        bound = found.ravel()[smoothing.means.cell_of([np.array([c]) for c in at])][0]
        assert bound <= mean + 4 * 0.5 / 200
        assert bound >= mean - 0.3


def test_without_noise_nothing_is_smoothed():
    grid = Grid((Axis(np.linspace(0, 1, 5)),))
    smoothing = Smoothing(grid, [0.0])
    table = np.array([0.1, 0.2, 0.3, 0.4], dtype=np.float32)
    found = smoothing.smoothed(table, np.array([True, False, True, True]))
    np.testing.assert_array_equal(found, np.array([0.1, 0, 0.3, 0.4], dtype=np.float32))
    assert smoothing.least_around(found) is found


def test_rounding_is_downwards():
    values = np.random.default_rng(0).uniform(-1, 1, 1000)
    found = rounded_down(values)
    assert found.dtype == np.float32
    assert (found <= values).all()
    np.testing.assert_allclose(found, values, atol=1e-7)
    np.testing.assert_array_equal(rounded_down(np.array([0.0, 1.0, 0.5])), [0, 1, 0.5])
