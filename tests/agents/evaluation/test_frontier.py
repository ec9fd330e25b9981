"""Points next to a curve."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safe_envs.agents.evaluation.frontier import Frontier, FrontierPoint, FrontierSpec, frontier
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.values.frontier import FrontierSettings

PRICES = np.array([0.0, 10.0, 100.0])
VALUES = (50.0, 47.0, 40.0)


def _point(rate, mean, half=1.0):
    ends = (max(rate - 0.01, 0.0), rate + 0.01, mean, mean - half, mean + half)
    return FrontierPoint("a", "filter", 100, round(100 * rate), 0, rate, *ends, VALUES)


def _frontier(*points):
    values = SimpleNamespace(prices=PRICES, values=np.array(VALUES), least_violations=7 / 90)
    values.largest_return = lambda v: (np.array(VALUES) + v[:, None] * PRICES).min(axis=1)
    return Frontier(None, values, (), points, {}, 0.95)  # pyright: ignore[reportArgumentType]


def test_the_cost_is_the_distance_to_the_least_line():
    below, on = _point(0.05, 30.0), _point(0.4, 50.0)
    found = _frontier(below, on)
    assert found.cost(below) == pytest.approx(15.0)
    assert found.cost(on) == pytest.approx(0.0)
    assert found.excess == 0.0


def test_the_least_risk_of_a_return_is_where_the_curve_has_it():
    found = _frontier(_point(0.5, 47.5))
    assert found.needed(found.points[0]) == pytest.approx(0.075)
    assert found.needed(_point(0.5, 30.0)) == 0.0


def test_points_beyond_their_intervals_show_the_error_of_the_grid():
    assert _frontier(_point(0.05, 48.0)).excess == pytest.approx(47.0 - 46.0)


def test_what_does_not_suit_is_an_error_unless_it_may_be_missing():
    problem = make_problem("Scalar-v0", horizon=0.05)
    settings = FrontierSettings(2, 0, (51,))
    spec = {"policies": {"nominal": "nominal"}, "filters": ("wrong",), "episodes": 4}
    with pytest.raises(ConfigurationError, match="wrong"):
        frontier(problem, FrontierSpec(**spec), settings)
    found = frontier(problem, FrontierSpec(**spec, may_miss=("wrong",)), settings)
    assert [point.name for point in found.points] == ["nominal"]
    assert "unknown filter" in found.left_out["wrong"]


def test_leaving_the_workspace_counts_as_asked():
    """The nominal controller is pulled down from the lowest safe state."""
    problem = make_problem("Scalar-v0", horizon=0.5, start=[-2.999], noise=0.5)
    spec = FrontierSpec({"zero": "zero"}, episodes=50)
    rates = []
    for leaving in ("violation", "safe"):
        found = frontier(problem, spec, FrontierSettings(2, 0, (51,), leaving))
        rates.append(found.points[0].violation_rate)
    assert rates == [1.0, 0.0]


def test_below_the_least_chance_of_a_violation_the_curve_is_the_line_of_the_largest_price():
    found = _frontier()
    plain, (chances, returns) = found.curve(), found.curve(bottom=30.0)
    assert plain[0][0] == pytest.approx(7 / 90)
    assert (chances[0], returns[0]) == (0.0, 40.0)
    assert found.curve(bottom=42.0)[0][0] == pytest.approx(0.02)
    assert (np.diff(chances) > 0).all()
    assert (np.diff(returns) >= 0).all()
    np.testing.assert_array_equal(chances[-len(plain[0]) :], plain[0])
