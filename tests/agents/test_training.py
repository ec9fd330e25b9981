"""Training: what it leaves, that it can be gone on with, and that its figures are those of the evaluation."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import yaml

import safe_envs
from agents import evaluate
from agents.figures import ProgressLog, read_progress
from agents.hyperparameters import ALGORITHMS, hyperparameters, scheduled
from agents.training import Training, train
from safe_envs import ConfigurationError

DUBINS = "safe_envs/StochasticDubins-v0"
SMALL = {"num_envs": 4, "eval_episodes": 8, "options": {"horizon": 0.5}}


def training(algorithm="ppo", steps=768, every=256, **changes):
    settings = {"learning_starts": 100, "buffer_size": 2000} if algorithm in ("sac", "td3") else {}
    given = {"filter": "scbf", "n_timesteps": steps, "eval_freq": every, "settings": settings, **SMALL, **changes}
    return Training(DUBINS, algorithm, **given)


def logged(folder):
    """All that was logged, but for the clock."""
    return [{k: v for k, v in line.items() if not k.startswith("time/")} for line in read_progress(folder / "progress.jsonl")]


def evaluations(folder):
    return json.loads((folder / "evaluations.json").read_text())


@pytest.fixture(scope="module", params=["ppo", "sac"])
def finished(request, tmp_path_factory):
    """A short training of each kind."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    told = []
    train(training(request.param), folder, tell=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    return request.param, folder


def test_the_folder_holds_all_that_is_needed(finished):
    algorithm, folder = finished
    names = {path.name for path in folder.iterdir()}
    wanted = {"config.json", "evaluations.json", "progress.jsonl", "model.zip", "policy.safetensors", "policy.json", "best"}
    assert wanted <= names
    assert len([name for name in names if name.startswith("checkpoint_")]) == 1
    config = json.loads((folder / "config.json").read_text())
    assert config["training"]["algorithm"] == algorithm
    assert config["training"]["env_id"] == DUBINS
    assert "stable-baselines3" in config["versions"]
    rows = evaluations(folder)
    assert rows[-1]["timesteps"] >= 768
    assert all(row["ci_low"] <= row["safety_rate"] <= row["ci_high"] for row in rows)
    assert {row["filter"] for row in rows} == {"scbf"}


def test_its_figures_are_those_of_the_evaluation(finished):
    _, folder = finished
    last, best = evaluations(folder)[-1], max(evaluations(folder), key=lambda row: row["return_mean"])
    for path, row in ((folder, last), (folder / "best", best)):
        (found,) = evaluate(DUBINS, str(path), ["scbf"], episodes=8, bounds=False, options=SMALL["options"]).rows
        assert {key: found[key] for key in ("safe", "return_mean", "violations")} == {
            key: row[key] for key in ("safe", "return_mean", "violations")
        }


def test_the_safety_figures_are_logged(finished):
    _, folder = finished
    lines = logged(folder)
    last = {key: value for line in lines for key, value in line.items()}
    for name in ("rate", "episode_cost", "h_min", "violations", "interventions", "infeasible"):
        assert f"safety/{name}" in last
    assert {"eval/safety_rate", "rollout/ep_rew_mean"} <= set(last)
    assert 0 < last["safety/interventions"] <= 1


def test_the_same_seed_gives_the_same_training(finished, tmp_path):
    algorithm, folder = finished
    train(training(algorithm), tmp_path / "again")
    assert logged(tmp_path / "again") == logged(folder)
    assert (tmp_path / "again" / "policy.safetensors").read_bytes() == (folder / "policy.safetensors").read_bytes()


def test_a_training_that_was_interrupted_goes_on_as_if_it_had_not_been(finished, tmp_path):
    algorithm, folder = finished
    interrupted = tmp_path / "interrupted"

    def stop(part):
        if part > 0.8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(training(algorithm), interrupted, tell=stop)
    assert evaluations(interrupted)[-1]["timesteps"] < 768
    train(training(algorithm), interrupted, resume=True)
    assert logged(interrupted) == logged(folder)
    assert evaluations(interrupted) == evaluations(folder)
    assert (interrupted / "policy.safetensors").read_bytes() == (folder / "policy.safetensors").read_bytes()
    train(training(algorithm), interrupted, resume=True)  # there is nothing left to do
    assert logged(interrupted) == logged(folder)


def test_a_checkpoint_without_its_evaluation_gets_it(finished, tmp_path):
    algorithm, folder = finished
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "evaluations.json").write_text(json.dumps(evaluations(folder)[:-1]))
    train(training(algorithm), copy, resume=True)
    assert evaluations(copy) == evaluations(folder)


def test_normalised_observations_are_part_of_the_policy(tmp_path):
    train(training(steps=512, settings={"normalize": True}), tmp_path / "run")
    rows = evaluations(tmp_path / "run")
    (found,) = evaluate(DUBINS, str(tmp_path / "run"), ["scbf"], episodes=8, bounds=False, options=SMALL["options"]).rows
    assert found["return_mean"] == rows[-1]["return_mean"]
    assert "normalization" in (tmp_path / "run" / "policy.json").read_text()


@pytest.mark.parametrize("algorithm", ["a2c", "td3"])
def test_the_other_algorithms_and_the_bare_env_train(algorithm, tmp_path):
    train(training(algorithm, steps=256, filter=None), tmp_path / "run")
    assert evaluations(tmp_path / "run")[-1]["filter"] == "none"


def test_what_cannot_be_trained_is_refused(finished, tmp_path):
    _, folder = finished
    for changes, message in (
        ({"n_timesteps": 0}, "n_timesteps"),
        ({"num_envs": 2.5}, "num_envs"),
        ({"action": "both "}, "action"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            training(**changes)
    with pytest.raises(ConfigurationError, match=r"ppo does not take these hyperparameters.*speed"):
        train(training(settings={"speed": 3}), tmp_path / "speed")
    with pytest.raises(ConfigurationError, match="--algo dqn"):
        training("dqn")
    with pytest.raises(ConfigurationError, match="unknown env"):
        Training("Nowhere-v0", "ppo")
    with pytest.raises(ConfigurationError, match="not empty"):
        train(training(), folder)
    with pytest.raises(ConfigurationError, match="holds no training"):
        train(training(), tmp_path / "empty", resume=True)
    with pytest.raises(ConfigurationError, match=r"has seed = 0, not 1"):
        train(training(json.loads((folder / "config.json").read_text())["training"]["algorithm"], seed=1), folder, resume=True)


def test_there_are_hyperparameters_for_every_id():
    for algorithm in ALGORITHMS:
        for env_id in safe_envs.ENV_IDS:
            settings = hyperparameters(algorithm, env_id)
            assert settings["policy"] == "MlpPolicy"
            assert settings["n_envs"] >= 1


def test_the_files_have_the_form_that_the_zoo_reads():
    """Its ExperimentManager takes YAML with ids for keys, and evaluates texts for arguments, so that there are none here."""
    from importlib.resources import files

    for algorithm in ALGORITHMS:
        table = yaml.safe_load(files("agents").joinpath("hyperparams", f"{algorithm}.yml").read_text())
        assert set(safe_envs.ENV_IDS) <= set(table)
        for settings in table.values():
            assert not isinstance(settings["policy_kwargs"], str)


def test_schedules_fall_to_nothing():
    settings = scheduled({"learning_rate": "lin_2e-3", "gamma": 0.9})
    assert [settings["learning_rate"](left) for left in (1.0, 0.5, 0.0)] == pytest.approx([2e-3, 1e-3, 0.0])
    for text in ("exp_3", "lin_x"):
        with pytest.raises(ConfigurationError, match="learning_rate"):
            scheduled({"learning_rate": text})


def test_a_log_forgets_what_came_after_the_checkpoint_and_half_a_line(tmp_path):
    path = tmp_path / "progress.jsonl"
    log = ProgressLog(path, 0)
    for step in (1, 2, 3):
        log.write({"a": np.float32(step), "b": float("nan"), "text": "c"}, {}, step)
    path.write_text(path.read_text() + '{"step": 4, "a"')
    ProgressLog(path, 2)
    assert read_progress(path) == [{"step": 1, "a": 1.0, "b": None}, {"step": 2, "a": 2.0, "b": None}]
