"""Training with a sensor: agents and filters act at an estimate of the state."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train
from safe_envs.agents.training.vec_env import make_sb3_env
from safe_envs.registry import make_problem

DUBINS = "safe_envs/StochasticDubins-v0"
LATE = ["default", "delay=2"]


def training(**changes):
    given = {
        "filter": "scbf:belief=0.05",
        "n_timesteps": 768,
        "eval_freq": 256,
        "num_envs": 4,
        "eval_episodes": 8,
        "options": {"horizon": 0.5, "measurement": LATE},
        "estimator": "ekf",
    }
    return Training.of(DUBINS, "ppo", **{**given, **changes})


def test_the_envs_of_sb3_show_features_at_the_estimate():
    env = make_sb3_env(DUBINS, 3, "scbf", measurement="default", estimator="ekf", seed=0)
    features = make_problem(DUBINS).features
    observation = env.reset()
    assert observation.shape == (3, len(features))
    for _ in range(5):
        observation, _, _, infos = env.step(np.zeros((3, 1), dtype=np.float32))
    for seen, info in zip(observation, infos, strict=True):
        x, y, theta = info["estimate"]
        np.testing.assert_allclose(seen, [x, y, np.cos(theta), np.sin(theta)], rtol=1e-5)
        assert not np.allclose(info["estimate"], info["state"])
        assert info["nees_dof"] == 3


def test_the_envs_of_sb3_show_measurements_where_they_are_asked_for():
    given = {"measurement": "default", "estimator": "ekf", "seed": 0}
    env = make_sb3_env(DUBINS, 3, "scbf", observe="measurement", **given)
    assert env.reset().shape == (3, 3)


def test_an_estimator_needs_a_sensor():
    with pytest.raises(ConfigurationError, match="measurement='default'"):
        make_sb3_env(DUBINS, 2, "scbf", estimator="ekf")


@pytest.mark.slow
def test_a_training_at_estimates_goes_on_as_if_it_had_not_been_interrupted(tmp_path):
    whole, interrupted = tmp_path / "whole", tmp_path / "interrupted"
    train(training(), whole)

    def stop(part):
        if part > 0.8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(training(), interrupted, progress=stop)
    train(training(), interrupted, resume=True)
    rows = json.loads((whole / "evaluations.json").read_text())
    assert rows == json.loads((interrupted / "evaluations.json").read_text())
    assert (whole / "policy.npz").read_bytes() == (interrupted / "policy.npz").read_bytes()
    assert {row["filter"] for row in rows} == {"scbf:belief=0.05"}
    # The same policy acts at estimates elsewhere, and at true states.
    found = evaluate(
        DUBINS,
        str(whole),
        ["scbf"],
        options={"measurement": "default", "horizon": 0.5},
        estimator="ukf",
        episodes=4,
        bounds=False,
    )
    assert [row.filter for row in found.rows] == ["scbf@state", "scbf", "scbf:belief=0.05"]
