"""The vehicle that is to reach a goal before a moving obstacle hits it."""

from __future__ import annotations

import numpy as np

from safe_envs.agents import NominalController
from safe_envs.envs.vector_env import SafeVectorEnv
from tests.conftest import problem_of

ENV_ID = "safe_envs/DubinsReach-v0"
MANY = 4000


def test_obstacle_is_known_in_advance_and_the_noises_are_equal() -> None:
    env = SafeVectorEnv(problem_of(ENV_ID, start="fixed"), MANY, "Disabled")
    env.reset(seed=1)
    env.step(np.zeros((MANY, 1)))
    found = env.state
    np.testing.assert_allclose(found[:, 2:], np.tile([0.4, 0.0, -1.06], (MANY, 1)), atol=1e-15)
    moved = found[:, :2] - [-1.5 + 0.2 * np.cos(0.4), -1.0 + 0.2 * np.sin(0.4)]
    scale = 0.2 * np.sqrt(0.2)
    np.testing.assert_allclose(moved.mean(axis=0) / scale, 0.0, atol=4 / np.sqrt(MANY))
    np.testing.assert_allclose(np.cov(moved.T) / scale**2, np.eye(2), atol=6 / np.sqrt(MANY))


def test_nominal_controller_arrives_and_is_hit_on_its_way() -> None:
    env = SafeVectorEnv(problem_of(ENV_ID), 200, "Disabled")
    policy = NominalController(env.problem)
    observation, _ = env.reset(seed=0)
    arrived, hit, ended = (np.zeros(200, dtype=bool) for _ in range(3))
    for _ in range(env.problem.steps):
        observation, _, terminated, _, info = env.step(policy.predict(observation)[0])
        hit |= info["violation"] & ~ended
        at = np.hypot(env.state[:, 0] - 1.4, env.state[:, 1] - 1.0)
        arrived |= (at <= 0.3) & ~ended
        ended |= terminated
        env.episodes.ended[:] = False
        if ended.all():
            break
    assert arrived.mean() > 0.97
    assert hit.mean() > 0.7


def test_passing_behind_the_obstacle_is_possible_in_time() -> None:
    problem = problem_of(ENV_ID, noise=0.0, start="fixed")
    env = SafeVectorEnv(problem, 1, "Disabled")
    env.reset(seed=0)
    terminated, lowest = np.array([False]), np.inf
    for _ in range(problem.steps):
        px, py, heading = env.state[0, :3]
        goal = np.array([0.3, -1.1]) if px < 0.1 else np.array([1.4, 1.0])
        course = np.arctan2(goal[1] - py, goal[0] - px) - heading
        rate = 5.0 * np.arctan2(np.sin(course), np.cos(course))
        _, _, terminated, _, info = env.step(np.clip([[rate / 3.0]], -1.0, 1.0))
        lowest = min(lowest, float(info["barrier"][0, 0]))
        if terminated[0]:
            break
    assert terminated[0]
    assert np.hypot(*(env.state[0, :2] - [1.4, 1.0])) <= 0.3
    assert lowest > 0.0
