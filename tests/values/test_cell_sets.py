"""What cells lie in, against points of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.values.cells import Sets, hull_of, uniform_grid
from safe_envs.values.reduction import reduced
from tests.values.systems import scalar, x

pytestmark = pytest.mark.filterwarnings("ignore:the input bounds")
BARRIERS = {
    "edge": x,
    "hill": 1 - (x - 1) ** 2,
    "two parts": sp.sin(5 * x),
    "kinks": sp.Max(sp.Abs(x - 1) - sp.Rational(1, 2), -x),
    "thin": 1e-8 - (x - sp.Rational(1, 3)) ** 2,
    "whole": 3 + x,
}


@pytest.fixture(params=BARRIERS)
def small(request):
    start = {"thin": (1 / 3,), "edge": (0.5,)}.get(request.param, (0.4,))
    problem = scalar(barriers=BARRIERS[request.param], start=start)
    return reduced(replace(problem, goal=x - sp.Rational(3, 2)))


@pytest.mark.parametrize("leaving", ["violation", "safe"])
@pytest.mark.parametrize("count", [7, 60])
def test_cells_are_what_their_points_are(small, leaving, count):
    sets = Sets(small, leaving)
    grid = uniform_grid(small.coordinates, [(-2.0, 3.0)], [count])
    cells = sets.of_cells(grid, 0)
    (low,), (high,) = grid.corners(np.arange(count))
    parts = np.linspace(0, 1, 400)
    q = low[:, None] + (high - low)[:, None] * parts
    inside, ends = (
        e.reshape(q.shape) for e in sets.of_states(np.zeros(q.size, dtype=int), [q.ravel()])
    )
    # Points at the very edge may be judged either way.
    near = np.abs(np.subtract.outer(q, [-1.0, 2.0])).min(axis=-1) < 1e-9
    # The edge of a cell may be that of the safe set.
    near[:, [0, -1]] = True
    assert inside[cells.inside][~near[cells.inside]].all()
    assert not inside[~cells.touches].any()
    assert ends[cells.ends].all()
    assert not ends[~cells.may_end][~near[~cells.may_end]].any()
    assert not (cells.inside & ~cells.touches).any()
    may = sets.may_hold(np.zeros(q.size, dtype=int), [q.ravel()]).reshape(q.shape)
    assert may[inside].all()
    assert (may != inside).mean() < 0.01


def test_the_hull_holds_the_safe_set(small):
    sets = Sets(small, "violation")
    (edges,) = hull_of(small, sets)
    assert (np.diff(edges) > 0).all()
    q = np.linspace(-1, 2, 200_001)
    inside, _ = sets.of_states(np.zeros(len(q), dtype=int), [q])
    if inside.any():
        assert edges[0] <= q[inside].min()
        assert edges[-1] >= q[inside].max()
        assert edges[-1] - edges[0] < q[inside].max() - q[inside].min() + 1e-3
    if len(edges) > 2 and edges[1] - edges[0] < 1e-6:
        assert sets.may_hold(np.zeros(1, dtype=int), [edges[1:2]]).any()


def test_no_safe_state_is_an_error():
    small = replace(reduced(scalar()), barriers=(x - 5,))
    with pytest.raises(ConfigurationError, match="no state of scalar"):
        hull_of(small, Sets(small, "violation"))
