"""Grids as arrays that kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.value.expected_value_kernel import AXES
from safe_envs.wrappers.value.grid import Grid

ROUNDING = 1e-13
"""Of the largest number of an axis: how far a sum of a few numbers may be off."""

POINT_SLACK = 4e-7
"""The same for states and inputs that pass through single precision, as observations and actions
do. It is for problems without noise, where a little off may be outside for good; with noise a
state is as likely at one place as at another so near to it."""

CELL_SLACK = 1e-6
"""The same for cells: a state that is read off an observation may lie next to its cell by the
slack of a point, and goes as far as that from there."""


class GridArrays(NamedTuple):
    """A grid as arrays, with axes of one cell in place of those that it does not have.

    Attributes:
        counts: for each axis the number of cells, the place of its first edge, that of its first
            entry in `places`, the number of these entries, and the cells of a block for which an
            entry of the tables stands; int64, shape (5 * AXES,).
        places: of all axes, see `Axis.places`, int32.
        edges: of all axes.
        scales: for each axis the first edge, the entries of `places` for a unit, the period, and
            by how much intervals are widened; shape (AXES, 4).
    """

    counts: np.ndarray
    places: np.ndarray
    edges: np.ndarray
    scales: np.ndarray


def grid_arrays(
    grid: Grid, slack: float = ROUNDING, blocks: Sequence[int] | None = None
) -> GridArrays:
    """Return a grid as arrays.

    Args:
        grid: to describe.
        slack: by which intervals are widened, of the largest number of an axis.
        blocks: cells along each axis for which an entry of the tables stands; None for one.
    """
    counts = np.zeros((5, AXES), dtype=np.int64)
    counts[0] = counts[4] = 1
    counts[4, : len(grid.axes)] = blocks or 1
    scales = np.zeros((AXES, 4))
    edges = np.concatenate([axis.edges for axis in grid.axes])
    places = np.concatenate([axis.places for axis in grid.axes])
    first_edge = first_place = 0
    for i, axis in enumerate(grid.axes):
        extent = axis.edges[-1] - axis.edges[0]
        counts[:4, i] = axis.count, first_edge, first_place, len(axis.places)
        size = max(abs(axis.edges[0]), abs(axis.edges[-1]))
        scales[i] = axis.edges[0], len(axis.places) / extent, axis.period, slack * size
        first_edge += axis.count + 1
        first_place += len(axis.places)
    return GridArrays(counts.ravel(), places, edges, scales)
