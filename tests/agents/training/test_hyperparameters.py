"""Hyperparameters: their ranges, and the RL Zoo's ways to write them."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from safe_envs import ConfigurationError
from safe_envs.agents.training.config import ALGORITHMS, Training, python_value
from safe_envs.agents.training.trainer import TrainingSession, train
from safe_envs.scripts.options.settings import read_hyperparameters

SMALL = {"n_timesteps": 16, "num_envs": 2, "eval_episodes": 2, "options": {"horizon": 0.2}}


def training(algorithm, *texts):
    return Training.of("Scalar-v0", algorithm, settings=read_hyperparameters(texts), **SMALL)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("policy=MultiInputPolicy", "policy = 'MultiInputPolicy'; .* there is MlpPolicy"),
        ("policy=CnnPolicy", "there is MlpPolicy"),
        ("n_epochs=0", "n_epochs = 0; give a whole number from 1"),
        ("n_epochs=2.5", "n_epochs = 2.5; give a whole number from 1"),
        ("n_steps=true", "n_steps = True; give a whole number from 1"),
        ("gamma=1.5", "gamma = 1.5; give a number from 0 to 1"),
        ("gamma=-0.1", "gamma = -0.1; give a number from 0 to 1"),
        ("gae_lambda=true", "gae_lambda = True; give a number from 0 to 1"),
        ("clip_range=0", "clip_range = 0; give a number above 0"),
        ("ent_coef=-1", "ent_coef = -1; give a number from 0"),
    ],
)
def test_what_is_out_of_range_is_refused(text, says):
    with pytest.raises(ConfigurationError, match=says):
        training("ppo", text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("tau=2", "tau = 2; give a number from 0 to 1"),
        ("train_freq=0", "train_freq = 0; give a whole number from 1"),
        ("gradient_steps=-2", "gradient_steps = -2; give a whole number from -1"),
        ("buffer_size=0", "buffer_size = 0; give a whole number from 1"),
        ("learning_starts=-1", "learning_starts = -1; give a whole number from 0"),
    ],
)
def test_what_is_out_of_range_is_refused_off_policy(text, says):
    with pytest.raises(ConfigurationError, match=says):
        training("sac", text)


def test_the_files_of_the_project_are_in_range():
    for algorithm in ALGORITHMS:
        assert Training.of("Pendulum-v0", algorithm).hyperparameters["policy"] == "MlpPolicy"


def test_whole_numbers_may_be_written_as_floats():
    found = training("sac", "buffer_size=1e3", "learning_starts=1e1", "train_freq=2.0")
    wanted = {"buffer_size": 1000, "learning_starts": 10, "train_freq": 2}
    for name, value in wanted.items():
        assert (type(found.hyperparameters[name]), found.hyperparameters[name]) == (int, value)
    assert training("ppo", "n_steps=8e0", "batch_size=4").hyperparameters["n_steps"] == 8


def test_the_zoo_writes_python():
    text = (
        "dict(log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU, net_arch=dict(pi=[8, 4]))"
    )
    assert python_value("policy_kwargs", text) == {
        "log_std_init": -2,
        "ortho_init": False,
        "activation_fn": nn.ReLU,
        "net_arch": {"pi": [8, 4]},
    }
    assert python_value("normalize", "{'norm_obs': True, 'gamma': 0.9}") == {
        "norm_obs": True,
        "gamma": 0.9,
    }
    assert python_value("policy_kwargs", "dict(activation_fn=th.nn.ELU, a=(1, None))") == {
        "activation_fn": nn.ELU,
        "a": (1, None),
    }


@pytest.mark.parametrize(
    "text",
    [
        "dict(f=open('x'))",
        "dict(**{'a': 1})",
        "dict([('a', 1)])",
        "{**{}}",
        "nn.functional",
        "nn.Nothing",
        "os.system",
        "dict(a=b)",
        "dict(",
        "1 + x",
        "(" * 500,
    ],
)
def test_python_is_not_run(text):
    with pytest.raises(ValueError, match=r"policy_kwargs = .* is none of the values"):
        python_value("policy_kwargs", text)


def test_texts_of_the_zoo_make_a_model(tmp_path):
    texts = (
        "policy_kwargs=dict(net_arch=[5], activation_fn=nn.ReLU)",
        "normalize=dict(norm_obs=True)",
    )
    given = training("ppo", "n_steps=4", "batch_size=8", "n_epochs=1", *texts)
    session = TrainingSession(given, tmp_path)
    layers = [*session._model.policy.mlp_extractor.policy_net]
    assert [type(layer) for layer in layers] == [nn.Linear, nn.ReLU]
    assert layers[0].out_features == 5
    assert session._model.get_vec_normalize_env() is not None


@pytest.mark.parametrize(
    "text",
    [
        "buffer_size=1e15",
        "replay_buffer_class=x",
        "policy_kwargs=dict(n_critics=0)",
        "policy_kwargs=dict(f=open('x'))",
    ],
)
def test_what_stable_baselines3_refuses_is_an_error_of_this_project(tmp_path, text):
    torch.set_num_threads(1)
    with pytest.raises(ConfigurationError, match="sac does not take these hyperparameters"):
        train(training("sac", text), tmp_path / "run")
