"""Problems with several barriers: a field of moving obstacles, and the limits of a quadrotor."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SystemDefinitionError
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.dynamics.lie import lie_derivative_f
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

FIELD = "safe_envs/DubinsObstacles-v0"
LIMITS = "safe_envs/QuadrotorLimits-v0"


@pytest.mark.parametrize("count", [1, 2, 20])
def test_number_of_obstacles_is_respected(count):
    env = gym.make(FIELD, num_obstacles=count)
    problem = problem_of(FIELD, num_obstacles=count)
    observation, info = env.reset(seed=0)
    assert observation.shape == (4 + 2 * count,)
    assert info["barrier"].shape == (count,)
    assert [b.name for b in problem.barriers] == [f"h_{i}" for i in range(1, count + 1)]


@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_derivative_of_each_barrier_contains_the_velocity_of_its_obstacle(speed):
    dt = 1e-4
    env = gym.make(FIELD, plant={"v": speed}, model={"v": speed}, dt=dt, horizon=1.0)
    problem = env.unwrapped.problem
    _, info = env.reset(seed=0)
    values, states = [info["barrier"]], []
    for _ in range(2):
        values.append(env.step(np.zeros(1))[4]["barrier"])
        states.append(env.unwrapped.state)
    measured = (values[2] - values[0]) / (2 * dt)
    assert (np.abs(measured) > 1e-2).all()
    for i, barrier in enumerate(problem.barriers):
        p = problem.gains_of(i)[0]
        b_1 = lie_derivative_f(problem.model, barrier.expression) + p * barrier.expression
        symbolic = sp.lambdify([problem.model.states], problem.model.numeric(b_1))(states[0])
        assert symbolic == pytest.approx(measured[i] + p * values[1][i], abs=1e-6)


@pytest.mark.parametrize(
    "arguments", [{"num_obstacles": 1}, {}, {"num_obstacles": 20}, {"radius": 1.5}]
)
def test_vehicle_starts_at_a_distance_from_every_obstacle(arguments):
    env = gym.make(FIELD, **arguments)
    r = arguments.get("radius", 0.4)
    for seed in range(200):
        _, info = env.reset(seed=seed)
        assert info["h_min"] > (r + 1.0) ** 2 - r**2


def test_obstacles_stay_on_their_circles_under_noise():
    env = gym.make(FIELD, noise=0.1)
    first, _ = env.reset(seed=0)
    places = []
    for _ in range(round(2 * math.pi / 0.6 / 0.05)):
        observation, _, terminated, _, _ = env.step(np.ones(1))
        assert not terminated
        places.append(observation[4:].reshape(-1, 2) + observation[:2])
    extent = np.ptp(places, axis=0)
    np.testing.assert_allclose(extent, 1.2, atol=1e-2)
    np.testing.assert_allclose(places[-1], first[4:].reshape(-1, 2) + first[:2], atol=2e-2)


def test_tilt_barrier_is_the_cosine_from_the_thrust_to_the_vertical_less_its_limit():
    problem = problem_of(LIMITS, tilt=0.3)
    h = problem.barriers[2].expression
    pushes = problem.plant.numeric(problem.plant.input_matrix[3:6, 0])
    at, to_vertical = (
        sp.lambdify([problem.plant.states], e) for e in (h, pushes[2] / pushes.norm())
    )
    rng = np.random.default_rng(0)
    for x in rng.uniform(-0.8, 0.8, (20, 12)):
        assert at(x) == pytest.approx(to_vertical(x) - math.cos(0.3))
    for roll, pitch in ((0.3, 0.0), (0.0, -0.3)):
        assert at([0.0] * 6 + [roll, pitch] + [0.0] * 4) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("env_id", "arguments", "fragment"),
    [
        *(
            (FIELD, {"num_obstacles": n}, "num_obstacles")
            for n in (0, 21, -1, 2.0, True, "3", None)
        ),
        (LIMITS, {"floor": 7.5}, "floor = 7.5"),
        (LIMITS, {"floor": 0.0}, "floor = 0"),
        (LIMITS, {"ceiling": 10.0}, "ceiling = 10"),
        (LIMITS, {"ceiling": math.nan}, "ceiling = nan"),
        (LIMITS, {"tilt": 0.0}, "tilt = 0"),
        (LIMITS, {"tilt": 1.1}, "1.047"),
        (LIMITS, {"tilt": "flat"}, "'flat'"),
        (FIELD, {"num_obstacle": 3}, "did you mean 'num_obstacles'"),
        (FIELD, {"barrier": {"num_obstacle": 3}}, "did you mean 'num_obstacles'"),
        (FIELD, {"tilt": 0.2}, "'tilt'"),
    ],
)
def test_arguments_are_checked(env_id, arguments, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        gym.make(env_id, **arguments)


def test_gains_may_be_given_for_each_barrier_or_for_all():
    limits, field = problem_of(LIMITS), problem_of(FIELD)
    assert [limits.gains_of(i) for i in range(3)] == list(limits.gains)
    assert limits.gains_of(2) != limits.gains_of(0)
    assert [field.gains_of(i) for i in range(5)] == [field.gains] * 5
    with pytest.raises(SystemDefinitionError, match="2 tuples for 3 barriers"):
        replace(limits, gains=((1.0, 1.0), (1.0, 1.0)))


@pytest.mark.parametrize("make", [gym.make, partial(gym.make_vec, num_envs=2)])
@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        (FIELD, {"num_obstacles": 3, "radius": 0.3}),
        (LIMITS, {"ceiling": 6.5, "tilt": 0.4}),
        ("safe_envs/DubinsDisk-v0", {"radius": 2.0}),
    ],
)
def test_factory_arguments_may_stand_by_themselves_or_in_barrier(make, env_id, arguments):
    by_itself, in_barrier = (
        make(env_id, **given).unwrapped.problem for given in (arguments, {"barrier": arguments})
    )
    assert by_itself == in_barrier
    assert by_itself != make(env_id).unwrapped.problem


@pytest.mark.parametrize("env_id", [FIELD, pytest.param(LIMITS, marks=pytest.mark.oracle)])
def test_natural_filter_keeps_safe_what_the_nominal_controller_does_not(env_id):
    bare, filtered = evaluate(env_id, episodes=20, bounds=False, engine="numpy").rows
    assert bare.safety_rate < 0.6
    assert filtered.safety_rate > 0.95
    assert filtered.infeasible_rate < 0.01


def test_neighbours_circle_in_opposite_directions():
    problem = problem_of("safe_envs/DubinsObstacles-v0", num_obstacles=4)
    rates = [float(problem.plant.numeric(rate)) for rate in list(problem.plant.drift)[3:]]
    assert rates == [0.6, -0.6, 0.6, -0.6]
