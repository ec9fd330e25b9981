"""Wrappers of a filter over a delay, of a backup filter, and of an estimator."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import SafeEnv, SafeVectorEnv
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions import parse_conditions
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.proofs.posterior import guarantee_of
from safe_envs.values.reduction import reduced
from safe_envs.wrappers import (
    DelayedFilter,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    StateEstimatorVectorWrapper,
    StateEstimatorWrapper,
)
from tests.conftest import problem_of
from tests.wrappers.cases import CASES, DUBINS, MODES, PENDULUM, cart_problem


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


def proposals(count):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 1))


@pytest.mark.parametrize("delay", [1, 3])
def test_without_noise_the_delay_is_made_up_for_to_the_last_bit(delay):
    problem = problem_of(PENDULUM, noise=0.0, start=[0.1, 0.1])
    resting = SafeEnv(problem)
    resting.reset()
    for _ in range(delay):
        resting.step([0.0])
    late, sent, lowest = run(problem.configured(delay=delay), proposals(150))
    prompt, decided, _ = run(problem.configured(start=resting.state.tolist()), proposals(150))
    np.testing.assert_array_equal(late[delay:], prompt[:-delay])
    np.testing.assert_array_equal(sent, decided)
    assert lowest > 0.0


def test_a_filter_may_believe_another_delay():
    problem = problem_of(PENDULUM, noise=0.0, start=[0.1, 0.1], delay=3)
    actions = proposals(100)
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


def test_a_wrapped_filter_is_a_delayed_one_also_where_a_state_is_set():
    problem = problem_of(PENDULUM, delay=3)
    one = SafetyFilterWrapper(SafeEnv(problem), "hocbf")
    batch = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 2), "hocbf")
    late = DelayedFilter(
        SafetyFilter.for_problem(problem, "hocbf"), 3, problem.dt, problem.substeps
    )
    one.reset(seed=0)
    batch.reset(seed=0)
    sent, high = [0.0] * 3, problem.input_bounds[0][1]
    for k, action in enumerate(proposals(9)):
        if k == 4:
            one.unwrapped.state = [0.3, -0.2]
            batch.unwrapped.state = [0.3, -0.2]
        expected = late.filter(one.unwrapped.state, high * action).action
        *_, info = one.step(action)
        *_, infos = batch.step(np.tile(action, (2, 1)))
        # One env and the first of a batch have the same seed.
        np.testing.assert_allclose(info["safe_action"], expected, rtol=1e-12)
        np.testing.assert_allclose(infos["safe_action"][0], expected, rtol=1e-9)
        sent.append(info["safe_action"].item())
        assert info["executed_action"] == sent.pop(0)


DELAYED = [{"delay": 1}, {"model_delay": 1}, {"slew_limit": (-1.0, 1.0)}]


@pytest.mark.parametrize("options", DELAYED)
def test_proofs_tables_and_rare_events_refuse_a_delay(options):
    problem = problem_of(PENDULUM, **options)
    for ask in (
        lambda: reduced(problem),
        lambda: guarantee_of(problem, parse_conditions("scbf", problem)),
        lambda: SafetyFilterWrapper(SafeEnv(problem), "promise:p=0.9"),
        lambda: SafetyFilterWrapper(SafeEnv(problem), "certified"),
        lambda: SafetyFilter.for_problem(problem, "certified"),
        lambda: estimate_rare(problem, filters="scbf"),
    ):
        with pytest.raises(ConfigurationError, match="delay or a slew limit"):
            ask()


@pytest.mark.parametrize(
    ("text", "delay", "fragment"),
    [("promise:p=0.9", 1, "promise"), ("certified", 1, "certificates"), ("scbf", -1, "delay = -1")],
)
def test_delays_that_a_filter_cannot_believe_are_refused(text, delay, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        SafetyFilterWrapper(SafeEnv(problem_of(PENDULUM)), text, delay=delay)


def test_an_evaluation_says_why_there_is_no_bound_and_counts_what_is_executed():
    problem = problem_of(PENDULUM, noise=0.0, delay=2, horizon=0.02)
    found = evaluate(problem, "random", ["none", "scbf"], episodes=5)
    # Two periods at rest.
    assert [row.effort_mean for row in found.rows] == [0.0, 0.0]
    assert "delay" in str(found.rows[1].held_note)
    assert found.config["problem"]["actuators"] == "delay 2, model_delay 2"


# The backup filter around envs.


def batch(given="backup", mode="NextStep", **options):
    env = SafeVectorEnv(cart_problem(**options), 4, autoreset_mode=mode)
    return SafetyFilterVectorWrapper(env, given)


@pytest.mark.parametrize("mode", MODES)
def test_a_batch_is_kept_safe_through_all_resets(mode):
    env = batch(mode=mode, horizon=2.0)
    env.reset(seed=0)
    interventions = 0
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(np.ones((4, 1)))
        assert not info["violation"].any()
        assert info["feasible"].all()
        interventions += info["intervention"].sum()
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            env.reset(options={"reset_mask": ended})
    assert interventions > 0


@pytest.mark.parametrize(
    "given", ["backup:horizon=3", BackupSettings(horizon=3.0), "a filter of its own"]
)
def test_settings_and_filters_are_taken_as_well_as_text(given):
    if given == "a filter of its own":
        given = BackupFilter.for_problem(cart_problem(), "backup:horizon=3")
    env = batch(given)
    env.reset(seed=0)
    assert env.step(np.ones((4, 1)))[-1]["feasible"].all()
    assert env.safety_filter.text == "backup:horizon=3.0"


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: batch(BackupFilter.for_problem(cart_problem(dt=0.05))), "control period"),
        *(
            (
                lambda given=given: SafetyFilterVectorWrapper(
                    SafeVectorEnv(cart_problem(), 2), "backup", **given
                ),
                fragment,
            )
            for given, fragment in (
                ({"priorities": [1.0]}, "priorities"),
                ({"objective": "clf"}, "nearest"),
                ({"observe_promise": True}, "p_k"),
                ({"delay": 2}, "delay"),
            )
        ),
        (lambda: SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "backup"), "BackupLaw"),
    ],
)
def test_what_does_not_fit_is_refused(make, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make()


# State estimators over envs, and filters at their estimates.


SENSOR = {"measurement": ["default:dropout=0.2", "delay=1"], "horizon": 1.0}


def measured(env_id=PENDULUM):
    return gym.make(env_id, **SENSOR)


def test_the_truth_is_what_it_is_without_an_estimator():
    bare = gym.make(DUBINS, horizon=1.0)
    estimated = StateEstimatorWrapper(measured(DUBINS))
    _, expected = bare.reset(seed=2)
    _, info = estimated.reset(seed=2)
    for _ in range(20):
        for key in expected:
            np.testing.assert_array_equal(info[key], expected[key])
        _, reward, *ends, expected = bare.step([0.7])
        _, other, *others, info = estimated.step([0.7])
        assert (reward, ends) == (other, others)


def test_observed_estimates_have_the_space_of_the_env_without_a_sensor():
    env, raw = CASES["estimates"](), CASES["measurements"]()
    bare = gym.make(PENDULUM)
    assert env.observation_space == bare.observation_space
    seen, info = env.reset(seed=0)
    expected, _ = bare.reset(options={"state": info["estimate"]})
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
    assert raw.observation_space == raw.unwrapped.observation_space


def test_an_estimator_of_a_filter_is_one_below_it():
    above, below = (
        SafetyFilterWrapper(measured(), "scbf:belief=0.1", estimator="ukf:alpha=.5"),
        SafetyFilterWrapper(
            StateEstimatorWrapper(measured(), "ukf:alpha=.5", "measurement"),
            "scbf:belief=0.1",
        ),
    )
    for env in (above, below):
        env.reset(seed=3)
    for _ in range(5):
        (seen, *_, a), (other, *_, b) = above.step([0.5]), below.step([0.5])
        np.testing.assert_array_equal(seen, other)
        for key in ("safe_action", "estimate", "belief_barrier"):
            np.testing.assert_array_equal(a[key], b[key])


def test_the_estimator_does_not_know_of_states_that_are_set():
    env = StateEstimatorWrapper(gym.make(DUBINS, measurement="default"))
    _, info = env.reset(seed=0, options={"state": [1.0, 0.5, 0.3]})
    assert not np.allclose(info["estimate"], [1.0, 0.5, 0.3], atol=1e-6)
    env.unwrapped.state = [0.0, -1.0, 0.3]
    *_, info = env.step([0.0])
    assert info["nees"] > 20.0


def test_filters_by_themselves_act_at_estimates():
    inner = gym.make("safe_envs/DubinsDisk-v0", measurement="default", model={"v": 0.8})
    env = SafetyFilterWrapper(inner, "backup", estimator="ekf")
    env.reset(seed=0)
    *_, info = env.step([0.3])
    assert {"estimate", "feasible"} <= set(info)


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: SafetyFilterWrapper(measured(), "scbf"), "estimator="),
        (
            lambda: SafetyFilterVectorWrapper(gym.make_vec(DUBINS, 2, **SENSOR), "scbf"),
            "estimator=",
        ),
        (lambda: SafetyFilterWrapper(gym.make(DUBINS), "scbf", estimator="ekf"), "estimate"),
        (lambda: SafetyFilterWrapper(gym.make(PENDULUM), "scbf:belief=.1"), "belief"),
        (lambda: StateEstimatorWrapper(measured(), "ekf", "all"), "observe"),
        (lambda: StateEstimatorWrapper(measured(), knowledge="god"), "knowledge"),
        (lambda: StateEstimatorWrapper(gym.make(PENDULUM, delay=2, **SENSOR)), "delay"),
        (lambda: StateEstimatorVectorWrapper(measured()), "StateEstimatorWrapper"),
        (lambda: StateEstimatorWrapper(gym.make("Pendulum-v1")), "measurement"),
    ],
)
def test_what_cannot_be_is_refused(make, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make()
