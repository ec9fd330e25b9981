"""How many features there are, and that too many are refused before they are written out."""

from __future__ import annotations

import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.models.features import Features
from tests.conftest import problem_of


@pytest.mark.parametrize("name", ["CubicSDE", "StochasticDubins", "DubinsObstacles"])
def test_their_number_is_known_before_they_are(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    for degree in range(3):
        features = Features.of(problem, degree)
        assert features.count == len(features.expressions)
        assert Features.allowed(problem, degree)


def test_too_many_are_refused():
    with pytest.raises(
        ConfigurationError,
        match="degree = 300 makes 45451 features of x_1, x_2; give one with at most 300",
    ):
        Features.of(problem_of("safe_envs/CubicSDE-v0"), 300)
    with pytest.raises(ConfigurationError, match="degree = 3 makes 546 features of x, y, z"):
        Features.of(problem_of("safe_envs/QuadrotorLimits-v0"), 3)
    assert not Features.allowed(problem_of("safe_envs/QuadrotorLimits-v0"), 3)


def test_the_degree_is_called_as_the_user_calls_it():
    with pytest.raises(
        ConfigurationError, match="diffusion_degree = -1; give a whole number from 0"
    ):
        Features.of(problem_of("safe_envs/CubicSDE-v0"), -1, "diffusion_degree")
