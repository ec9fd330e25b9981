"""The policy that follows a table: what it reads, and which control period it is in."""

from __future__ import annotations

from dataclasses import replace

import cloudpickle
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SafeVectorEnv
from safe_envs.agents import evaluate, make_policy
from safe_envs.agents.policies import best
from safe_envs.agents.policies.base import ObservedState
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.errors import InvalidInputError, NotCompilableError
from safe_envs.problem.problem import Barrier
from safe_envs.problem.signals import TIME
from safe_envs.registry import make_problem
from safe_envs.values.tables import ValueSettings
from safe_envs.wrappers import FilterSpec
from tests.agents.policies.coarse import COARSE, SHORT
from tests.conftest import EVERY_ENV

DISK = "StochasticDubins-v0"


class Asked:
    """A table's look-ahead that notes what it is asked for."""

    steps = 5

    def __init__(self, table=None, problem=None):
        self.instants, self.states = [], []

    def best_input(self, k, x):
        self.instants.append(k.tolist())
        self.states.append(x)
        return np.full((len(k), 1), 0.5), np.zeros(len(k))


@pytest.fixture
def asked(monkeypatch):
    """Replaces tables."""
    monkeypatch.setattr(best, "table_for", lambda *given: None)
    monkeypatch.setattr(best, "LookAhead", Asked)


@pytest.mark.parametrize("env_id", [*EVERY_ENV, "safe_envs/DubinsObstacle-v0"])
def test_states_are_read_off_observations(env_id):
    problem = make_problem(env_id)
    env = SafeVectorEnv(problem, 16)
    env.action_space.seed(3)
    observation, _ = env.reset(seed=3)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
    # The phases of moving obstacles and the trim of a quadrotor are known without observing them.
    needed = [s for s in problem.plant.states if not s.name.startswith("phase")]
    found = ObservedState(problem, needed)(observation.astype(float))
    for s, value, true in zip(problem.plant.states, found, env.components, strict=True):
        if s in needed:
            turns = np.round((true - value) / (2 * np.pi)) * np.isinf(_reach(problem, s))
            value = value + 2 * np.pi * turns
            np.testing.assert_allclose(value, true, rtol=2e-6, atol=2e-6, err_msg=s.name)


def _reach(problem, symbol):
    return next(state.high for state in problem.states if state.symbol == symbol)


def test_what_observations_do_not_hold_is_named():
    problem = make_problem(DISK)
    x, y, theta = problem.plant.states
    problem = replace(problem, features=problem.features[:-1], nominal=(sp.Integer(0),))
    assert ObservedState(problem, [x, y])
    with pytest.raises(ConfigurationError, match=r"does not determine theta, .* the cosine and"):
        ObservedState(problem, [x, theta])


def test_an_angle_that_counts_turns_is_not_read_off_its_cosine_and_sine():
    problem = make_problem(DISK)
    theta = problem.plant.states[2]
    h = problem.barriers[0].expression
    counting, periodic = (
        replace(problem, barriers=(Barrier(h + more),))
        for more in (theta / 100, sp.cos(2 * theta) / 100)
    )
    with pytest.raises(ConfigurationError, match="does not determine theta"):
        ObservedState(counting, [theta])
    assert ObservedState(periodic, [theta])


def test_it_counts_the_periods_of_each_episode(asked):
    policy = BestPolicy(make_problem(DISK))
    observation = np.tile([0.1, 0.2, 0.6, 0.8], (3, 1))
    state, start, actions = None, np.ones(3, dtype=bool), np.empty(0)
    for _ in range(7):
        actions, state = policy.predict(observation, state, start)
        start = np.zeros(3, dtype=bool)
        start[1] = len(policy.look_ahead.instants) == 3  # pyright: ignore[reportAttributeAccessIssue]
    instants = np.array(policy.look_ahead.instants)  # pyright: ignore[reportAttributeAccessIssue]
    # After the last instant of the table it stays there.
    assert instants[:, 0].tolist() == instants[:, 2].tolist() == [0, 1, 2, 3, 4, 4, 4]
    assert instants[:, 1].tolist() == [0, 1, 2, 0, 1, 2, 3]
    assert actions.shape == (3, 1)
    x = policy.look_ahead.states[0]  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose([c[0] for c in x], [0.1, 0.2, np.arctan2(0.8, 0.6)])


def test_one_observation_is_a_batch_of_one(asked):
    policy = make_policy("best", make_problem(DISK))
    one, state = policy.predict(np.array([0.1, 0.2, 0.6, 0.8]))
    again, state = policy.predict(np.array([0.1, 0.2, 0.6, 0.8]), state)
    assert one.shape == again.shape == (1,)
    assert policy.look_ahead.instants == [[0], [1]]
    with pytest.raises(InvalidInputError, match="the policy takes"):
        policy.predict(np.zeros(3))


def test_a_state_that_is_known_in_advance_needs_no_feature(asked):
    problem = make_problem("DubinsObstacle-v0", substeps=2)
    problem = replace(problem, features=problem.features[:4], nominal=(sp.Integer(0),))
    policy = BestPolicy(problem)
    observation = np.array([[0.0, 1.0, 1.0, 0.0]])
    _, state = policy.predict(observation)
    policy.predict(observation, state)
    env = SafeVectorEnv(problem, 1)
    env.reset(seed=0)
    for x in policy.look_ahead.states:  # pyright: ignore[reportAttributeAccessIssue]
        np.testing.assert_allclose(x[3:], env.components[3:], rtol=1e-12)
        env.step(np.zeros((1, 1)))


def test_processes_get_it_without_its_table():
    problem = make_problem("Scalar-v0", **SHORT)
    policy = BestPolicy(problem, COARSE)
    observation = np.array([[0.2], [0.9]])
    expected, _ = policy.predict(observation)
    sent = cloudpickle.dumps(policy)
    assert len(sent) < policy.table.memory / 2
    np.testing.assert_array_equal(cloudpickle.loads(sent).predict(observation)[0], expected)


def test_it_is_safer_than_others():
    problem = make_problem("Scalar-v0", **SHORT, noise=1.0, start=[0.7])
    given = {"filters": "none", "episodes": 400, "bounds": False, "best": False}
    rates = [
        evaluate(problem, policy, **given).rows[0].safety_rate
        for policy in (BestPolicy(problem, COARSE), "nominal", "zero")
    ]
    assert rates[0] > max(rates[1:]) + 0.05


def test_only_numpy_can_simulate_it(asked):
    problem = make_problem("Scalar-v0", **SHORT)
    with pytest.raises(NotCompilableError, match="BestPolicy has no compiled form"):
        evaluate(problem, BestPolicy(problem), "none", engine="compiled", best=False)
    found = evaluate(problem, BestPolicy(problem), "none", episodes=4, best=False)
    assert found.timing.rows[0].engine == "numpy"


def test_a_third_party_env_has_no_table():
    problem = make_problem("Scalar-v0")
    spaces = SafeVectorEnv(problem, 1).single_observation_space, None
    with pytest.raises(ConfigurationError, match="only a model is known"):
        make_policy("best", problem, spaces=spaces, filter_spec=FilterSpec.__new__(FilterSpec))  # pyright: ignore[reportArgumentType]


def test_a_goal_may_depend_on_the_time():
    problem = make_problem("safe_envs/Scalar-v0", horizon=0.05)
    x = problem.plant.states[0]
    timed = replace(problem, goal=TIME - 0.04 + 0 * x)
    settings = ValueSettings(knowledge="plant", cells=(20,))
    action, _ = BestPolicy(timed, settings).predict(np.zeros(1))
    assert -1.0 <= action.item() <= 1.0
