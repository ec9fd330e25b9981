"""Training: what it leaves, that it goes on after an interruption as if there had been none, and
that its figures are those of the evaluation."""

from __future__ import annotations

import io
import json
import shutil

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from safe_envs import ENV_IDS, ConfigurationError
from safe_envs.agents import evaluate, make_sb3_env
from safe_envs.agents.training.callbacks import SafetyFigures
from safe_envs.agents.training.config import PromiseCurriculum, Training
from safe_envs.agents.training.constraint import COST, DEFAULT_VIOLATION_LIMIT, VIOLATION
from safe_envs.agents.training.hyperparameters import CONSTRAINED, hyperparameters
from safe_envs.agents.training.trainer import train
from safe_envs.filters.learning.data import load
from safe_envs.scripts.reports.sweep import print_evaluations
from tests.agents.training.small import (
    DUBINS,
    SCALAR,
    evaluations,
    logged,
    outcome,
    stopped,
    training,
)

pytestmark = pytest.mark.slow

FILES = {"config.json", "evaluations.json", "progress.jsonl", "model.zip", "policy.npz", "best"}
FIGURES = ("rate", "episode_cost", "h_min", "violations", "interventions", "infeasible")


@pytest.fixture(scope="module", params=["ppo", "sac"])
def finished(request, tmp_path_factory):
    """A short training of each kind, with scales of the observations."""
    folder, told = tmp_path_factory.mktemp(request.param) / "run", []
    wanted = training(request.param, {"normalize": True}, eval_episodes=8)
    train(wanted, folder, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    return wanted, folder


def test_the_folder_holds_all_that_is_needed(finished):
    wanted, folder = finished
    names = {path.name for path in folder.iterdir()}
    assert {*FILES, "normalization.pkl"} <= names
    assert len([name for name in names if name.startswith("checkpoint_")]) == 1
    config = json.loads((folder / "config.json").read_text())
    assert (config["training"]["algorithm"], config["training"]["env_id"]) == (
        wanted.algorithm,
        DUBINS,
    )
    assert "stable-baselines3" in config["versions"]
    assert load(folder / "policy.npz").details["normalization"]
    last = {key: value for line in logged(folder) for key, value in line.items()}
    assert {f"safety/{name}" for name in FIGURES} <= set(last)
    assert {"eval/safety_rate", "rollout/ep_rew_mean"} <= set(last)
    assert last["rollout/ep_len_mean"] == 10
    assert 0 < last["safety/interventions"] <= 1


def test_its_figures_are_those_of_the_evaluation(finished):
    _, folder = finished
    rows = evaluations(folder)
    assert [row["timesteps"] for row in rows] == [32, 64, 96]
    assert {(row["filter"], row["seed"]) for row in rows} == {("scbf", rows[0]["seed"])}
    assert all(row["ci_low"] <= row["safety_rate"] <= row["ci_high"] for row in rows)
    given = {"episodes": 8, "seed": rows[0]["seed"], "bounds": False, "options": {"horizon": 0.5}}
    best = max(rows, key=lambda row: row["return_mean"])
    for path, row in ((folder, rows[-1]), (folder / "best", best)):
        (found,) = evaluate(DUBINS, str(path), ["scbf"], **given).rows
        names = ("safe", "return_mean", "violations")
        assert {name: getattr(found, name) for name in names} == {name: row[name] for name in names}


PROMISE = {"env_id": SCALAR, "filter": "promise:p=0.97"}
PROMISE["options"] = {"horizon": 0.2, "start": [0.8]}
CURRICULUM = {"promise_curriculum": 0.5, "curriculum_part": 0.8}
MEASURED = {"horizon": 0.5, "measurement": ["default", "delay=2"]}
SMALL_MEMORY = {
    "optimize_memory_usage": True,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},
}
COSTS = {"env_id": SCALAR, "filter": None, "cost_limit": 0.5}
VIOLATIONS = {"env_id": SCALAR, "action": "both", "violation_limit": 0.1}
ESTIMATED = {
    "env_id": SCALAR,
    "filter": "scbf:belief=0.05",
    "estimator": "ekf",
    "options": MEASURED,
}
NOISE = {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.3}
CASES = {
    "rewards-normalised": ("ppo", {"normalize": {"norm_obs": False}, "stats_window_size": 3}, {}),
    "bare": ("a2c", {"use_sde": True}, {"filter": None}),
    "both-actions": ("sac", {"normalize": True}, {"action": "both", "intervention_penalty": 0.1}),
    "n-step-full-buffer": ("sac", {"n_steps": 3, "buffer_size": 40}, {}),
    "noise": ("td3", NOISE, {}),
    "cost-limit": ("ppo-lag", {"use_sde": True, "multiplier_smoothing": 0.5}, COSTS),
    "sac-lag": ("sac-lag", {"normalize": True, "buffer_size": 40}, VIOLATIONS),
    "sac-lag-small-memory": (
        "sac-lag",
        {**SMALL_MEMORY, "cost_gamma": 0.9, "multiplier_kd": 0.3},
        COSTS,
    ),
    "estimator": ("ppo", {}, ESTIMATED),
    "curriculum": ("ppo", {}, {**PROMISE, **CURRICULUM}),
}


def require_same_after_a_stop(wanted, folder, whole):
    checkpoint = stopped(wanted, folder)
    assert evaluations(folder)[-1]["timesteps"] == 64
    with pytest.raises(ConfigurationError, match="not finished"):
        evaluate(wanted.env_id, str(folder), ["none"], episodes=1)
    if "sac-lag" in wanted.algorithm:
        assert load_file(checkpoint / "replay_buffer.safetensors")["costs"].any()
    # Half a line, as of a training that was killed.
    with (folder / "progress.jsonl").open("a") as file:
        file.write('{"step": 4, "a"')
    train(wanted, folder, resume=True)
    assert outcome(folder) == outcome(whole)


def test_an_interrupted_training_ends_as_another_one_that_was_not(finished, tmp_path):
    wanted, folder = finished
    require_same_after_a_stop(wanted, tmp_path / "run", folder)
    train(wanted, tmp_path / "run", resume=True)  # there is nothing left to do
    assert outcome(tmp_path / "run") == outcome(folder)
    # A checkpoint without its evaluation gets it.
    (tmp_path / "run" / "evaluations.json").write_text(json.dumps(evaluations(folder)[:-1]))
    train(wanted, tmp_path / "run", resume=True)
    assert evaluations(tmp_path / "run") == evaluations(folder)


@pytest.mark.parametrize(("algorithm", "changes", "arguments"), CASES.values(), ids=CASES)
def test_a_stopped_training_of_any_kind_ends_as_one_that_was_not(
    algorithm, changes, arguments, tmp_path
):
    wanted = training(algorithm, changes, **arguments)
    train(wanted, tmp_path / "whole")
    require_same_after_a_stop(wanted, tmp_path / "run", tmp_path / "whole")
    last = evaluations(tmp_path / "run")[-1]
    assert last["filter"] == (wanted.filter or "none")
    if wanted.limit_kind is not None:
        assert last["constraint"]["multiplier"] > 0.0
    if wanted.curriculum is not None:
        found = [line.get("train/probability") for line in logged(tmp_path / "run")]
        values = [value for value in found if value is not None]
        assert values == sorted(values)
        assert values[0] < values[-1] == 0.97


def test_the_filter_in_the_loop_knows_what_it_is_to_know(tmp_path):
    options = {"horizon": 0.5, "plant": {"v": 3.0}}
    for knowledge in ("model", "plant"):
        train(training(knowledge=knowledge, options=options), tmp_path / knowledge)
    assert outcome(tmp_path / "model")[2] != outcome(tmp_path / "plant")[2]


def test_episodes_go_on_from_one_part_to_the_next_and_rates_fall_over_all_of_them(tmp_path):
    """Their 10 steps are longer than a part, which are 4 of each env."""
    changes = {"n_steps": 4, "batch_size": 8, "learning_rate": "lin_1e-3"}
    train(training("ppo", changes, n_timesteps=60, eval_freq=8, filter=None), tmp_path / "run")
    lines = logged(tmp_path / "run")
    last = {key: value for line in lines for key, value in line.items()}
    assert last["rollout/ep_len_mean"] == 10
    assert last["safety/rate"] >= 0
    assert len(evaluations(tmp_path / "run")) == 8
    key = "train/learning_rate"
    found = {line["step"]: line[key] for line in lines if key in line}
    assert max(found) > 60  # whole rollouts, and no rate below 0
    assert found == pytest.approx({step: 1e-3 * max(0.0, 1 - step / 60) for step in found})


class Witness(BaseCallback):
    """Keeps all infos, and those of the ends of episodes."""

    def __init__(self):
        super().__init__()
        self.seen, self.ended = [], []

    def _on_step(self):
        infos = [dict(info) for info in self.locals["infos"]]
        self.seen += infos
        self.ended += [i for i, done in zip(infos, self.locals["dones"], strict=True) if done]
        return True


def test_the_figures_are_those_of_the_infos():
    envs = make_sb3_env(DUBINS, 3, "scbf", seed=0, horizon=0.5, noise=1.0)
    figures, witness = SafetyFigures(), Witness()
    model = PPO("MlpPolicy", envs, n_steps=60, batch_size=60, n_epochs=1, device="cpu", seed=0)
    model.learn(180, callback=[figures, witness])
    found, seen, ended = figures.figures(), witness.seen, witness.ended
    assert found["violations"] == sum(info["violation"] for info in seen) > 0
    assert found["interventions"] == np.mean([info["intervention"] for info in seen])
    assert found["infeasible"] == np.mean([not info["feasible"] for info in seen])
    assert 0 < found["infeasible"] < found["interventions"] < 1
    assert found["rate"] == np.mean([info["episode_cost"] == 0 for info in ended])
    assert found["episode_cost"] == np.mean([info["episode_cost"] for info in ended])
    assert found["h_min"] == pytest.approx(np.mean([info["h_min"] for info in ended]))


REFUSED = [
    ({"n_timesteps": 0}, "n_timesteps"),
    ({"action": "both "}, "action"),
    ({"action": "both"}, "action"),
    ({"algorithm": "sac", "intervention_penalty": 1.0}, "intervention penalty"),
    ({"options": {"noise": np.ones(2)}}, "JSON"),
    ({"seed": 2**32}, "seed"),
    ({"changes": {"batch_size": 100}}, "batch_size"),
    ({"changes": {"n_steps": "many"}}, "n_steps"),
    ({"changes": {"n_timesteps": "many"}, "n_timesteps": None}, "n_timesteps"),
    ({"algorithm": "dqn"}, "dqn"),
    ({"env_id": "Nowhere-v0"}, "Nowhere-v0"),
    ({"engine": "fast"}, "engine = 'fast'"),
    *(
        ({"env_id": SCALAR, "filter": PROMISE["filter"], "promise_curriculum": 0.5, **each}, word)
        for each, word in (
            ({"filter": "scbf"}, "promise filter"),
            ({"promise_curriculum": 0.97}, "promise_curriculum"),
            ({"promise_curriculum": 0.0}, "promise_curriculum"),
            ({"promise_curriculum": float("nan")}, "JSON"),
            ({"curriculum_part": 0.0}, "curriculum_part"),
            ({"curriculum_part": 1.5}, "curriculum_part"),
        )
    ),
]


@pytest.mark.parametrize(("changes", "fragment"), REFUSED)
def test_what_cannot_be_trained_is_refused(changes, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        training(**changes)


def test_folders_of_other_trainings_are_refused(finished, tmp_path):
    wanted, folder = finished
    config = json.loads((folder / "config.json").read_text())
    of_config = config["training"]
    # The times of evaluations follow from the length, which is what was changed.
    longer = Training(**{**of_config, "n_timesteps": 999_999, "eval_freq": 99_999})
    older = tmp_path / "older"
    older.mkdir()
    without = {name: value for name, value in of_config.items() if name != "engine"}
    (older / "config.json").write_text(json.dumps({**config, "training": without}))
    for given, place, resume, fragment in (
        (wanted, folder, False, "not empty"),
        (wanted, tmp_path / "empty", True, "no training"),
        (Training(**{**of_config, "seed": 1}), folder, True, "seed = 0, not 1"),
        (longer, folder, True, "n_timesteps = 96, not 999999"),
        (wanted, older, True, "engine"),
    ):
        with pytest.raises(ConfigurationError, match=fragment):
            train(given, place, resume=resume)
    shutil.rmtree(older)


def test_p_rises_linearly_to_that_of_the_filter():
    curriculum = PromiseCurriculum.of(0.5, 0.5, "promise:p=0.9", 1000)
    assert [curriculum.at(n) for n in (0, 500, 1000, 1100)] == [0.5, 0.9, 0.9, 0.9]
    assert curriculum.at(250) == pytest.approx(0.7)
    values = [PromiseCurriculum.of(0.1, 1.0, "promise:p=0.7", 7).at(n) for n in range(9)]
    assert values == sorted(values)
    assert values[-1] == 0.7


def test_each_episode_keeps_the_p_it_began_with():
    horizon = {"horizon": 0.2}  # 20 steps
    envs, other = (
        make_sb3_env(SCALAR, 3, f"promise:p={p}", seed=0, **horizon) for p in (0.97, 0.5)
    )
    envs.env_method("ask_promise", 0.5)
    for each in (envs, other):
        each.reset()
        assert [info["promise"] for info in each.reset_infos] == [0.5] * 3
    rng = np.random.default_rng(0)
    for k in range(20):
        if k == 5:
            envs.env_method("ask_promise", 0.9)
        action = rng.uniform(-1.0, 1.0, (3, 1))
        (*_, done, infos), (*_, theirs) = envs.step(action), other.step(action)
        for key in ("safe_action", "promise"):  # as behind the filter that is made for 0.5
            assert [info[key] for info in infos] == [info[key] for info in theirs]
    assert done.all()
    assert [info["promise"] for info in envs.reset_infos] == pytest.approx([0.9] * 3)
    for wrong in (0.0, 0.98, float("nan")):
        with pytest.raises(ConfigurationError, match="probability"):
            envs.env_method("ask_promise", wrong)
    with pytest.raises(ConfigurationError, match="promise filter"):
        make_sb3_env(SCALAR, 2, "scbf", **horizon).env_method("ask_promise", 0.5)


# Limits of a training: which are allowed, and that it is told whether one is met.


BOTH = pytest.mark.parametrize("algorithm", CONSTRAINED)


@BOTH
def test_without_a_limit_there_is_the_default_one(algorithm):
    one = Training.of(SCALAR, algorithm)
    assert (one.cost_limit, one.violation_limit) == (None, DEFAULT_VIOLATION_LIMIT)
    other = Training.of(SCALAR, algorithm, cost_limit=0)
    assert (other.limit_kind, other.cost_limit, other.violation_limit) == (COST, 0, None)


@pytest.mark.parametrize(
    ("algorithm", "limits", "fragment"),
    [
        ("ppo", {"cost_limit": 1.0}, "cost_limit; .*ppo-lag or sac-lag"),
        ("td3", {"violation_limit": 0.1}, "violation_limit"),
        ("ppo-lag", {"cost_limit": 1.0, "violation_limit": 0.1}, "2 limits"),
        ("ppo-lag", {"violation_limit": 1.0}, "violation_limit = 1"),
        ("sac-lag", {"violation_limit": -0.1}, r"violation_limit = -0\.1"),
        ("ppo-lag", {"cost_limit": "few"}, "cost_limit = 'few'"),
    ],
)
def test_other_limits_are_refused(algorithm, limits, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        Training.of(SCALAR, algorithm, **limits)


@pytest.mark.parametrize("key", ["cost_limit", "cost_unit"])
def test_a_limit_is_no_hyperparameter(key, tmp_path):
    with pytest.raises(ConfigurationError, match="--violation-limit"):
        train(training("ppo-lag", {key: 1.0}), tmp_path / "run")


@BOTH
def test_the_budget_is_that_of_the_algorithm_without_a_constraint(algorithm):
    for env_id in ENV_IDS:
        mine = hyperparameters(algorithm, env_id)
        theirs = hyperparameters(algorithm.removesuffix("-lag"), env_id)
        assert {key: mine[key] for key in theirs} == theirs
        assert all(key.startswith(("cost_", "multiplier_")) for key in mine.keys() - theirs.keys())


def printed(rows):
    stream = io.StringIO()
    print_evaluations(Console(file=stream, width=400), "none", rows)
    return stream.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "kind"), [("ppo-lag", VIOLATION), ("sac-lag", COST)])
def test_a_limit_of_zero_gives_finite_numbers_and_is_judged_and_told(algorithm, kind, tmp_path):
    # Without costs, and with costs that no policy avoids: the noise of a step is larger than the
    # safe set.
    for name, start, noise in (("safe", [0.0], 0.0), ("unsafe", [0.9], 3.0)):
        folder = tmp_path / name
        options = {"horizon": 0.1, "start": start, "noise": noise}
        given = {"filter": None, "eval_episodes": 40, "n_timesteps": 160, kind: 0.0}
        train(training(algorithm, env_id=SCALAR, options=options, **given), folder)
        keys = {key for line in logged(folder) for key in line}
        names = ("multiplier", "limit", "episode_cost", "violation_rate")
        assert {f"constraint/{name}" for name in names} <= keys
        assert "NaN" not in (folder / "progress.jsonl").read_text()
        last = evaluations(folder)[-1]
        judgement = last["constraint"]
        assert (judgement["kind"], judgement["met"]) == (kind, name == "safe")
        assert ("NOT MET" in printed([last])) is (name == "unsafe")
        assert judgement["episodes"] > 10
        for key in ("low", "multiplier"):
            assert (judgement[key] > judgement["limit"] == 0.0) is (name == "unsafe")
        (checkpoint,) = folder.glob("checkpoint_*")
        for array in load_file(checkpoint / "learner.safetensors").values():
            assert np.isfinite(array).all()
    # The policy is data, and a file of Stable-Baselines3.
    (row,) = evaluate(SCALAR, str(folder), ["none"], episodes=20, seed=1).rows
    assert 0.0 <= row.safety_rate <= 1.0
    if algorithm == "ppo-lag":
        assert PPO.load(folder / "model.zip").n_steps == 16


@pytest.mark.slow
def test_a_filter_in_the_loop_keeps_the_limit_by_itself(tmp_path):
    given = {"intervention_penalty": 0.1, "violation_limit": 0.5, "eval_episodes": 8}
    wanted = training("ppo-lag", env_id=SCALAR, options={"horizon": 0.1}, **given)
    train(wanted, tmp_path / "run")
    last = evaluations(tmp_path / "run")[-1]
    assert (last["constraint"]["met"], last["filter"]) == (True, "scbf")
    assert "NOT MET" not in printed([last])
