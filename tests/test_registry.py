"""From an id to its problem."""

from __future__ import annotations

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

from safe_envs import ConfigurationError
from safe_envs.agents import make_problem
from safe_envs.registry import full_id
from tests.conftest import problem_of


def test_problem_is_that_of_the_registered_env(env_id):
    assert make_problem(env_id) == problem_of(env_id)
    assert make_problem(env_id.split("/")[1], noise=0.05, dt=None) == problem_of(env_id, noise=0.05)
    assert full_id(env_id) == full_id(env_id.split("/")[1]) == env_id


def test_unknown_ids_and_arguments_name_the_nearest():
    with pytest.raises(
        ConfigurationError,
        match=(
            "unknown env 'safe_envs/StochasticDubin-v0'; did you mean"
            " 'safe_envs/StochasticDubins-v0'"
        ),
    ):
        make_problem("safe_envs/StochasticDubin-v0")
    with pytest.raises(ConfigurationError, match="did you mean 'safe_envs/Scalar-v0'"):
        make_problem("SCALAR-V0")
    with pytest.raises(ConfigurationError, match="not one of this project's envs"):
        make_problem("CartPole-v1")
    with pytest.raises(ConfigurationError, match="did you mean 'horizon'"):
        make_problem("Scalar-v0", horizn=1.0)


def test_an_env_of_ones_own_keeps_its_id(monkeypatch):
    # Taken for an env of this project, it would be evaluated without a word.
    own = EnvSpec("ACC-v0", "gymnasium.envs.classic_control:PendulumEnv")
    monkeypatch.setitem(gym.registry, "ACC-v0", own)
    assert full_id("ACC-v0") == "ACC-v0"
    with pytest.raises(ConfigurationError, match="not one of this project's envs"):
        make_problem("ACC-v0")


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_arguments_of_foreign_envs_are_errors_too(env_id):
    with pytest.raises(ConfigurationError):
        make_problem(env_id, noise=0.1)


@pytest.mark.parametrize("env_id", [":x", "./x:y", "no_such_module:Env-v0"])
def test_ids_with_an_impossible_module_are_errors(env_id):
    with pytest.raises(ConfigurationError):
        make_problem(env_id)


def test_an_id_that_is_no_text_is_refused():
    with pytest.raises(ConfigurationError, match="env_id = 3; give the id of an env as text"):
        make_problem(3)  # pyright: ignore[reportArgumentType]
