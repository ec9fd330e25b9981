"""Trainings with a limit: one of zero, kept or beyond reach, and going on with one."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors.numpy import load_file

from safe_envs.agents import evaluate
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train
from tests.agents.training.test_checkpoints import outcome, stopped

pytestmark = pytest.mark.slow

SCALAR = "safe_envs/Scalar-v0"
SAC = {"learning_starts": 16, "batch_size": 16, "train_freq": 4, "gradient_steps": 1}
PPO = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
SMALL = {
    "num_envs": 2,
    "n_timesteps": 160,
    "eval_freq": 32,
    "eval_episodes": 40,
    "options": {"horizon": 0.1, "noise": 3.0, "start": [0.9]},
}
BOTH = pytest.mark.parametrize("algorithm", ["ppo-lag", "sac-lag"])


def training(algorithm, changes=None, **arguments):
    known = {**(PPO if algorithm == "ppo-lag" else SAC), "policy_kwargs": {"net_arch": [8]}}
    return Training.of(
        SCALAR, algorithm, settings=known | (changes or {}), **{**SMALL, **arguments}
    )


def evaluations(folder):
    return json.loads((folder / "evaluations.json").read_text())


@BOTH
@pytest.mark.parametrize("kind", ["cost_limit", "violation_limit"])
def test_a_limit_of_zero_gives_finite_numbers_and_is_judged(algorithm, kind, tmp_path):
    # Without costs, and with costs that no policy avoids: the noise of a step is larger than the
    # safe set.
    for name, start, noise in (("safe", [0.0], 0.0), ("unsafe", [0.9], 3.0)):
        folder = tmp_path / name
        options = {"horizon": 0.1, "start": start, "noise": noise}
        train(training(algorithm, **{kind: 0.0, "options": options}), folder)
        lines = (folder / "progress.jsonl").read_text()
        assert "constraint/multiplier" in lines
        assert "NaN" not in lines
        judgement = evaluations(folder)[-1]["constraint"]
        assert (judgement["kind"], judgement["met"]) == (kind, name == "safe")
        assert judgement["episodes"] > 10
        for key in ("low", "multiplier"):
            assert (judgement[key] > judgement["limit"] == 0.0) is (name == "unsafe")
        (checkpoint,) = folder.glob("checkpoint_*")
        for array in load_file(checkpoint / "learner.safetensors").values():
            assert np.isfinite(array).all()


@pytest.mark.parametrize(
    ("changes", "arguments"),
    [
        ({"normalize": True}, {"filter": "scbf", "action": "both"}),
        ({"buffer_size": 40}, {"filter": "scbf", "violation_limit": 0.1}),
        (
            {
                "optimize_memory_usage": True,
                "replay_buffer_kwargs": {"handle_timeout_termination": False},
                "cost_gamma": 0.9,
                "multiplier_kd": 0.3,
            },
            {"cost_limit": 0.5},
        ),
    ],
    ids=["both-actions", "full-buffer", "small-memory"],
)
def test_a_stopped_training_of_sac_lag_ends_as_one_that_was_not(changes, arguments, tmp_path):
    wanted = training("sac-lag", changes, **arguments)
    train(wanted, tmp_path / "whole")
    checkpoint = stopped(wanted, tmp_path / "run")
    arrays = load_file(checkpoint / "replay_buffer.safetensors")
    assert arrays["costs"].any()
    assert any(
        name.startswith("cost_critic_target/")
        for name in load_file(checkpoint / "learner.safetensors")
    )
    train(wanted, tmp_path / "run", resume=True)
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")
    last = evaluations(tmp_path / "run")[-1]["constraint"]
    assert last["multiplier"] > 0.0


@BOTH
def test_the_policy_is_kept_as_data_and_evaluated(algorithm, tmp_path):
    train(training(algorithm), tmp_path / "run")
    (row,) = evaluate(SCALAR, str(tmp_path / "run"), ["none"], episodes=20, seed=1).rows
    assert 0.0 <= row.safety_rate <= 1.0
