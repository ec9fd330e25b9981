"""Hyperparameters: their ranges, the RL Zoo's ways to write them, and what of them is refused."""

from __future__ import annotations

from importlib.resources import files

import pytest
import yaml
from stable_baselines3 import PPO

import safe_envs
from safe_envs import ConfigurationError
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.hyperparameters import ALGORITHMS, CONSTRAINED, whole_batches
from safe_envs.agents.training.trainer import train
from safe_envs.filters.learning.data import load
from safe_envs.scripts.options.settings import read_hyperparameters
from tests.agents.training.small import training

pytestmark = pytest.mark.slow

SHORT = {"n_timesteps": 16, "eval_freq": 16}


def written(algorithm, *texts):
    return training(algorithm, read_hyperparameters(texts), **SHORT)


@pytest.mark.parametrize(
    ("algorithm", "text", "fragment"),
    [
        ("ppo", "policy=MultiInputPolicy", "'MultiInputPolicy'; .*MlpPolicy"),
        ("ppo", "policy=CnnPolicy", "MlpPolicy"),
        ("ppo", "n_epochs=0", "n_epochs = 0; .*from 1"),
        ("ppo", "n_steps=true", "n_steps = True"),
        ("ppo", "gamma=1.5", r"gamma = 1\.5; .*from 0 to 1"),
        ("ppo", "gae_lambda=true", "gae_lambda = True"),
        ("ppo", "clip_range=0", "clip_range = 0; .*above 0"),
        ("ppo", "ent_coef=-1", "ent_coef = -1"),
        ("sac", "tau=2", "tau = 2"),
        ("sac", "gradient_steps=-2", "gradient_steps = -2; .*from -1"),
    ],
)
def test_what_is_out_of_range_is_refused(algorithm, text, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        written(algorithm, text)


REFUSED = [
    ("ppo", {"learning_rat": 3}, "'learning_rate'"),
    ("ppo", {"learning_rate": "exp_3"}, "learning_rate"),
    ("ppo", {"policy_kwargs": {"speed": 3}}, "ppo does not take .*speed"),
    ("ppo", {"normalize": "no thanks"}, "normalize|does not take"),
    ("ppo", {"normalize": {"bogus": 1}}, "bogus"),
    ("sac", {"noise_type": "pink", "noise_std": 0.1}, "noise_type"),
    ("sac", {"noise_type": "normal"}, "noise_std"),
    ("sac", {"noise_std": 0.1}, "noise_type"),
    ("sac", {"replay_buffer_kwargs": {}}, "replay buffer"),
    ("sac", {"use_sde": True}, "saved"),
    ("sac", {"learning_starts": "soon"}, "learning_starts = 'soon'"),
    ("ppo", {"learning_rate": 1e12}, "diverged|not all finite"),
    ("ppo", {"stats_window_size": 10**400}, "does not take|failed after"),
    ("ppo", {"gamma": 10**400}, "gamma"),
    ("ppo", {"normalize": {"clip_obs": 10**400}}, "does not take|failed after"),
    ("ppo", {"normalize": "[" * 5000}, "does not take"),
    ("sac", {"buffer_size": 1e15}, "sac does not take"),
    # Python is not run.
    *(
        ("sac", {"policy_kwargs": text}, "sac does not take")
        for text in (
            "dict(n_critics=0)",
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
        )
    ),
]


@pytest.mark.parametrize(("algorithm", "settings", "fragment"), REFUSED)
def test_what_does_not_work_is_refused_and_leaves_the_folder_to_others(
    algorithm, settings, fragment, tmp_path
):
    with pytest.raises(ConfigurationError, match=fragment):
        train(training(algorithm, settings), tmp_path / "run")
    if "1e12" in str(settings.values()):  # of those that failed late
        train(training("a2c", **SHORT), tmp_path / "run")
    elif "diverged" not in fragment and "failed" not in fragment:
        assert not (tmp_path / "run").exists()


def test_whole_numbers_may_be_written_as_floats():
    found = written("sac", "buffer_size=1e3", "learning_starts=1e1", "train_freq=2.0")
    wanted = {"buffer_size": 1000, "learning_starts": 10, "train_freq": 2}
    for name, value in wanted.items():
        assert (type(found.hyperparameters[name]), found.hyperparameters[name]) == (int, value)
    assert written("ppo", "n_steps=8e0", "batch_size=4").hyperparameters["n_steps"] == 8


@pytest.mark.parametrize(
    ("text", "activation"),
    [
        ("policy_kwargs=dict(net_arch=dict(pi=[5]), activation_fn=nn.ReLU)", "relu"),
        ("policy_kwargs=dict(net_arch=[5], activation_fn=th.nn.ELU, ortho_init=False)", "elu"),
    ],
)
def test_the_zoo_s_python_and_lists_make_a_model(text, activation, tmp_path):
    scales = "normalize={'norm_obs': True, 'norm_reward': False}"
    train(written("ppo", text, scales), tmp_path / "ppo")
    found = load(tmp_path / "ppo" / "policy.npz")
    assert found.details["activation"] == activation
    assert found.arrays["actor_weights_0"].shape[0] == 5
    assert found.details["normalization"]
    noise = ["train_freq=[2, step]", "noise_type=ornstein-uhlenbeck", "noise_std=0.2"]
    train(written("sac", *noise), tmp_path / "sac")


def test_the_files_of_the_project_are_in_range_and_of_the_form_that_the_zoo_reads():
    """Its ExperimentManager takes YAML with ids for keys, and evaluates texts for arguments, so
    that there are none here."""
    for algorithm in ALGORITHMS:
        assert Training.of("Pendulum-v0", algorithm).hyperparameters["policy"] == "MlpPolicy"
        folder = files("safe_envs.agents.training").joinpath("hyperparams")
        table = yaml.safe_load(folder.joinpath(f"{algorithm}.yml").read_text())
        if algorithm in CONSTRAINED:
            assert set(table) == {"extends", "default"}
            continue
        assert set(safe_envs.ENV_IDS) <= set(table)
        for settings in table.values():
            assert not isinstance(settings["policy_kwargs"], str)
            assert settings["policy"] == "MlpPolicy"


def test_a_rollout_is_cut_into_whole_batches(tmp_path):
    sizes = [whole_batches(512, rollout, False) for rollout in (2048, 625, 448, 37, 1021)]
    assert sizes == [512, 125, 448, 37, 1021]
    assert whole_batches(64, 256, True) == 64
    with pytest.raises(ConfigurationError, match="give 64"):
        whole_batches(100, 256, True)
    for wrong in (1, 2.0, "512", True):
        with pytest.raises(ConfigurationError, match="batch_size"):
            whole_batches(wrong, 256, False)
    train(training("ppo", {"n_steps": 16, "batch_size": 32}, **SHORT), tmp_path / "run")
    assert PPO.load(tmp_path / "run" / "model.zip").batch_size == 32
