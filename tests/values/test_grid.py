"""Cells of axes: where values lie, in periods too, and cells that are added."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.values.expected_value_kernel import cell_of_value
from safe_envs.values.grid import Axis, Grid, grid_arrays

UNEVEN = np.array([-1.0, -1.0 + 1e-9, -0.5, 0.1, 0.1 + 1e-12, 2.0, 2.0 + 1e-9])
EDGES = [UNEVEN, np.linspace(-3, 3, 8), np.array([0.0, 1.0]), np.array([-1e6, 0, 1e-6, 2e-6, 1e6])]


@pytest.mark.parametrize("edges", EDGES)
def test_a_cell_holds_its_lower_edge(edges):
    axis = Axis(edges)
    np.testing.assert_array_equal(axis.cell_of(edges[:-1]), np.arange(axis.count))
    below = axis.cell_of(np.nextafter(edges, -np.inf))
    np.testing.assert_array_equal(below, np.arange(-1, axis.count))
    assert axis.cell_of(edges[-1]) == axis.count - 1
    np.testing.assert_array_equal(
        axis.cell_of([-np.inf, np.inf, np.nan, edges[-1] + 1]), [-1, *[axis.count] * 3]
    )


@pytest.mark.parametrize("edges", EDGES)
def test_kernels_find_the_same_cells(edges):
    axis = Axis(edges)
    arrays = grid_arrays(Grid((axis,)))
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [
            edges,
            np.nextafter(edges, -np.inf),
            np.nextafter(edges, np.inf),
            rng.uniform(edges[0] - 1, edges[-1] + 1, 500),
            [-np.inf, np.inf, -1e300, 1e300],
        ]
    )
    for value in values:
        found = cell_of_value(
            float(value), 0, arrays.counts, arrays.places, arrays.edges, arrays.scales
        )
        assert found == np.searchsorted(edges, value, side="right") - 1


def test_values_of_a_periodic_axis_are_wrapped():
    axis = Axis(np.linspace(-np.pi, np.pi, 9), 2 * np.pi)
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, 100)
    for turns in (-3, 0, 1, 7):
        np.testing.assert_array_equal(
            axis.cell_of(angles + 2 * np.pi * turns), axis.cell_of(angles)
        )
    hard = np.array([np.pi, -np.pi, np.nextafter(-np.pi, -4), 1e15, -1e-300])
    assert ((axis.cell_of(hard) >= 0) & (axis.cell_of(hard) < 8)).all()
    assert axis.widened(3.0) is axis


def test_parts_and_more_cells():
    axis = Axis(UNEVEN)
    fine = axis.refined(2)
    np.testing.assert_array_equal(fine.edges[::2], axis.edges)
    assert (np.diff(fine.edges) > 0).all()
    wide = axis.widened(10.0, coarse=0.5)
    assert wide.edges[0] <= axis.edges[0] - 10
    assert wide.edges[-1] >= axis.edges[-1] + 10
    assert set(axis.edges) <= set(wide.edges)
    assert wide.count < axis.count + 2 * 25


def test_cells_of_a_grid():
    grid = Grid((Axis(np.linspace(0, 1, 4)), Axis(UNEVEN), Axis(np.linspace(-1, 1, 3), 2.0)))
    low, high = grid.corners(np.arange(grid.cells))
    middle = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
    np.testing.assert_array_equal(grid.cell_of(middle), np.arange(grid.cells))
    outside = [np.array([0.5, 2.0]), np.array([9.0, 0.0]), np.array([0.0, 0.0])]
    np.testing.assert_array_equal(grid.cell_of(outside), -1)
