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

PROBLEM = problem_of("safe_envs/DubinsReach-v0")


def measured(text: str, num_envs: int = 60):
    env = SafetyFilterVectorWrapper(SafeVectorEnv(PROBLEM, num_envs), "hocbf")
    return measure_satisfaction(env, NominalController(PROBLEM), text, 60, seed=4)


def test_rates_are_those_of_evaluate_and_of_all_parts_in_batches_of_any_size() -> None:
    safe, goal = measured("always safe"), measured("eventually goal")
    (kept,) = evaluate(PROBLEM, filters="hocbf", episodes=60, seed=4, bounds=False).episodes[
        "hocbf"
    ]
    np.testing.assert_array_equal(safe.satisfied, kept.first_violation < 0)
    np.testing.assert_allclose(safe.robustness, kept.min_h, rtol=1e-9)
    assert 0.3 < safe.rate == safe.satisfied.mean() < 0.9
    low, high = safe.interval()
    assert low < safe.rate < high
    both, other = (measured("always safe & eventually goal", n) for n in (60, 25))
    np.testing.assert_array_equal(both.satisfied, safe.satisfied & goal.satisfied)
    np.testing.assert_array_equal(both.satisfied, other.satisfied)
    np.testing.assert_allclose(both.robustness, other.robustness, rtol=1e-9)
    # The goal ends the episode.
    before = measured("safe until (goal & safe)")
    np.testing.assert_array_equal(before.satisfied, both.satisfied)


def test_mistakes_are_refused() -> None:
    policy = NominalController(PROBLEM)
    for envs, episodes, fragment in (
        (SafeVectorEnv(PROBLEM, 2), 0, "episodes = 0"),
        (SafeVectorEnv(PROBLEM, 2, "SameStep"), 2, "NEXT_STEP"),
    ):
        with pytest.raises(ConfigurationError, match=fragment):
            measure_satisfaction(envs, policy, "always safe", episodes)
