"""Limits of a training: which are allowed, and that it is told whether one is met."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.numpy import load_file
from stable_baselines3 import PPO

from safe_envs import ENV_IDS, ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.constraint import COST, DEFAULT_VIOLATION_LIMIT, VIOLATION
from safe_envs.agents.training.hyperparameters import CONSTRAINED, hyperparameters
from safe_envs.agents.training.trainer import train
from safe_envs.scripts.reports.sweep import print_evaluations
from tests.agents.training.small import SCALAR, evaluations, logged, training

BOTH = pytest.mark.parametrize("algorithm", CONSTRAINED)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


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
