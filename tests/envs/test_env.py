"""Every registered id as Gymnasium and Stable-Baselines3 expect it."""

from __future__ import annotations

import inspect
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

from safe_envs import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.dynamics.noise import StreamReader
from safe_envs.envs.simulation import Simulation
from safe_envs.registry import env_class
from safe_envs.systems.stochastic_dubins import StochasticDubins
from safe_envs.wrappers import SafetyFilterWrapper
from tests.conftest import problem_of


def filtered(env_id):
    env = gym.make(env_id)
    return SafetyFilterWrapper(env, env.unwrapped.problem.filter)


def test_checkers_pass_without_a_warning(env_id):
    check_env(gym.make(env_id).unwrapped)
    check_env_for_sb3(gym.make(env_id))


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_checkers_pass_over_a_filter_without_a_warning(env_id):
    check_env(filtered(env_id))
    check_env_for_sb3(filtered(env_id))


@pytest.mark.parametrize("wrapped", [False, True])
def test_specs_round_trip(env_id, wrapped):
    env = gym.make(env_id, noise=0.05, horizon=1.0)
    if wrapped:
        env = SafetyFilterWrapper(env, env.unwrapped.problem.filter, knowledge="plant")
    spec = env.spec
    assert spec is not None
    for copy in (
        spec,
        gym.envs.registration.EnvSpec.from_json(spec.to_json()),
        pickle.loads(pickle.dumps(spec)),
    ):
        other = gym.make(copy)
        assert str(other) == str(env)
        assert other.unwrapped.problem == env.unwrapped.problem
        env.action_space.seed(3)
        first, again = env.reset(seed=3), other.reset(seed=3)
        np.testing.assert_array_equal(first[0], again[0])
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], other.step(action)[0])


def test_observations_stay_in_their_space_until_the_end(env_id):
    env = gym.make(env_id, noise=0.3)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(400):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert math.isfinite(reward)
        if terminated or truncated:
            env.reset()


def test_starts_are_safe_and_in_the_workspace(env_id):
    problem = problem_of(env_id)
    simulation = Simulation(problem, "floats")
    reader = StreamReader()
    for episode in range(200):
        x = simulation.starts.draw(reader, (0, 0), episode)
        _, barriers, _, outside, goal = simulation.measure(x, [0.0] * problem.plant.m, 0.0)
        assert min(barriers) > 0
        assert outside <= 0
        assert goal < 0


def test_an_episode_lasts_for_the_horizon():
    env = gym.make("safe_envs/ACC-v0", dt=0.1, horizon=2.5)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, dtype=np.float32))[3] for _ in range(25)]
    assert ends == [False] * 24 + [True]
    shorter = gym.make("safe_envs/ACC-v0", max_episode_steps=3)
    shorter.reset(seed=0)
    assert [shorter.step(np.zeros(1, dtype=np.float32))[3] for _ in range(3)] == [
        False,
        False,
        True,
    ]


def test_a_violation_ends_the_episode_where_that_is_asked_for():
    env = gym.make("safe_envs/Scalar-v0", start=[0.5], noise=0.0, terminate_on_violation=True)
    env.reset(seed=0)
    ends = []
    while not any(ends[-1:]):
        _, _, terminated, truncated, info = env.step(np.ones(1, dtype=np.float32))
        ends.append(terminated)
        assert info["violation"] == terminated
        assert not truncated
    assert len(ends) > 2
    assert info["episode_cost"] == info["cost"] == 1.0
    # An unsafe start ends nothing: only steps do.
    _, info = env.reset(options={"state": [1.5]})
    assert info["violation"]
    _, _, terminated, _, info = env.step(np.ones(1, dtype=np.float32))
    assert terminated
    assert info["episode_cost"] == 2.0


def test_violation_costs_and_does_not_end_the_episode():
    env = gym.make("safe_envs/Scalar-v0", start=[0.999], noise=0.0)
    _, info = env.reset(seed=0)
    assert (info["cost"], info["violation"], info["episode_cost"]) == (0.0, False, 0.0)
    _, _, terminated, _, info = env.step(np.ones(1, dtype=np.float32))
    assert (info["cost"], info["violation"], info["episode_cost"], terminated) == (
        1.0,
        True,
        1.0,
        False,
    )
    assert info["barrier"].dtype == np.float64
    assert info["h_min"] == info["barrier"][0] < 0
    _, _, _, _, info = env.step(np.ones(1, dtype=np.float32))
    assert info["episode_cost"] == 2.0
    _, info = env.reset()
    assert (info["episode_cost"], info["h_min"]) == (0.0, info["barrier"][0])


def test_leaving_the_workspace_ends_the_episode():
    env = gym.make("safe_envs/Scalar-v0", noise=0.0, horizon=100.0)
    env.reset(seed=0)
    for _ in range(2000):
        observation, _, terminated, truncated, _ = env.step(np.ones(1, dtype=np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert env.observation_space.contains(observation)


def test_reaching_the_goal_ends_the_episode():
    env = gym.make("safe_envs/DubinsObstacle-v0", start=[2.5, 1.5, 0.0, -1.0, 0.0])
    env.reset(seed=0)
    for _ in range(30):
        _, _, terminated, truncated, info = env.step(np.zeros(1, dtype=np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert not info["violation"]


def test_noise_zero_is_deterministic_and_noise_is_not():
    for noise, equal in ((0.0, True), (0.2, False)):
        env = gym.make("safe_envs/StochasticDubins-v0", noise=noise, start=[0.0, 0.0, 0.0])
        ends = []
        for seed in (1, 2):
            env.reset(seed=seed)
            for _ in range(10):
                env.step(np.zeros(1, dtype=np.float32))
            ends.append(env.unwrapped.state)
        assert np.array_equal(*ends) == equal


def test_plant_moves_and_model_does_not():
    for arguments, moves in (({"plant": {"v": 1.0}}, True), ({"model": {"v": 1.0}}, False)):
        states = []
        for env in (
            gym.make("safe_envs/DubinsDisk-v0", start="thesis"),
            gym.make("safe_envs/DubinsDisk-v0", start="thesis", **arguments),
        ):
            env.reset(seed=0)
            env.step(np.zeros(1, dtype=np.float32))
            states.append(env.unwrapped.state)
        assert (not np.array_equal(*states)) == moves


def test_actions_are_scaled_to_the_box_and_clipped():
    env = gym.make("safe_envs/Scalar-v0", box=[-2.0, 6.0], noise=0.0).unwrapped
    assert env.physical_action(np.array([-1.0])) == [-2.0]
    assert env.physical_action(np.array([0.5])) == [4.0]
    assert env.physical_action(np.array([9.0])) == [6.0]
    np.testing.assert_allclose(env.normalized_action(env.physical_action(np.array([0.3]))), [0.3])


@pytest.mark.parametrize(
    "action", [np.array([np.nan]), np.array([np.inf]), np.zeros(2), np.zeros((1, 1)), 0.0]
)
def test_actions_that_are_none_are_errors(action):
    env = gym.make("safe_envs/Scalar-v0")
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match="action"):
        env.step(action)
    vector = gym.make_vec("safe_envs/Scalar-v0", num_envs=2)
    vector.reset(seed=0)
    with pytest.raises(InvalidInputError, match="action"):
        vector.step(np.stack([np.zeros_like(action), action]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise": -1.0}, "noise = -1"),
        ({"noise": [0.1, 0.2, 0.3]}, "noise = "),
        ({"noise": math.nan}, "noise = nan"),
        ({"plant": {"speed": 1.0}}, "unknown parameter 'speed'"),
        ({"model": {"vv": 1.0}}, "did you mean 'v'"),
        ({"plant": {"v": math.inf}}, "parameter v"),
        ({"barrier": {"radius": -1.0}}, "radius"),
        ({"barrier": {"raduis": 1.0}}, "no barrier argument 'raduis'; did you mean 'radius'"),
        ({"nois": 1.0}, "unexpected keyword argument 'nois'; did you mean 'noise'"),
        ({"dt": 0.0}, "dt = 0"),
        ({"dt": math.nan}, "dt = nan"),
        ({"horizon": 0.01}, "horizon = 0.01"),
        ({"substeps": 0}, "substeps = 0"),
        ({"substeps": 1.5}, "substeps = 1.5"),
        ({"box": [1.0, 1.0]}, "box of input omega"),
        ({"box": [-math.inf, math.inf]}, "box of input omega"),
        ({"box": [2.0, 1.0]}, "box of input omega"),
        ({"box": [[0.0, 1.0], [0.0, 1.0]]}, "box = "),
        ({"start": [0.0, 0.0]}, "start has 2 numbers"),
        ({"start": 0.5}, "start has 1 numbers"),
        ({"dt": 1e-320}, "horizon = "),
        ({"start": [0.0, math.nan, 0.0]}, "start of y"),
        ({"start": [100.0, 0.0, 0.0]}, "outside the workspace"),
        ({"start": "inwards"}, "did you mean 'inward'"),
        ({"render_mode": "movie"}, "render_mode"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        StochasticDubins(**arguments)
    with pytest.raises(ConfigurationError, match=message):
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=2, **arguments)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_divergence_is_an_error_not_a_nan(make):
    env = make("safe_envs/CubicSDE-v0", dt=1e200, horizon=1e202)
    env.reset(seed=0)
    with pytest.raises(NumericalError, match="finite"):
        env.step(np.ones(env.action_space.shape, dtype=np.float32))


def test_state_that_breaks_down_outside_the_barrier_is_an_error_too():
    for make in (gym.make, gym.make_vec):
        env = make("safe_envs/Quadrotor-v0", plant={"I_x": 1e-200})
        env.reset(seed=0)
        env.action_space.seed(0)
        with pytest.raises(NumericalError, match=r"finite|broke down"):
            env.step(env.action_space.sample())


def test_parameters_that_divide_by_zero_are_errors():
    with pytest.raises(ConfigurationError, match="m = 0"):
        gym.make("safe_envs/QuadrotorAltitude-v0", plant={"m": 0.0})


def test_steps_before_a_reset_are_errors():
    with pytest.raises(gym.error.ResetNeeded):
        gym.make("safe_envs/Scalar-v0").unwrapped.step(np.zeros(1))
    with pytest.raises(gym.error.ResetNeeded):
        gym.make_vec("safe_envs/Scalar-v0", num_envs=2).step(np.zeros((2, 1)))


def test_classes_are_documented(env_id):
    # Python 3.13 takes the indentation from `__doc__` itself.
    text = inspect.getdoc(env_class(env_id)) or ""
    for heading in (
        "Equations",
        "States",
        "Inputs",
        "Observation",
        "Barrier",
        "Noise",
        "Mismatch",
        "Reward",
        "Start",
        "Arguments",
        "Source",
    ):
        assert f"\n## {heading}\n" in text


def test_a_problem_is_stated_once_for_the_same_arguments():
    envs = [gym.make("safe_envs/DubinsDisk-v0", radius=radius) for radius in (2.0, 2.0, 3.0)]
    first, again, other = (env.unwrapped.problem for env in envs)  # pyright: ignore[reportAttributeAccessIssue]
    assert first.barriers[0] is again.barriers[0]
    assert first.barriers != other.barriers
    # What cannot be looked up is an error of ours all the same.
    with pytest.raises(ConfigurationError, match="radius"):
        gym.make("safe_envs/DubinsDisk-v0", radius=[2.0])


@pytest.mark.parametrize("given", ["false", None, 1])
def test_whether_a_violation_ends_an_episode_is_true_or_false(given):
    for make in (gym.make, gym.make_vec):
        with pytest.raises(ConfigurationError, match=r"terminate_on_violation = .*True or"):
            make("safe_envs/Scalar-v0", terminate_on_violation=given)
