"""Measured rates of temporal specifications."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.satisfaction import measure_satisfaction
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers import SafetyFilterVectorWrapper
from tests.conftest import problem_of

ENV_ID = "safe_envs/DubinsReach-v0"


def measured(text: str, num_envs: int, episodes: int = 60, condition: str = "hocbf"):
    env = SafeVectorEnv(problem_of(ENV_ID), num_envs)
    filtered = SafetyFilterVectorWrapper(env, condition)
    return measure_satisfaction(filtered, NominalController(env.problem), text, episodes, seed=4)


def test_always_safe_is_what_evaluate_measures() -> None:
    found = measured("always safe", 60)
    (kept,) = evaluate(ENV_ID, filters=["hocbf"], episodes=60, seed=4).episodes["hocbf"]
    safe = kept.first_violation < 0
    assert 0.3 < safe.mean() < 0.9
    np.testing.assert_array_equal(found.satisfied, safe)
    np.testing.assert_allclose(found.robustness, kept.min_h, rtol=1e-9)
    assert found.rate == safe.mean()
    low, high = found.interval()
    assert low < found.rate < high


def test_rates_do_not_depend_on_the_size_of_the_batch() -> None:
    text = "always safe & eventually goal"
    one, other = measured(text, 60), measured(text, 25)
    np.testing.assert_array_equal(one.satisfied, other.satisfied)
    np.testing.assert_allclose(one.robustness, other.robustness, rtol=1e-9)


def test_reaching_before_a_violation_is_rarer_than_both() -> None:
    both = measured("always safe & eventually goal", 60)
    safe, goal = measured("always safe", 60), measured("eventually goal", 60)
    np.testing.assert_array_equal(both.satisfied, safe.satisfied & goal.satisfied)
    before = measured("safe until (goal & safe)", 60)  # the goal ends the episode
    np.testing.assert_array_equal(before.satisfied, both.satisfied)
    assert both.rate < min(safe.rate, goal.rate) or both.rate == safe.rate < goal.rate


def test_mistakes_are_refused() -> None:
    problem = problem_of(ENV_ID)
    policy = NominalController(problem)
    with pytest.raises(ConfigurationError, match="episodes = 0"):
        measure_satisfaction(SafeVectorEnv(problem, 2), policy, "always safe", 0)
    with pytest.raises(ConfigurationError, match="NEXT_STEP"):
        measure_satisfaction(SafeVectorEnv(problem, 2, "SameStep"), policy, "always safe", 2)
