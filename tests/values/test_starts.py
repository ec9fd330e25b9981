"""Mean values over starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.values.look_ahead import LookAhead, draw_starts, start_values
from tests.values.systems import quadrature, scalar, solved, x


def test_one_start_needs_no_margin():
    problem = scalar()
    values = start_values(LookAhead(solved(problem, 200, inputs=5), problem), problem)
    q, exact = quadrature(problem, np.linspace(-1, 1, 5), (0.0, 2.0))
    at = np.interp(0.5, q, exact[0])
    assert values.starts == 1
    assert values.margin == (0, 0)
    assert values.lower <= at + 1e-6
    assert values.upper >= at - 1e-6
    assert values.upper - values.lower < 0.02


def test_the_mean_over_random_starts():
    problem = scalar(start=((0.1, 0.8),))
    ahead = LookAhead(solved(problem, 200, inputs=5), problem)
    values = start_values(ahead, problem)
    q, exact = quadrature(problem, np.linspace(-1, 1, 5), (0.0, 2.0))
    mean = np.interp(np.linspace(0.1, 0.8, 5000), q, exact[0]).mean()
    assert values.starts > 1000
    assert values.lower <= mean <= values.upper
    assert 0 < max(values.margin) < 0.02
    lower, upper = ahead.start_bounds(draw_starts(problem, values.starts, 0))
    assert values.lower == pytest.approx(lower.mean() - values.margin[0], abs=1e-12)
    assert values.upper == pytest.approx(min(1.0, upper.mean() + values.margin[1]), abs=1e-12)
    assert start_values(ahead, problem) == values


def test_starts_meet_their_condition():
    problem = scalar(start=((-0.5, 0.5),))
    (states,) = draw_starts(problem, 500, 0)
    assert states.shape == (500,)
    assert states.min() > 0
    hard = replace(problem.starts[problem.start], condition=x - 0.4999999)
    with pytest.raises(ConfigurationError, match="hardly ever"):
        draw_starts(replace(problem, starts={problem.start: hard}), 50_000, 0)
