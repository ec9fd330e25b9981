"""Certified envelopes of closed loops are below what the controllers attain, and close in."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.filters.conditions.text import conditions_for
from safe_envs.registry import make_problem
from safe_envs.values.closed_loop import closed_loop_table
from tests.values.systems import quadrature, scalar, x


@pytest.mark.parametrize("sigma", [0.4, 0.2 + 0.3 * x**2])
def test_a_policy_without_a_filter(sigma):
    problem = scalar(sp.sin(3 * x), sigma, nominal=sp.Rational(1, 2))
    q, exact = quadrature(problem, np.array([0.5]), (0.0, 2.0))
    gaps = []
    for cells in (100, 400):
        table = closed_loop_table(problem, None, "nominal", (cells,))
        found = table.start_bounds((q,))
        assert (found <= exact[0] + 1e-9).all()
        for k, values in enumerate(exact):
            assert (table.lower[k, table.grid.cell_of([q])] <= values + 1e-9).all()
        gaps.append((exact[0] - found).mean())
    # Where noise is divided into boxes, theirs is the larger part of the gap.
    assert gaps[1] < (0.4 if sigma == 0.4 else 0.9) * gaps[0]


def test_any_policy_is_bounded_by_the_worst_one():
    problem = scalar(0, 0.3)
    lower = closed_loop_table(problem, None, "any", (300,))
    points = (np.linspace(0.05, 1.95, 60),)
    worst = np.ones(60)
    for u in (-1, 0, 1):
        own = closed_loop_table(scalar(0, 0.3, nominal=u), None, "nominal", (300,))
        worst = np.minimum(worst, own.start_bounds(points))
    assert (lower.start_bounds(points) <= worst + 1e-7).all()
    assert lower.start_bounds(points).max() > 0.3
    # A filter takes inputs away from it.
    filtered = closed_loop_table(problem, conditions_for(problem, "scbf")[0], "any", (300,))
    assert (filtered.start_bounds(points) >= lower.start_bounds(points) - 1e-6).all()
    assert filtered.start_bounds(points).mean() > lower.start_bounds(points).mean() + 0.05


def test_starts_outside_of_the_safe_set_get_nothing():
    table = closed_loop_table(scalar(), None, "nominal", (50,))
    assert table.start_bounds((np.array([-0.5, 0.0, 2.5]),)).tolist() == [0, 0, 0]


def test_two_coordinates():
    problem = make_problem("safe_envs/CubicSDEDisk-v0", horizon=0.05)
    condition = conditions_for(problem, "scbf")[0]
    nominal = closed_loop_table(problem, condition, "nominal", (60, 60))
    anything = closed_loop_table(problem, condition, "any", (60, 60))
    points = (np.array([0.0, 0.3]), np.array([0.0, -0.4]))
    assert (anything.start_bounds(points) <= nominal.start_bounds(points) + 1e-6).all()
    assert anything.start_bounds(points).min() > 0.9
    assert 0.3 < nominal.mean_over_starts(problem) < nominal.lower[0].max()


def test_several_inputs_are_refused():
    problem = make_problem("safe_envs/Quadrotor-v0")
    with pytest.raises(ConfigurationError, match="4 inputs"):
        closed_loop_table(problem, None, "nominal")
