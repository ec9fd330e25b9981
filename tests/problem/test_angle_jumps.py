"""The period of what a sensor measures follows from the angles in its expression, or is stated."""

from __future__ import annotations

import math

import pytest
import sympy as sp

from safe_envs import ConfigurationError, SystemDefinitionError
from safe_envs.problem.measurement import Channel, default_measurement
from safe_envs.problem.signals import Feature
from tests.conftest import problem_of
from tests.problem.test_measurement import channels, own_problem

x, y, theta, k = sp.symbols("x y theta k", real=True)
p = sp.Symbol("p", positive=True)
TURN = 2 * math.pi
bearing = sp.atan2(y, x)


@pytest.mark.parametrize(
    ("expression", "period"),
    [
        (bearing, TURN),
        (180 / sp.pi * bearing, 360.0),
        (90 - 180 / math.pi * bearing, 360.0),
        (bearing - theta, TURN),
        (theta - bearing / 2, math.pi),
        (bearing - 2 * sp.atan2(y - 1, x), TURN),
        (sp.atan2(sp.sin(theta - bearing), sp.cos(theta - bearing)), TURN),
        (sp.atan(y / x), math.pi),
        (2 * sp.atan(y / (x + sp.sqrt(x**2 + y**2))), TURN),
        (sp.atan(sp.tan(theta)), math.pi),
        (5 * sp.acot(x), 5 * math.pi),
        (sp.Mod(180 / sp.pi * bearing, 360), 360.0),
        (sp.Mod(theta, TURN), TURN),
        (sp.frac(theta / 7), 1.0),
        # These have no jump.
        (sp.cos(bearing), 0.0),
        (sp.Abs(bearing), 0.0),
        (bearing**2, 0.0),
        (sp.atan(x), 0.0),
        (sp.atan(y / (1 + x**2)), 0.0),
        (sp.atan2(y, p), 0.0),
        (100 * theta, 0.0),
    ],
)
def test_the_period_is_the_size_of_the_jump(expression, period):
    assert Channel("b", expression, 0.1).period == pytest.approx(period, rel=1e-14)


@pytest.mark.parametrize(
    "expression",
    [
        x * bearing,
        k * bearing,
        bearing + sp.sqrt(2) * sp.atan2(y - 1, x),
        sp.Piecewise((bearing, bearing > 0), (bearing + 2 * sp.pi, True)),
        sp.atan2(bearing, x),
        sp.Mod(bearing, 3),
        sp.floor(bearing),
        sp.Max(bearing, x),
    ],
)
def test_a_period_that_does_not_follow_has_to_be_stated(expression):
    with pytest.raises(ConfigurationError, match=r"does not follow .* give period="):
        Channel("b", expression, 0.1)
    assert Channel("b", expression, 0.1, period=0).period == 0.0


def test_a_stated_period_fits_the_jump():
    for period in (TURN, math.pi, 6.28319, 0):
        assert Channel("b", bearing, 0.1, period=period).period == period
    for period in (6.28, 360, 2 * TURN):
        with pytest.raises(ConfigurationError, match=r"jumps by 6.28319 after a turn"):
            Channel("b", bearing, 0.1, period=period)


def test_texts_and_features_have_the_period_of_their_expression():
    found = channels(
        ["b=180/pi*atan2(y, x):noise=.1", "c=atan(y/x):noise=1"], "safe_envs/DubinsDisk-v0"
    )
    assert [c.period for c in found.values()] == [360.0, math.pi]
    with pytest.raises(ConfigurationError, match="the period of the measurement b does not follow"):
        channels("b=v*atan2(y, x):noise=.1", "safe_envs/DubinsDisk-v0")
    states = own_problem().plant.states
    feature = Feature("course", 3 * sp.atan2(*states), -10.0, 10.0)
    found = default_measurement(own_problem(features=(feature,))).channels
    assert [c.period for c in found] == pytest.approx([6 * math.pi])
    for c in problem_of("safe_envs/DubinsObstacle-v0", measurement="default").measurement.channels:
        assert c.period == (TURN if c.name in ("theta", "bearing") else 0.0)


def test_what_is_measured_is_an_expression():
    with pytest.raises(SystemDefinitionError, match="measurement b is a text, 'x'"):
        Channel("b", "x", 0.1)
