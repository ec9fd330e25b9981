"""Episodes of envs: how they begin and end, what they cost, and what is refused."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit

import safe_envs
from safe_envs import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.systems.stochastic_dubins import StochasticDubins
from tests.conftest import problem_of

SCALAR, DUBINS = "safe_envs/Scalar-v0", "safe_envs/StochasticDubins-v0"


def make_two(env_id, **arguments):
    return gym.make_vec(env_id, num_envs=2, **arguments)


both = pytest.mark.parametrize("make", [gym.make, make_two], ids=["one", "batch"])


def act(env, action=1.0):
    return env.step(np.full(env.action_space.shape, action, dtype=np.float32))


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


def test_starts_are_safe_and_neither_end_an_episode_nor_repeat(env_id):
    envs = gym.make_vec(env_id, 100, horizon=2 * problem_of(env_id).dt)
    starts = []
    for seed in (0, None):
        _, info = envs.reset(seed=seed)
        assert (info["h_min"] > 0).all()
        starts.append(envs.unwrapped.state)
        assert not act(envs, 0.0)[2].any()
    if len(np.unique(starts[0], axis=0)) > 1:
        assert len(np.unique(np.concatenate(starts), axis=0)) == 200


def test_a_violation_ends_the_episode_where_that_is_asked_for():
    env = gym.make(SCALAR, start=[0.5], noise=0.0, terminate_on_violation=True)
    env.reset(seed=0)
    ends = []
    while not any(ends[-1:]):
        _, _, terminated, truncated, info = act(env)
        ends.append(terminated)
        assert info["violation"] == terminated
        assert not truncated
    assert len(ends) > 2
    assert info["episode_cost"] == info["cost"] == 1.0
    # An unsafe start ends nothing: only steps do.
    _, info = env.reset(options={"state": [1.5]})
    assert info["violation"]
    _, _, terminated, _, info = act(env)
    assert terminated
    assert info["episode_cost"] == 2.0


def test_a_violation_costs_and_does_not_end_the_episode():
    env = gym.make(SCALAR, start=[0.999], noise=0.0)
    _, info = env.reset(seed=0)
    assert (info["cost"], info["violation"], info["episode_cost"]) == (0.0, False, 0.0)
    _, _, terminated, _, info = act(env)
    assert (info["cost"], info["violation"], info["episode_cost"]) == (1.0, True, 1.0)
    assert not terminated
    assert info["h_min"] == info["barrier"][0] < 0
    assert act(env)[4]["episode_cost"] == 2.0
    _, info = env.reset()
    assert (info["episode_cost"], info["h_min"]) == (0.0, info["barrier"][0])


@pytest.mark.parametrize(
    ("env_id", "arguments", "action"),
    [
        (SCALAR, {"noise": 0.0, "horizon": 100.0}, 1.0),
        ("safe_envs/DubinsObstacle-v0", {"start": [2.5, 1.5, 0.0, -1.0, 0.0]}, 0.0),
    ],
    ids=["workspace", "goal"],
)
def test_leaving_the_workspace_or_reaching_the_goal_ends_the_episode(env_id, arguments, action):
    env = gym.make(env_id, **arguments)
    env.reset(seed=0)
    for _ in range(2000):
        observation, _, terminated, truncated, info = act(env, action)
        if terminated:
            break
    assert terminated
    assert not truncated
    assert env.observation_space.contains(observation)
    assert info["violation"] == (env_id == SCALAR)


def test_noise_of_zero_is_deterministic_and_noise_is_not():
    for noise, equal in ((0.0, True), (0.2, False)):
        env = gym.make(DUBINS, noise=noise, start=[0.0, 0.0, 0.0])
        ends = []
        for seed in (1, 2):
            env.reset(seed=seed)
            for _ in range(10):
                act(env, 0.0)
            ends.append(env.unwrapped.state)
        assert np.array_equal(*ends) == equal


def test_the_plant_moves_and_the_model_does_not():
    states = []
    for arguments in ({}, {"plant": {"v": 1.0}}, {"model": {"v": 1.0}}):
        env = gym.make("safe_envs/DubinsDisk-v0", start="thesis", **arguments)
        env.reset(seed=0)
        act(env, 0.0)
        states.append(env.unwrapped.state)
    assert not np.array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


def test_actions_are_scaled_to_the_box_and_clipped():
    env = gym.make(SCALAR, input_bounds=[-2.0, 6.0], noise=0.0).unwrapped
    for action, physical in ((-1.0, -2.0), (0.5, 4.0), (9.0, 6.0), (-1e200, -2.0)):
        assert env.physical_action(np.array([action])) == [physical]
    np.testing.assert_allclose(env.normalized_action(env.physical_action(np.array([0.3]))), [0.3])


@pytest.mark.parametrize(
    "action", [np.array([np.nan]), np.array([np.inf]), np.zeros(2), np.zeros((1, 1)), 0.0]
)
def test_actions_that_are_none_are_errors(action):
    env = gym.make(SCALAR)
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match="action"):
        env.step(action)
    vector = make_two(SCALAR)
    vector.reset(seed=0)
    with pytest.raises(InvalidInputError, match="action"):
        vector.step(np.stack([np.zeros_like(action), action]))


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ({"noise": -1.0}, "noise = -1"),
        ({"noise": [0.1, 0.2, 0.3]}, "noise = "),
        ({"plant": {"speed": 1.0}}, "'speed'"),
        ({"model": {"vv": 1.0}}, "did you mean 'v'"),
        ({"plant": {"v": math.inf}}, "parameter v"),
        ({"plant": 3}, "dictionary"),
        ({"model": [("sigma", 1.0)]}, "dictionary"),
        ({"barrier": {"radius": -1.0}}, "radius"),
        ({"barrier": {"raduis": 1.0}}, "did you mean 'radius'"),
        ({"nois": 1.0}, "did you mean 'noise'"),
        ({"dt": 0.0}, "dt = 0"),
        ({"dt": 1e-320}, "horizon = "),
        ({"horizon": 0.01}, "horizon = 0.01"),
        ({"substeps": 0}, "substeps = 0"),
        *(
            ({"input_bounds": box}, "input_bounds of omega")
            for box in ([1, 1], [-math.inf, math.inf], [2, 1])
        ),
        ({"input_bounds": [[0.0, 1.0], [0.0, 1.0]]}, "input_bounds = "),
        ({"start": [0.0, 0.0]}, "start has 2"),
        ({"start": [0.0, math.nan, 0.0]}, "start of y"),
        ({"start": [100.0, 0.0, 0.0]}, "workspace"),
        ({"start": "inwards"}, "did you mean 'inward'"),
        ({"render_mode": "movie"}, "render_mode"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0"),
        *(({"terminate_on_violation": v}, "terminate_on_violation") for v in ("false", None, 1)),
    ],
)
def test_arguments_out_of_range_are_named(arguments, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        StochasticDubins(**arguments)
    with pytest.raises(ConfigurationError, match=fragment):
        make_two(DUBINS, **arguments)


@both
@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        ("safe_envs/CubicSDE-v0", {"dt": 1e200, "horizon": 1e202}),
        ("safe_envs/Quadrotor-v0", {"plant": {"I_x": 1e-200}}),
    ],
)
def test_divergence_is_an_error_not_a_nan(make, env_id, arguments):
    env = make(env_id, **arguments)
    env.reset(seed=0)
    env.action_space.seed(0)
    with pytest.raises(NumericalError, match=r"finite|broke down"):
        env.step(env.action_space.sample())


def test_parameters_that_divide_by_zero_are_errors():
    with pytest.raises(ConfigurationError, match="m = 0"):
        gym.make("safe_envs/QuadrotorAltitude-v0", plant={"m": 0.0})


@both
def test_steps_before_a_reset_are_errors(make):
    env = make(SCALAR).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        act(env)


# What specs say of the length of episodes, and who ends them.


ACC = "safe_envs/ACC-v0"
CUSTOM = "my_lab/Short-v0"


def walk():
    """Return a problem of 7 steps."""
    return problem_of("safe_envs/Scalar-v0", horizon=0.07)


def layers(env):
    found = []
    while isinstance(env, gym.Wrapper):
        found.append(type(env))
        env = env.env
    return found


def steps_played(env):
    env.reset(seed=0)
    for k in range(1, 10_000):
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
        assert not terminated
        if truncated:
            return k
    return None


def test_every_id_says_how_long_its_episodes_are(env_id):
    steps = problem_of(env_id).steps
    assert gym.spec(env_id).max_episode_steps == steps
    for spec in (copy.deepcopy(gym.spec(env_id)), pickle.loads(pickle.dumps(gym.spec(env_id)))):
        assert spec == gym.spec(env_id)
        assert spec.max_episode_steps == steps
    assert gym.make(env_id).spec.max_episode_steps == steps
    assert gym.make_vec(env_id, 2).spec.max_episode_steps == steps


@pytest.mark.parametrize(
    ("options", "steps"),
    [({"horizon": 250.0}, 5000), ({"horizon": 0.5}, 10), ({"dt": 0.025, "horizon": 0.5}, 20)],
)
def test_no_limit_but_the_envs_own(options, steps):
    for spec in (ACC, gym.spec(ACC), gym.make(ACC, **options).spec):
        env = gym.make(spec, **options)
        assert env.spec.max_episode_steps == steps
        assert TimeLimit not in layers(env)
        again = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert again.spec.max_episode_steps == steps
        assert TimeLimit not in layers(again)
    for mode in ("sync", "vector_entry_point"):
        checked = {"disable_env_checker": True} if mode == "sync" else {}
        envs = gym.make_vec(ACC, 2, mode, **options, **checked)
        assert envs.spec.max_episode_steps == steps
        assert all(env.spec.max_episode_steps == steps for env in getattr(envs, "envs", []))
    if steps < 100:
        assert steps_played(gym.make(ACC, **options)) == steps


def test_a_limit_that_is_given_is_gymnasiums():
    env = gym.make(ACC, max_episode_steps=3, horizon=250.0)
    again = gym.make(env.spec)
    for each in (env, again, gym.make(EnvSpec.from_json(env.spec.to_json()))):
        assert layers(each)[0] is TimeLimit
        assert each.spec.max_episode_steps == 3
        assert each.unwrapped.spec.max_episode_steps == 5000
        assert steps_played(each) == 3
    # The horizon ends them before.
    short = gym.make(ACC, max_episode_steps=30, horizon=1.0)
    for each in (short, gym.make(short.spec)):
        assert each.spec.max_episode_steps == steps_played(each) == 20
        assert each._max_episode_steps == 30
    envs = gym.make_vec(ACC, 2, max_episode_steps=3)
    assert envs.spec.max_episode_steps == gym.make_vec(envs.spec).spec.max_episode_steps == 3
    envs = gym.make_vec(ACC, 2, "sync", max_episode_steps=3)
    assert [each.spec.max_episode_steps for each in (envs, *envs.envs)] == [3, 3, 3]


def test_a_spec_with_other_arguments_tells_their_length():
    for spec in (gym.spec(ACC), gym.make(ACC).spec):
        other = dataclasses.replace(spec, kwargs={"horizon": 250.0})
        assert gym.make(other).spec.max_episode_steps == 5000
        assert TimeLimit not in layers(gym.make(other))
        assert gym.make_vec(other, 2).spec.max_episode_steps == 5000
        assert "max_episode_steps=None" not in repr(spec)


def test_systems_from_outside_say_it_too():
    safe_envs.register(CUSTOM, walk)
    try:
        assert gym.spec(CUSTOM).max_episode_steps == 7
        assert steps_played(gym.make(CUSTOM)) == 7
        assert gym.make(CUSTOM, horizon=0.1).spec.max_episode_steps == 10
        place = gym.spec(CUSTOM).kwargs["system"]
        assert gym.make("safe_envs/Custom-v0", system=place).spec.max_episode_steps == 7
        assert gym.make_vec(CUSTOM, 2).spec.max_episode_steps == 7
    finally:
        gym.registry.pop(CUSTOM)


@pytest.mark.parametrize("mode", [None, "sync"])
def test_no_limit_of_gymnasium_is_the_horizon(mode):
    """-1, as for `gym.make`."""
    envs = gym.make_vec("safe_envs/Scalar-v0", 2, mode, max_episode_steps=-1, horizon=0.1)
    steps = gym.make("safe_envs/Scalar-v0", max_episode_steps=-1, horizon=0.1).spec
    assert envs.spec.max_episode_steps == steps.max_episode_steps == 10
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((2, 1)))[3].all() for _ in range(10)]
    assert ends == [*[False] * 9, True]


@pytest.mark.parametrize(
    "make", [gym.make, partial(gym.make_vec, num_envs=2, vectorization_mode="sync")]
)
@pytest.mark.parametrize(
    ("argument", "fragment"),
    [({"autoreset_mode": "SameStep"}, "vector_kwargs"), ({"engine": "compiled"}, "engine")],
)
def test_arguments_of_native_vector_envs_are_no_arguments_of_one_env(make, argument, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make("safe_envs/Scalar-v0", **argument)
