"""What other libraries find out about an env: TorchRL, skrl, and whoever tries arguments on it."""

from __future__ import annotations

from functools import partial
from typing import Generic, TypeVar

import gymnasium as gym
import pytest

from safe_envs import ConfigurationError, SafeEnv, SafetyFilter, SafeVectorEnv
from safe_envs.agents import make_sb3_env
from safe_envs.envs.registered import SystemEnv, SystemVectorEnv
from safe_envs.registry import env_class, make_problem
from safe_envs.systems import CUSTOM_ID
from safe_envs.wrappers import (
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    make_vec_with_cost,
    make_with_cost,
)
from tests.conftest import EVERY_ENV, problem_of

SCALAR = "safe_envs/Scalar-v0"


@pytest.mark.parametrize("env_id", [*EVERY_ENV, CUSTOM_ID])
@pytest.mark.parametrize(
    "make",
    [
        gym.make,
        partial(gym.make_vec, num_envs=2),
        partial(gym.make_vec, num_envs=2, vectorization_mode="sync"),
        make_problem,
    ],
)
def test_an_unknown_argument_is_an_error_of_ours_and_pythons(env_id: str, make):
    system = {"system": "examples/cart_pole.py:problem"} if env_id == CUSTOM_ID else {}
    # TorchRL's GymEnv looks for these words in a TypeError, and goes on without the argument.
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'") as error:
        make(env_id, **system, frameskip=4)
    assert isinstance(error.value, ConfigurationError)


def filtered(env_id: str, **unknown):
    return SafetyFilterWrapper(gym.make(env_id), "cbf", **unknown)


def filtered_batch(env_id: str, **unknown):
    return SafetyFilterVectorWrapper(gym.make_vec(env_id, 2), "cbf", **unknown)


def filter_alone(env_id: str, **unknown):
    problem = problem_of(env_id)
    return SafetyFilter(problem.model, problem.barriers, "cbf", problem.input_bounds, **unknown)


@pytest.mark.parametrize(
    "make",
    [
        env_class(SCALAR),
        filtered,
        filtered_batch,
        filter_alone,
        make_sb3_env,
        make_with_cost,
        make_vec_with_cost,
        lambda env_id, **unknown: problem_of(env_id).configured(**unknown),
    ],
)
def test_constructors_refuse_it_in_the_same_words(make):
    arguments = () if isinstance(make, type) else (SCALAR,)
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'nois'") as error:
        make(*arguments, nois=0.1)
    assert isinstance(error.value, ConfigurationError)


T = TypeVar("T")


class Mixed(SafeEnv, Generic[T]):
    pass


class Renamed(SafeVectorEnv):
    pass


def test_gymnasiums_class_is_a_direct_base_of_every_env(env_id: str):
    """By those skrl recognises an env."""
    assert gym.Env in env_class(env_id).__bases__
    batch = gym.envs.registration.load_env_creator(gym.spec(env_id).vector_entry_point)
    assert gym.vector.VectorEnv in batch.__bases__


def test_it_is_one_of_classes_of_users_too():
    for kind in (SafeEnv, SystemEnv, Mixed, Mixed[int]):
        assert gym.Env in getattr(kind, "__origin__", kind).__bases__
    for kind in (SafeVectorEnv, SystemVectorEnv, Renamed):
        assert gym.vector.VectorEnv in kind.__bases__
    assert isinstance(Mixed(problem_of(SCALAR)), gym.Env)
