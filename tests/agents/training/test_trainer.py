"""Training: what it leaves, that it can be gone on with, and that its figures are those of the
evaluation."""

from __future__ import annotations

import json
import shutil
from typing import Any

import numpy as np
import pytest
import yaml

import safe_envs
from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.training.callbacks import ProgressLog, SafetyFigures
from safe_envs.agents.training.config import (
    ALGORITHMS,
    CONSTRAINED,
    Training,
    scheduled,
    whole_batches,
)
from safe_envs.agents.training.trainer import TrainingSession, train
from safe_envs.agents.training.vec_env import make_sb3_env
from safe_envs.engine import choice as engines
from safe_envs.engine.program import Program
from safe_envs.filters.learning.data import load
from safe_envs.registry import make_problem

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"
SMALL = {"num_envs": 4, "eval_episodes": 8, "options": {"horizon": 0.5}}


# Three evaluations; sac learns at every step, which takes long.
LENGTHS = {"ppo": (768, 256), "sac": (192, 64)}


def training(algorithm="ppo", steps=None, every=None, **changes):
    length = LENGTHS.get(algorithm, LENGTHS["ppo"])
    steps, every = steps or length[0], every or length[1]
    settings = {"learning_starts": 40} if algorithm in ("sac", "td3") else {}
    given = {"filter": "scbf", "n_timesteps": steps, "eval_freq": every, **SMALL, **changes}
    given["settings"] = settings | given.get("settings", {})
    return Training.of(DUBINS, algorithm, **given)


def logged(folder):
    """All that was logged, but for the clock."""
    return [
        {k: v for k, v in line.items() if not k.startswith("time/")}
        for line in map(json.loads, (folder / "progress.jsonl").read_text().splitlines())
    ]


def evaluations(folder):
    return json.loads((folder / "evaluations.json").read_text())


@pytest.fixture(scope="module", params=["ppo", "sac"])
def finished(request, tmp_path_factory):
    """A short training of each kind."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    told = []
    train(training(request.param), folder, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    return request.param, folder


def test_the_folder_holds_all_that_is_needed(finished):
    algorithm, folder = finished
    names = {path.name for path in folder.iterdir()}
    wanted = {
        "config.json",
        "evaluations.json",
        "progress.jsonl",
        "model.zip",
        "policy.npz",
        "best",
    }
    assert wanted <= names
    assert len([name for name in names if name.startswith("checkpoint_")]) == 1
    config = json.loads((folder / "config.json").read_text())
    assert config["training"]["algorithm"] == algorithm
    assert config["training"]["env_id"] == DUBINS
    assert "stable-baselines3" in config["versions"]
    rows = evaluations(folder)
    assert rows[-1]["timesteps"] >= LENGTHS[algorithm][0]
    assert all(row["ci_low"] <= row["safety_rate"] <= row["ci_high"] for row in rows)
    assert {row["filter"] for row in rows} == {"scbf"}


def test_its_figures_are_those_of_the_evaluation(finished):
    _, folder = finished
    assert len({row["seed"] for row in evaluations(folder)}) == 1
    last, best = (
        evaluations(folder)[-1],
        max(evaluations(folder), key=lambda row: row["return_mean"]),
    )
    for path, row in ((folder, last), (folder / "best", best)):
        (found,) = evaluate(
            DUBINS,
            str(path),
            ["scbf"],
            episodes=8,
            seed=row["seed"],
            bounds=False,
            options=SMALL["options"],
        ).rows
        assert {key: getattr(found, key) for key in ("safe", "return_mean", "violations")} == {
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
    assert (tmp_path / "again" / "policy.npz").read_bytes() == (folder / "policy.npz").read_bytes()


def test_a_training_that_was_interrupted_goes_on_as_if_it_had_not_been(finished, tmp_path):
    algorithm, folder = finished
    interrupted = tmp_path / "interrupted"

    def stop(part):
        if part > 0.8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(training(algorithm), interrupted, progress=stop)
    assert evaluations(interrupted)[-1]["timesteps"] < LENGTHS[algorithm][0]
    with pytest.raises(ConfigurationError, match="not finished"):
        evaluate(DUBINS, str(interrupted), ["none"], episodes=1)
    evaluate(DUBINS, str(interrupted / "best"), ["none"], episodes=1)
    train(training(algorithm), interrupted, resume=True)
    assert logged(interrupted) == logged(folder)
    assert evaluations(interrupted) == evaluations(folder)
    assert (interrupted / "policy.npz").read_bytes() == (folder / "policy.npz").read_bytes()
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
    given = {"episodes": 8, "seed": rows[-1]["seed"], "bounds": False, "options": SMALL["options"]}
    (found,) = evaluate(DUBINS, str(tmp_path / "run"), ["scbf"], **given).rows
    assert found.return_mean == rows[-1]["return_mean"]
    assert (tmp_path / "run" / "normalization.pkl").exists()
    assert (tmp_path / "run" / "best" / "normalization.pkl").exists()
    assert load(tmp_path / "run" / "policy.npz").details["normalization"]


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
        ({"action": "both"}, "leave it out"),
        ({"algorithm": "sac", "intervention_penalty": 1.0}, "intervention penalty"),
        ({"options": {"noise": np.ones(2)}}, "JSON"),
        ({"seed": 2**32}, "seed"),
        ({"settings": {"batch_size": 100}}, "batch_size"),
        ({"settings": {"n_steps": "many"}}, "n_steps"),
        ({"settings": {"n_timesteps": "many"}, "n_timesteps": None}, "n_timesteps"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            training(**changes)
    with pytest.raises(ConfigurationError, match="--algo dqn"):
        training("dqn")
    with pytest.raises(ConfigurationError, match="unknown env"):
        Training.of("Nowhere-v0", "ppo")
    with pytest.raises(ConfigurationError, match="not empty"):
        train(training(), folder)
    with pytest.raises(ConfigurationError, match="holds no training"):
        train(training(), tmp_path / "empty", resume=True)
    with pytest.raises(ConfigurationError, match=r"has seed = 0, not 1"):
        train(
            training(
                json.loads((folder / "config.json").read_text())["training"]["algorithm"], seed=1
            ),
            folder,
            resume=True,
        )
    config = json.loads((folder / "config.json").read_text())
    # The times of evaluations follow from the length, which is what was changed.
    longer = Training(**{**config["training"], "n_timesteps": 999_999, "eval_freq": 99_999})
    with pytest.raises(ConfigurationError, match=r"has n_timesteps = \d+, not 999999"):
        train(longer, folder, resume=True)
    del config["training"]["engine"]
    (tmp_path / "older").mkdir()
    (tmp_path / "older" / "config.json").write_text(json.dumps(config))
    with pytest.raises(ConfigurationError, match="by another version, which had no engine; go on"):
        train(training(), tmp_path / "older", resume=True)


@pytest.mark.parametrize(
    ("algorithm", "settings", "message"),
    [
        (
            "ppo",
            {"learning_rat": 3},
            "ppo does not take the hyperparameter 'learning_rat'; did you mean 'learning_rate'",
        ),
        ("ppo", {"policy_kwargs": {"speed": 3}}, r"ppo does not take these hyperparameters.*speed"),
        ("a2c", {"n_epochs": 3}, "a2c does not take"),
        ("ppo", {"normalize": "no thanks"}, "normalize|does not take"),
        ("ppo", {"normalize": {"bogus": 1}}, "bogus"),
        ("sac", {"noise_type": "pink", "noise_std": 0.1}, "noise_type"),
        ("sac", {"noise_type": "normal"}, "needs noise_std"),
        ("sac", {"noise_std": 0.1}, "noise_type"),
        ("sac", {"replay_buffer_kwargs": {}}, "replay buffer"),
        ("sac", {"use_sde": True}, "saved"),
        ("sac", {"learning_starts": "soon"}, "learning_starts = 'soon'; give a number"),
        ("ppo", {"learning_rate": 1e12}, "diverged|not all finite"),
        ("ppo", {"stats_window_size": 10**400}, "does not take|failed after"),
        ("ppo", {"gamma": 10**400}, "give a number from 0 to 1"),
        ("ppo", {"normalize": {"clip_obs": 10**400}}, "does not take|failed after"),
        ("ppo", {"normalize": "[" * 5000}, "does not take"),
    ],
)
def test_hyperparameters_that_do_not_work_are_refused_and_leave_the_folder_to_others(
    algorithm, settings, message, tmp_path
):
    with pytest.raises(ConfigurationError, match=message):
        train(training(algorithm, settings=settings), tmp_path / "run")
    train(training("a2c", steps=64, every=64), tmp_path / "run")


def test_the_zoo_s_texts_and_lists_are_understood(tmp_path):
    session = TrainingSession(
        training(settings={"normalize": "{'norm_obs': False, 'norm_reward': True}", "gamma": 0.9}),
        tmp_path,
    )
    scales = session._model.get_env()
    assert (scales.norm_obs, scales.norm_reward, scales.gamma) == (False, True, 0.9)
    session = TrainingSession(
        training(
            "sac",
            settings={
                "train_freq": [2, "step"],
                "noise_type": "ornstein-uhlenbeck",
                "noise_std": 0.2,
            },
        ),
        tmp_path,
    )
    assert session._model.train_freq.frequency == 2
    assert "OrnsteinUhlenbeck" in str(session._model.action_noise)


def test_a_rollout_is_cut_into_whole_batches():
    assert [whole_batches(512, rollout, False) for rollout in (2048, 625, 448, 37, 1021)] == [
        512,
        125,
        448,
        37,
        1021,
    ]
    assert whole_batches(64, 256, True) == 64
    with pytest.raises(ConfigurationError, match="give 64"):
        whole_batches(100, 256, True)
    wrong: Any
    for wrong in (1, 2.0, "512", True):
        with pytest.raises(ConfigurationError, match="batch_size"):
            whole_batches(wrong, 256, False)


def test_the_filter_in_the_loop_knows_what_it_is_to_know(tmp_path):
    problem = make_problem("safe_envs/QuadrotorAltitude-v0")
    for knowledge, system in (("model", problem.model), ("plant", problem.plant)):
        session = TrainingSession(
            Training.of("QuadrotorAltitude-v0", "ppo", filter="hocbf", knowledge=knowledge),
            tmp_path,
        )
        assert (
            session._model.get_env().unwrapped.env.safety_filter.model.parameters
            == system.parameters
        )
    assert problem.model.parameters != problem.plant.parameters


def test_episodes_go_on_from_one_part_to_the_next(tmp_path):
    """Their 10 steps are longer than a part, which are 4 of each env."""
    train(
        training("a2c", steps=160, every=16, settings={"n_steps": 4}, filter=None), tmp_path / "run"
    )
    last = {key: value for line in logged(tmp_path / "run") for key, value in line.items()}
    assert last["rollout/ep_len_mean"] == 10
    assert len(evaluations(tmp_path / "run")) == 10
    assert last["safety/rate"] >= 0


def test_the_learning_rate_falls_over_the_whole_training_and_never_below_zero(tmp_path):
    train(
        training(steps=700, settings={"learning_rate": "lin_1e-3", "n_steps": 64}), tmp_path / "run"
    )
    found = {
        line["step"]: line["train/learning_rate"]
        for line in logged(tmp_path / "run")
        if "train/learning_rate" in line
    }
    assert max(found) > 700
    assert found == pytest.approx({step: 1e-3 * max(0.0, 1 - step / 700) for step in found})


def test_long_trainings_take_the_compiled_engine(tmp_path, monkeypatch):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    for long, engine in ((769, "numpy"), (768, "auto")):
        monkeypatch.setattr(engines, "LONG", long)
        session = TrainingSession(training(), tmp_path)
        assert session._model.get_env().get_attr("engine") == [engine] * 4
    with pytest.raises(ConfigurationError, match="engine = 'fast'"):
        training(engine="fast")


def test_no_engine_but_numpy_is_used_where_it_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "LONG", 0)
    monkeypatch.setattr(Program, "compiled", lambda _: pytest.fail("a program is compiled"))
    train(training(steps=256, engine="numpy"), tmp_path / "run")
    assert len(evaluations(tmp_path / "run")) == 1


def test_the_figures_are_those_of_the_infos():
    envs, figures = make_sb3_env(DUBINS, 3, "scbf", seed=0, horizon=0.5, noise=1.0), SafetyFigures()
    figures.init_callback(
        type("Model", (), {"get_env": lambda self: envs, "logger": None, "num_timesteps": 0})()
    )  # pyright: ignore
    envs.reset()
    rng, seen, ended = np.random.default_rng(0), [], []
    for _ in range(60):
        _, _, dones, infos = envs.step(rng.uniform(-1.0, 1.0, (3, 1)))
        figures.locals = {"dones": dones}
        figures._on_step()
        seen += [dict(info) for info in infos]
        ended += [dict(info) for info, done in zip(infos, dones, strict=True) if done]
    found = figures.figures()
    assert found["violations"] == sum(info["violation"] for info in seen) > 0
    assert found["interventions"] == np.mean([info["intervention"] for info in seen])
    assert found["infeasible"] == np.mean([not info["feasible"] for info in seen])
    assert 0 < found["infeasible"] < found["interventions"] < 1
    assert found["rate"] == np.mean([info["episode_cost"] == 0 for info in ended])
    assert found["episode_cost"] == np.mean([info["episode_cost"] for info in ended])
    assert found["h_min"] == pytest.approx(np.mean([info["h_min"] for info in ended]))


def test_the_figures_are_those_of_the_evaluation_on_the_same_episodes():
    options, episodes = {"horizon": 0.5, "noise": 1.0}, 32
    (row,) = evaluate(
        DUBINS, "zero", ["scbf"], options=options, episodes=episodes, bounds=False
    ).rows
    envs, figures = make_sb3_env(DUBINS, episodes, "scbf", **options), SafetyFigures()
    figures.init_callback(
        type("Model", (), {"get_env": lambda self: envs, "logger": None, "num_timesteps": 0})()
    )  # pyright: ignore
    envs._seeds = [episode_seed(0, i) for i in range(episodes)]
    envs.reset()
    dones = np.zeros(episodes, dtype=bool)
    while not dones.any():
        _, _, dones, _ = envs.step(np.zeros((episodes, 1)))
        figures.locals = {"dones": dones}
        figures._on_step()
    assert dones.all()
    assert 0 < figures.figures()["rate"] < 1
    assert figures.figures()["rate"] == row.safety_rate


def test_the_files_have_the_form_that_the_zoo_reads():
    """Its ExperimentManager takes YAML with ids for keys, and evaluates texts for arguments, so
    that there are none here."""
    from importlib.resources import files

    for algorithm in set(ALGORITHMS) - set(CONSTRAINED):
        table = yaml.safe_load(
            files("safe_envs.agents.training")
            .joinpath("hyperparams", f"{algorithm}.yml")
            .read_text()
        )
        assert set(safe_envs.ENV_IDS) <= set(table)
        for settings in table.values():
            assert not isinstance(settings["policy_kwargs"], str)
            assert settings["policy"] == "MlpPolicy"


def test_schedules_fall_to_nothing():
    settings = scheduled({"learning_rate": "lin_2e-3", "gamma": 0.9})
    assert [settings["learning_rate"](left) for left in (1.0, 0.5, 0.0, -1.0)] == pytest.approx(
        [2e-3, 1e-3, 0.0, 0.0]
    )
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
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"step": 1, "a": 1.0, "b": None},
        {"step": 2, "a": 2.0, "b": None},
    ]
