"""Policies in compiled programs: the inputs that the envs execute for what `predict` returns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs.agents.policies.custom import as_policy
from safe_envs.agents.policies.nominal import NominalController, RandomPolicy, ZeroController
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.compiled import slots
from safe_envs.compiled.data import Data
from safe_envs.compiled.draws import POLICY
from safe_envs.compiled.program import Program
from safe_envs.envs.spaces import BatchActions
from safe_envs.errors import NotCompilableError
from tests.conftest import problem_of

DUBINS = "safe_envs/StochasticDubins-v0"
COUNT = 30


def inputs_of(policy, problem, observations, key=(0, 0)):
    """What `act` returns at one observation a period, in plain Python."""
    data = Data()
    source = policy_source(policy, problem, data)
    act = Program("a policy", [slots.act], source).plain()["act"]
    numbers, work = data.array(), np.full(source.work, np.nan)
    return np.array(
        [act(tuple(o), k, *key, numbers, work) for k, o in enumerate(observations.tolist())]
    )


def executed(problem, actions):
    """The inputs that a vector env executes."""
    return np.stack(BatchActions(problem, len(actions)).physical(actions), axis=-1)


def predicted(policy, observations):
    """Actions at one observation at a time: NumPy rounds the functions of arrays differently."""
    return np.array([policy.predict(o)[0] for o in observations])


def observations_of(problem, count=COUNT):
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    return np.random.default_rng(0).uniform(1.2 * low, 1.2 * high, (count, len(low))).astype("f4")


@pytest.mark.parametrize("kind", [NominalController, ZeroController])
def test_inputs_are_those_that_envs_execute(env_id, kind):
    problem = problem_of(env_id)
    policy, seen = kind(problem), observations_of(problem)
    found = inputs_of(policy, problem, seen)
    np.testing.assert_array_equal(found, executed(problem, predicted(policy, seen)))
    assert np.isfinite(found).all()


@pytest.mark.parametrize("key", [(7, 0), (2**64 - 1, 2**63 + 5)])
def test_random_actions_are_the_words_of_a_stream(env_id, key):
    problem = problem_of(env_id)
    seen, m = observations_of(problem), len(problem.inputs)
    stream = np.random.Generator(
        np.random.Philox(key=np.array(key, dtype=np.uint64), counter=[0, 0, POLICY, 0])
    )
    actions = 2.0 * stream.random((COUNT, m)) - 1.0
    found = inputs_of(RandomPolicy(problem), problem, seen, key)
    np.testing.assert_array_equal(found, executed(problem, actions))
    assert len(np.unique(found)) == COUNT * m


def test_nan_stays_nan():
    problem = problem_of(DUBINS)
    seen = np.full((1, len(problem.features)), math.nan)
    assert np.isnan(inputs_of(NominalController(problem), problem, seen)).all()


@pytest.mark.parametrize("given", [lambda rows: rows[:, 0], "predict"])
def test_policies_from_outside_are_refused(given):
    class Outside:
        def predict(self, *_):
            raise NotImplementedError

    problem = problem_of(DUBINS)
    policy = as_policy(Outside() if given == "predict" else given, problem)
    with pytest.raises(NotCompilableError, match="only the NumPy engine can call it"):
        policy_source(policy, problem, Data())
