import numpy as np
import pytest

from safe_envs.values import bellman_arrays
from safe_envs.values.expected_value_kernel import AXES
from safe_envs.values.grid import Axis, Grid, grid_arrays
from safe_envs.values.promise_kernel import kept_values

CELLS = np.array([[0.0, 0.5, 0.8, 1.0]], dtype=np.float32)
WEIGHTS = np.array([0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("function", [kept_values, bellman_arrays.kept_values])
def test_the_cap_is_the_least_with_the_wanted_mean(function):
    """A box of noise for each of four cells."""
    grid = grid_arrays(Grid((Axis(np.linspace(0.0, 4.0, 5)),)))
    middles = np.arange(4.0) + 0.5
    images = np.broadcast_to(middles[None, None, None, :, None, None], (5, 1, 1, 4, 1, 2)).copy()
    effects, inputs = np.zeros((5, 1, 1, 1, 2)), np.zeros((5, 1, 1, 2))
    exact = WEIGHTS @ CELLS[0]
    levels = np.array([0.2, 0.45, 0.6, exact - 1e-6, 0.9])
    expected, caps = np.zeros(5), np.zeros(5)
    function(0, 5, images, effects, inputs, WEIGHTS, np.zeros(5, dtype=np.int64), CELLS, *grid,
             np.zeros(2 * AXES), np.zeros(4), levels, expected, caps)  # fmt: skip
    np.testing.assert_allclose(expected, exact, rtol=1e-12)
    reached = np.minimum(CELLS[0], caps[:4, None]) @ WEIGHTS
    assert (reached >= levels[:4]).all()
    np.testing.assert_allclose(reached, levels[:4], rtol=1e-7)
    assert caps[4] == np.inf
