"""What is kept of the first episodes is what a single env does."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.wrappers import SafetyFilterWrapper

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"


def test_the_log_of_the_first_episode_has_its_decisions():
    found = evaluate(ENV_ID, filters=["none", "hocbf"], episodes=3, record=True, bounds=False)
    log = found.trajectories["hocbf"].log
    env = SafetyFilterWrapper(gym.make(ENV_ID), "hocbf")
    problem, policy = found.problem, NominalController(found.problem)
    observation, info = env.reset(seed=episode_seed(0, 0))
    for k, row in enumerate(
        zip(*map(log.section, ("h", "nominal", "action", "slack")), strict=True)
    ):
        barrier = info["barrier"]
        state = log.section("state")[k]
        np.testing.assert_allclose(env.unwrapped.components, state, rtol=1e-9, atol=1e-12)
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        expected = (barrier, info["nominal_action"], info["safe_action"], info["slacks"])
        for values, there in zip(row, expected, strict=True):
            np.testing.assert_allclose(values, there, rtol=1e-6, atol=1e-9)
        assert log.t[k] == pytest.approx(k * problem.dt)
        assert log.intervention[k] == info["intervention"]
        assert log.feasible[k] == info["feasible"]
    assert terminated or truncated
    assert log.interventions == info["episode_interventions"] > 0
    assert log.columns.units["omega"] == "rad/s"
    np.testing.assert_array_equal(log.section("high")[:, 0], problem.box[0][1])


def test_without_a_filter_what_is_proposed_is_executed():
    found = evaluate(ENV_ID, filters=["none"], episodes=1, record=True, bounds=False)
    log = found.trajectories["none"].log
    np.testing.assert_array_equal(log.section("nominal"), log.section("action"))
    assert np.ptp(log.section("action")) > 0.0
    assert (log.interventions, log.infeasible) == (0, 0)
