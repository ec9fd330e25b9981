"""Limits of a training: which are allowed, whether one is met, and that it is told."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import yaml
from rich.console import Console
from stable_baselines3 import PPO, SAC

from safe_envs import ENV_IDS, ConfigurationError
from safe_envs.agents.training.algorithms import algorithm_class, new_model
from safe_envs.agents.training.config import CONSTRAINED, Training, hyperparameters
from safe_envs.agents.training.constraint import (
    COST,
    DEFAULT_VIOLATION_LIMIT,
    VIOLATION,
    EpisodeConstraint,
    judged,
    rank,
)
from safe_envs.agents.training.trainer import train
from safe_envs.agents.training.vec_env import make_sb3_env
from safe_envs.registry import make_problem
from safe_envs.scripts.reports.sweep import print_evaluations

SCALAR = "safe_envs/Scalar-v0"
SMALL = {
    "n_timesteps": 256,
    "eval_freq": 128,
    "num_envs": 4,
    "eval_episodes": 8,
    "options": {"horizon": 0.5},
    "settings": {"n_steps": 32, "batch_size": 64, "n_epochs": 1},
}


def observed(limit, costs, unit=1.0):
    """A constraint that measured these costs of one episode each."""
    one = EpisodeConstraint(limit, 1, unit=unit, gains={"kp": 1.0, "ki": 1.0, "kd": 0.0})
    for cost in costs:
        one.observe(np.array([float(cost)]), np.array([True]))
        one.update()
    return one


def row(ci_low=0.9, ci_high=1.0, return_mean=1.0, **more):
    return {"ci_low": ci_low, "ci_high": ci_high, "return_mean": return_mean, **more}


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_without_a_limit_there_is_the_default_one(algorithm):
    one = Training.of(SCALAR, algorithm)
    assert (one.cost_limit, one.violation_limit) == (None, DEFAULT_VIOLATION_LIMIT)
    assert one.constraint["cost_limit"] == DEFAULT_VIOLATION_LIMIT
    other = Training.of(SCALAR, algorithm, cost_limit=0)
    assert (other.limit_kind, other.violation_limit, other.constraint["cost_limit"]) == (
        COST,
        None,
        0,
    )


@pytest.mark.parametrize(
    ("algorithm", "limits", "message"),
    [
        ("ppo", {"cost_limit": 1.0}, "ppo has no cost_limit; .*choose ppo-lag or sac-lag"),
        ("td3", {"violation_limit": 0.1}, "td3 has no violation_limit"),
        ("ppo-lag", {"cost_limit": 1.0, "violation_limit": 0.1}, "given 2 limits; give one"),
        ("ppo-lag", {"violation_limit": 1.0}, "is a probability"),
        ("sac-lag", {"violation_limit": -0.1}, "violation_limit = -0.1; give a finite number"),
        ("ppo-lag", {"cost_limit": "few"}, "cost_limit = 'few'"),
    ],
)
def test_other_limits_are_refused(algorithm, limits, message):
    with pytest.raises(ConfigurationError, match=message):
        Training.of(SCALAR, algorithm, **limits)


@pytest.mark.parametrize(("algorithm", "base"), [("ppo-lag", "ppo"), ("sac-lag", "sac")])
def test_the_budget_is_that_of_the_algorithm_without_a_constraint(algorithm, base):
    for env_id in ENV_IDS:
        mine, theirs = hyperparameters(algorithm, env_id), hyperparameters(base, env_id)
        assert {key: mine[key] for key in theirs} == theirs
        assert all(key.startswith(("cost_", "multiplier_")) for key in mine.keys() - theirs.keys())


@pytest.mark.parametrize(("algorithm", "base"), [("ppo-lag", PPO), ("sac-lag", SAC)])
def test_the_algorithms_are_those_of_stable_baselines3_with_more(algorithm, base):
    assert issubclass(algorithm_class(algorithm), base)


@pytest.mark.parametrize("key", ["cost_limit", "cost_unit"])
def test_a_limit_is_no_hyperparameter(key):
    envs, problem = make_sb3_env(SCALAR, 2), make_problem(SCALAR)
    with pytest.raises(ConfigurationError, match="--violation-limit"):
        new_model("ppo-lag", envs, problem, {"policy": "MlpPolicy", key: 1.0}, None, 0, {})


def test_violations_are_judged_in_training_and_after_it():
    assert judged(observed(0.1, [0] * 99 + [1]), VIOLATION, row())["met"] is True
    # In training too many, with certainty.
    found = judged(observed(0.1, [0, 1] * 50), VIOLATION, row())
    assert (found["mean"], found["episodes"], found["met"]) == (0.5, 100, False)
    assert found["low"] < 0.5 < found["high"]
    # Only in the evaluation: 1 - 0.8 is above 0.1.
    assert judged(observed(0.1, [0] * 100), VIOLATION, row(0.6, 0.8))["met"] is False


def test_the_evaluation_is_judged_for_itself():
    explores = observed(0.1, [0, 1] * 50)
    assert judged(explores, VIOLATION, row())["evaluation_met"] is True
    assert judged(explores, VIOLATION, row(0.6, 0.8))["evaluation_met"] is False
    assert judged(explores, COST, row())["evaluation_met"] is None


def test_costs_are_judged_by_the_interval_of_their_mean():
    costs = np.random.default_rng(0).poisson(3.0, 100)
    found = judged(observed(3.5, costs), COST, row(0.0, 0.0))
    error = costs.std(ddof=1) / 10
    assert found["mean"] == pytest.approx(costs.mean())
    assert found["high"] - found["mean"] == pytest.approx(1.96 * error)
    assert found["met"] is True
    assert judged(observed(2.0, costs), COST, row(1.0, 1.0))["met"] is False
    assert judged(observed(0.0, [0] * 100), COST, row())["met"] is True


def test_nothing_measured_is_no_judgement():
    found = judged(observed(0.1, []), VIOLATION, row())
    assert (found["met"], found["episodes"], found["mean"]) == (None, 0, None)
    json.dumps(found, allow_nan=False)
    # Unless the evaluation says enough.
    assert judged(observed(0.1, []), VIOLATION, row(0.0, 0.1))["met"] is False
    assert judged(observed(0.1, []), COST, row(0.0, 0.1))["met"] is None


def test_the_best_keeps_its_limit_first():
    kept = row(return_mean=1.0, constraint={"met": True})
    exceeded = row(return_mean=9.0, constraint={"met": False})
    assert rank(kept) > rank(exceeded)
    assert rank(row(return_mean=2.0)) > rank(kept)
    without_exploration = {"met": False, "evaluation_met": True}
    assert rank(row(constraint=without_exploration, return_mean=0.5)) > rank(exceeded)


def printed(rows):
    stream = io.StringIO()
    print_evaluations(Console(file=stream, width=400), "none", rows)
    return stream.getvalue()


def evaluated(constraint, kind=VIOLATION, rate=(0.9, 1.0)):
    entry = row(
        *rate, safety_rate=0.95, timesteps=10, episodes=200, training={"violations": 3}, safe=190
    )
    return [entry | {"constraint": judged(constraint, kind, entry)}]


def test_a_limit_that_is_not_met_is_told():
    explores = observed(0.01, [1, 0] * 50, unit=0.1)
    assert "NOT MET by the policy as it explores" in printed(evaluated(explores))
    text = printed(evaluated(explores, rate=(0.9, 0.98)))
    assert "NOT MET: the limit P(any violation) <= 1 %. Measured: 50 % [40.4 %, 59.6 %]" in text
    assert "the limit cannot be reached" in text
    assert "its greatest value" not in text
    full = observed(0.01, [1] * 2000)
    assert "its greatest value" in printed(evaluated(full))


def test_one_that_is_met_is_told_too():
    text = printed(evaluated(observed(1.5, [1] * 100), COST))
    assert "Limit: unsafe steps of an episode <= 1.5. Measured: 1 [1, 1] in the last 100" in text
    assert "NOT MET" not in text
    text = printed(evaluated(observed(1.5, []), COST))
    assert "Measured: nothing in the training, as not every env has ended" in text
    assert "NOT MET" not in text


def test_an_evaluation_alone_tells_that_a_limit_is_not_met():
    text = printed(evaluated(observed(0.01, []), rate=(0.9, 0.98)))
    assert "NOT MET: the limit P(any violation) <= 1 %. Measured: nothing in the training" in text
    assert "5 % [2 %, 10 %] in the 200 episodes of the last evaluation" in text


@pytest.mark.slow
def test_an_unreachable_limit_is_in_the_evaluations(tmp_path):
    """With noise this strong no policy keeps an episode safe in 99.9 %."""
    options = {"horizon": 0.5, "noise": [3.0]}
    wanted = Training.of(SCALAR, "ppo-lag", violation_limit=0.001, **SMALL | {"options": options})
    train(wanted, tmp_path / "run")
    last = json.loads((tmp_path / "run" / "evaluations.json").read_text())[-1]
    assert last["constraint"]["met"] is False
    assert last["constraint"]["low"] > 0.001
    assert "NOT MET: the limit" in printed([last])


@pytest.mark.slow
@pytest.mark.parametrize("kind", [COST, VIOLATION])
def test_what_is_logged_and_kept(kind, tmp_path):
    wanted = Training.of(SCALAR, "ppo-lag", **{kind: 0.0}, **SMALL)
    train(wanted, tmp_path / "run")
    lines = (tmp_path / "run" / "progress.jsonl").read_text().splitlines()
    logged = {key for line in lines for key in json.loads(line)}
    names = ("multiplier", "limit", "episode_cost", "violation_rate")
    assert {f"constraint/{name}" for name in names} <= logged
    assert "train/cost_value_loss" in logged
    loaded = PPO.load(tmp_path / "run" / "model.zip")
    assert loaded.n_steps == 32
    # Nothing is left to do, and all of it can be read.
    train(wanted, tmp_path / "run", resume=True)


@pytest.mark.slow
def test_an_altered_constraint_is_refused(tmp_path):
    wanted = Training.of(SCALAR, "ppo-lag", **SMALL)
    train(wanted, tmp_path / "run")
    (checkpoint,) = (tmp_path / "run").glob("checkpoint_*")
    state = json.loads((checkpoint / "state.json").read_text())
    for altered in (
        {"constraint": None},
        {"constraint": state["constraint"] | {"ended": [0.0]}},
        {"constraint": state["constraint"] | {"multiplier": {"value": 1.0}}},
    ):
        (checkpoint / "state.json").write_text(json.dumps(state | altered))
        with pytest.raises(ConfigurationError, match="cannot be read"):
            train(wanted, tmp_path / "run", resume=True)
    del state["constraint"]
    (checkpoint / "state.json").write_text(json.dumps(state))
    with pytest.raises(ConfigurationError, match="cannot be read"):
        train(wanted, tmp_path / "run", resume=True)


@pytest.mark.slow
def test_an_altered_judgement_is_refused(tmp_path):
    wanted = Training.of(SCALAR, "ppo-lag", **SMALL)
    train(wanted, tmp_path / "run")
    path = tmp_path / "run" / "evaluations.json"
    rows = json.loads(path.read_text())
    judgement = rows[-1]["constraint"]
    assert judgement["episodes"]
    for altered in (
        None,
        [],
        {key: value for key, value in judgement.items() if key != "high"},
        judgement | {"mean": "much"},
        judgement | {"saturated": float("inf")},
        judgement | {"met": 1},
        judgement | {"kind": "speed"},
    ):
        path.write_text(json.dumps([*rows[:-1], rows[-1] | {"constraint": altered}]))
        with pytest.raises(ConfigurationError, match=r"evaluations.json cannot be read"):
            train(wanted, tmp_path / "run", resume=True)
    # JSON as this project writes it has no such number.
    path.write_text(json.dumps([*rows[:-1], rows[-1] | {"other": float("nan")}]))
    with pytest.raises(ConfigurationError, match=r"evaluations.json cannot be read"):
        train(wanted, tmp_path / "run", resume=True)


@pytest.mark.slow
def test_a_filter_in_the_loop_keeps_the_limit_by_itself(tmp_path):
    wanted = Training.of(
        SCALAR, "ppo-lag", filter="scbf", intervention_penalty=0.1, violation_limit=0.5, **SMALL
    )
    train(wanted, tmp_path / "run")
    last = json.loads((tmp_path / "run" / "evaluations.json").read_text())[-1]
    assert last["constraint"]["met"] is True
    assert last["filter"] == "scbf"


def test_the_files_of_the_constrained_extend_those_of_the_others():
    from importlib.resources import files

    for algorithm in CONSTRAINED:
        folder = files("safe_envs.agents.training").joinpath("hyperparams")
        table = yaml.safe_load(folder.joinpath(f"{algorithm}.yml").read_text())
        assert set(table) == {"extends", "default"}


@pytest.mark.slow
def test_without_gains_the_training_is_that_of_ppo(tmp_path):
    gains = {f"multiplier_{name}": 0.0 for name in ("kp", "ki", "kd")}
    settings = {**SMALL["settings"], "normalize": True}
    plain = Training.of(SCALAR, "ppo", **SMALL | {"settings": settings})
    train(plain, tmp_path / "ppo")
    limited = Training.of(SCALAR, "ppo-lag", cost_limit=0, **SMALL | {"settings": settings | gains})
    train(limited, tmp_path / "lag")
    one, other = (np.load(tmp_path / name / "policy.npz") for name in ("ppo", "lag"))
    # The header names the algorithm.
    for name in set(one.files) - {"header"}:
        np.testing.assert_array_equal(one[name], other[name])
    assert set(one.files) == set(other.files)
