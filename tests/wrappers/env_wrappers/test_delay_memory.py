"""Wrappers whose filter predicts over the delay of an env, or over another one."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import SafeEnv, SafeVectorEnv
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.engine.program import Program
from safe_envs.errors import ConfigurationError, NotCompilableError
from safe_envs.filters.conditions import parse_conditions
from safe_envs.proofs.posterior import guarantee_of
from safe_envs.values.reduction import reduced
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of

PENDULUM = "safe_envs/Pendulum-v0"


def run(problem, actions, condition="hocbf", **arguments):
    env = SafetyFilterWrapper(SafeEnv(problem), condition, **arguments)
    env.reset(seed=0)
    states, sent = [env.unwrapped.state], []
    for action in actions:
        *_, info = env.step(action)
        states.append(env.unwrapped.state)
        sent.append(info["safe_action"])
        np.testing.assert_array_equal(info.get("sent_action", sent[-1]), sent[-1])
    return np.array(states), np.array(sent), info["h_min"]


@pytest.mark.parametrize("delay", [1, 3])
def test_without_noise_the_delay_is_made_up_for_to_the_last_bit(delay):
    problem = problem_of(PENDULUM, noise=0.0, start=[0.1, 0.1])
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (150, 1))
    resting = SafeEnv(problem)
    resting.reset()
    for _ in range(delay):
        resting.step([0.0])
    late, sent, lowest = run(problem.configured(delay=delay), actions)
    prompt, decided, _ = run(problem.configured(start=resting.state.tolist()), actions)
    np.testing.assert_array_equal(late[delay:], prompt[:-delay])
    np.testing.assert_array_equal(sent, decided)
    assert lowest > 0.0


def test_a_filter_may_believe_another_delay():
    problem = problem_of(PENDULUM, noise=0.0, start=[0.1, 0.1], delay=3)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 1))
    aware, unaware = run(problem, actions)[1], run(problem, actions, delay=0)[1]
    assert not np.array_equal(aware, unaware)
    of_model = problem.configured(model_delay=0)
    np.testing.assert_array_equal(run(of_model, actions)[1], unaware)
    np.testing.assert_array_equal(run(of_model, actions, knowledge="plant")[1], aware)
    np.testing.assert_array_equal(run(of_model, actions, delay=3)[1], aware)
    # Believed alone, it is the filter that is late for nothing.
    undelayed = problem.configured(delay=0, model_delay=2)
    states = run(undelayed, actions)[0]
    assert not np.array_equal(states, run(undelayed.configured(model_delay=0), actions)[0])


@pytest.mark.parametrize("engine", ["numpy", "auto"])
def test_a_batch_is_filtered_as_its_envs_one_by_one(engine):
    problem = problem_of(PENDULUM, delay=2, model_delay=4, horizon=0.12)
    batch = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 2, engine=engine), "szcbf:alphas=2")
    ones = [SafetyFilterWrapper(SafeEnv(problem), "szcbf:alphas=2") for _ in range(2)]
    batch.reset(seed=4)
    for i, env in enumerate(ones):
        env.reset(seed=4 + i)
    rng, ended = np.random.default_rng(0), False
    for _ in range(30):
        actions = rng.uniform(-1.0, 1.0, (2, 1))
        *_, truncated, info = batch.step(actions)
        for i, env in enumerate(ones):
            if ended:
                env.reset()
                continue
            _, _, _, _, one = env.step(actions[i])
            for key in ("safe_action", "executed_action", "barrier"):
                np.testing.assert_allclose(info[key][i], one[key], rtol=1e-12, atol=1e-12)
        ended = truncated.all()


def test_a_restored_filter_goes_on_with_what_it_sent():
    problem = problem_of(PENDULUM, delay=3)
    first, second = (SafetyFilterVectorWrapper(SafeVectorEnv(problem, 2), "scbf") for _ in "ab")
    first.reset(seed=1)
    for _ in range(5):
        first.step(np.full((2, 1), 0.6))
    second.reset(seed=2)
    second.restore(first.snapshot(), seed=1)
    for _ in range(6):
        mine, other = (env.step(np.full((2, 1), -0.6))[4] for env in (first, second))
        np.testing.assert_array_equal(mine["safe_action"], other["safe_action"])


def test_a_compiled_env_leaves_the_prediction_to_numpy(monkeypatch):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    env = gym.make_vec(PENDULUM, num_envs=2, engine="compiled")
    with pytest.raises(NotCompilableError, match="predicts over a delay"):
        SafetyFilterVectorWrapper(env, "scbf", delay=1)
    wrapped = SafetyFilterVectorWrapper(
        gym.make_vec(PENDULUM, num_envs=2, engine="auto"), "scbf", delay=1
    )
    wrapped.reset(seed=0)
    assert wrapped.step(np.zeros((2, 1)))[0].shape == (2, 2)


def test_proofs_tables_and_rare_events_refuse_a_delay():
    for options in ({"delay": 1}, {"model_delay": 1}, {"slew_limit": (-1.0, 1.0)}):
        problem = problem_of(PENDULUM, **options)
        for ask in (
            lambda p: reduced(p),
            lambda p: guarantee_of(p, parse_conditions("scbf", p)),
            lambda p: SafetyFilterWrapper(SafeEnv(p), "promise:p=0.9"),
            lambda p: SafetyFilterWrapper(SafeEnv(p), "certified"),
            lambda p: SafetyFilter.for_problem(p, "certified"),
            lambda p: estimate_rare(p, filters="scbf"),
        ):
            with pytest.raises(ConfigurationError, match="are not for a delay or a slew limit"):
                ask(problem)
    with pytest.raises(ConfigurationError, match="promise filters are not for a delay"):
        SafetyFilterWrapper(SafeEnv(problem_of(PENDULUM)), "promise:p=0.9", delay=1)
    with pytest.raises(ConfigurationError, match="certificates are not for a delay"):
        SafetyFilterWrapper(SafeEnv(problem_of(PENDULUM)), "certified", delay=1)
    with pytest.raises(ConfigurationError, match="delay = -1"):
        SafetyFilterWrapper(SafeEnv(problem_of(PENDULUM)), "scbf", delay=-1)


def test_an_evaluation_says_why_there_is_no_bound_and_counts_what_is_executed():
    problem = problem_of(PENDULUM, noise=0.0, delay=2, horizon=0.02)
    found = evaluate(problem, "random", ["none", "scbf"], episodes=5)
    for row in found.rows:
        # Two periods at rest.
        assert row.effort_mean == 0.0
    assert "not for a delay" in str(found.rows[1].held_note)
    assert found.config["problem"]["actuators"] == "delay 2, model_delay 2"


def test_a_state_that_is_set_leaves_what_is_under_way_to_filter_and_env():
    problem = problem_of(PENDULUM, delay=3)
    one = SafetyFilterWrapper(SafeEnv(problem), "hocbf")
    batch = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 2), "hocbf")
    one.reset(seed=0)
    batch.reset(seed=0)
    rng = np.random.default_rng(0)
    for k in range(8):
        if k == 4:
            one.unwrapped.state = [0.3, -0.2]
            batch.unwrapped.state = [0.3, -0.2]
        action = rng.uniform(-1.0, 1.0, 1)
        one.step(action)
        batch.step(np.tile(action, (2, 1)))
        executed = np.array(one.unwrapped._actuators._line.under_way)
        np.testing.assert_array_equal(one._filter._one.under_way, executed)
        # One env and the first of a batch have the same seed.
        believed = batch._filter.snapshot()["filter_under_way"]
        inner = batch.unwrapped.snapshot()["inputs_under_way"]
        np.testing.assert_array_equal(believed, inner)
        np.testing.assert_allclose(inner[0], executed, rtol=1e-12)
    assert len(executed) == 3
