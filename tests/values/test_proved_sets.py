"""Cells count that lie in the safe set for certain."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs.values.grid import Axis, Grid
from safe_envs.values.proved import ProvedSets
from safe_envs.values.reduction import reduced
from tests.values.systems import scalar, x


def sets_of(barrier, edges, blur, leaving="violation"):
    small = reduced(scalar(barriers=barrier, start=(0.7,)))
    return ProvedSets(small, leaving, Grid((Axis(np.asarray(edges, float)),)), [blur])


@pytest.mark.parametrize("blur", [0.0, 0.1])
def test_a_cell_up_to_the_edge_of_the_set_counts_but_for_a_strip(blur):
    found = sets_of(x * (2 - x), np.linspace(-1.0, 2.0, 31), blur)
    # Also where h(2) = 0 is the end of the workspace, and of the grid.
    assert found.inside.tolist() == [False] * 10 + [True] * 20
    if blur:
        assert 0.0 < found.lost < 1e-8
        assert found.widening == [0.0]
    else:
        assert found.lost == 0.0
        assert 0.0 < found.widening[0] < 1e-9


def test_a_point_that_is_missing_is_seen_by_narrow_strips_only_with_noise():
    barrier = sp.Abs(x - 0.5)
    assert sets_of(barrier, [-1, 0.5, 2], 0.1).lost > 0.0
    without = sets_of(barrier, [-1, 0.5, 2], 0.0)
    assert not without.inside.any()


def test_a_set_that_ends_in_a_cell_is_none_of_it():
    found = sets_of(x, [-1.0, 0.3, 2.0], 0.1)
    assert found.inside.tolist() == [False, True]
    assert found.touches.tolist() == [True, True]


def test_safe_states_outside_of_the_grid_are_found():
    assert sets_of(x, np.linspace(-1e-6, 2.0, 9), 0.1).covered()
    assert sets_of(x, np.linspace(0.0, 2.0, 9), 0.1).covered() is False
    assert sets_of(x, np.linspace(-0.5, 1.9, 9), 0.1).covered() is False
