"""What specs say of the length of episodes, and who ends them."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import OrderEnforcing, TimeAwareObservation, TimeLimit

import safe_envs
from safe_envs import ConfigurationError
from tests.conftest import problem_of

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


def test_time_is_shown_by_gymnasiums_wrapper():
    env = TimeAwareObservation(gym.make(ACC, horizon=0.5), normalize_time=True)
    env.reset(seed=0)
    observation = env.step(np.zeros(1))[0]
    assert env.max_timesteps == 10
    assert observation[-1] == pytest.approx(0.1)


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


def test_without_a_spec_or_a_system_there_is_no_length():
    assert gym.spec("safe_envs/Custom-v0").max_episode_steps is None
    assert OrderEnforcing(safe_envs.SafeEnv(walk())).spec is None
    assert safe_envs.SafeVectorEnv(walk(), 2).spec is None


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
