"""Windows hold all cells that boxes touch, and least values are those of their cells."""

from __future__ import annotations

import numpy as np

from safe_envs.values.grid import Axis, Grid
from safe_envs.values.windows import Bordered, Groups, windows_of

RNG = np.random.default_rng(0)
PLAIN = Axis(np.sort(RNG.random(18)) * 3.0 - 1.0)
TURN = Axis(np.linspace(-np.pi, np.pi, 12), 2 * np.pi)


def least_of_points(grid: Grid, table: np.ndarray, low, high) -> float:
    """Return the least value over a fine lattice in a box, 0.5 outside of the grid."""
    points = np.meshgrid(*[np.linspace(a, b, 60) for a, b in zip(low, high, strict=True)])
    cells = grid.cell_of([p.ravel() for p in points])
    return float(np.where(cells < 0, 0.5, table.ravel()[cells]).min())


def test_the_least_value_of_a_box_is_that_of_its_cells():
    grid = Grid((PLAIN, TURN))
    table = RNG.random(grid.shape)
    low = RNG.normal(size=(300, 2)) * [1.0, 8.0]
    high = low + RNG.exponential(size=(300, 2)) * [0.3, 1.5]
    groups = Groups(grid, windows_of(grid, low, high))
    found = groups.least(Bordered(grid, table, 0.5))
    true = np.array([least_of_points(grid, table, a, b) for a, b in zip(low, high, strict=True)])
    assert (found <= true).all()
    # A lattice may miss a corner of a cell that a box touches, but seldom does.
    assert (found == true).mean() > 0.9


def test_edges_touch_the_cells_on_both_sides():
    grid = Grid((Axis(np.arange(5.0)),))
    ends = np.array([[2.0, 2.0], [0.0, 0.5], [3.5, 4.0], [-1.0, -0.5], [-np.inf, np.inf]])
    windows = windows_of(grid, ends[:, :1], ends[:, 1:])
    assert windows.first[0].tolist() == [2, 0, 4, 0, 0]
    assert windows.last[0].tolist() == [3, 1, 5, 0, 5]
    least = Groups(grid, windows).least(Bordered(grid, np.array([4.0, 3.0, 2.0, 5.0]), -1.0))
    assert least.tolist() == [2.0, -1.0, -1.0, -1.0, -1.0]


def test_a_whole_turn_touches_all_cells():
    grid = Grid((TURN,))
    low = np.array([[-9.0], [0.1], [3.1], [-np.inf]])
    high = np.array([[9.0], [0.1 + 2 * np.pi], [3.2], [1.0]])
    windows = windows_of(grid, low, high)
    widths = (windows.last - windows.first + 1)[0].tolist()
    assert widths == [11, 11, 2, 11]
    assert windows.first[0, 2] == 10
