"""The gym wrappers execute what the filter decides, from what it knows alone, and count it."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError, RelativeDegreeError
from safe_envs.agents.policies.nominal import CLFController
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from safe_envs.wrappers.filter_layers import ends_of
from tests.conftest import problem_of
from tests.wrappers.cases import ACC, DUBINS, LIMITS, SCALAR

DISK = "safe_envs/DubinsDisk-v0"


def one(env_id=SCALAR, condition="scbf", *, given=None, **options):
    return SafetyFilterWrapper(gym.make(env_id, **options), condition, **(given or {}))


def many(env_id=SCALAR, condition="scbf", *, given=None, **options):
    return SafetyFilterVectorWrapper(gym.make_vec(env_id, 2, **options), condition, **(given or {}))


def test_the_executed_action_is_the_safe_one_under_the_same_noise():
    filtered, bare = one(DUBINS, "hocbf"), gym.make(DUBINS)
    total = 0
    for seed in (3, None):
        filtered.reset(seed=seed)
        bare.reset(seed=seed)
        np.testing.assert_array_equal(bare.unwrapped.state, filtered.unwrapped.state)
        interventions = 0
        for _ in range(60):
            *_, info = filtered.step(np.array([0.3], dtype=np.float32))
            bare.unwrapped.step_physical(info["safe_action"].tolist())
            np.testing.assert_array_equal(bare.unwrapped.state, filtered.unwrapped.state)
            np.testing.assert_allclose(info["nominal_action"], [3.0], rtol=1e-6)
            (safe,), (nominal,) = info["safe_action"], info["nominal_action"]
            assert info["intervention"] == (abs(safe - nominal) > 1e-7)
            assert -10.0 <= safe <= 10.0
            interventions += info["intervention"]
            assert info["episode_interventions"] == interventions
        total += interventions
    assert 0 < total < 120


@pytest.mark.parametrize("make", [one, many])
def test_the_filter_sees_the_model_and_never_the_plant(make):
    def first(knowledge="model", **options):
        options |= {"start": [0.5, 0.0, 0.4], "input_bounds": [-50.0, 50.0]}
        env = make(DISK, "hocbf:alpha=0.5,0.5", given={"knowledge": knowledge}, **options)
        env.reset(seed=2)
        return env.step(np.zeros(env.action_space.shape))[4]["safe_action"].flat[0]

    slow = {"v": 0.6}
    assert first() == first(plant=slow) != first(model=slow)
    assert first("plant") == first("plant", model=slow) != first("plant", plant=slow)
    assert first("plant", plant={"v": 0.5}) == first()


def test_what_is_reported_at_a_reset_does_not_change_what_was_executed():
    envs = many(DUBINS, horizon=0.1, autoreset_mode="SameStep")
    envs.reset(seed=0)
    for _ in range(2):
        _, _, _, truncated, info = envs.step(np.full((2, 1), 0.9, dtype=np.float32))
    assert truncated.all()
    last = info["final_info"]["safe_action"]
    assert (last != 0).all()
    np.testing.assert_array_equal(envs.unwrapped.executed[0], last[:, 0])


def test_infeasible_steps_are_counted_and_flagged():
    env = one(SCALAR, "cbf:alpha=1", start=[0.9], input_bounds=[-0.5, 0.5], noise=0.0)
    env.reset(seed=0)
    for step in range(1, 4):
        *_, info = env.step(np.ones(1, dtype=np.float32))
        assert (info["feasible"], info["episode_infeasible"]) == (False, step)
        assert info["safe_action"] == [-0.5]
        assert info["slack"] > 0
    _, info = env.reset()
    assert (info["feasible"], info["slack"]) == (True, 0.0)
    assert info["episode_infeasible"] == info["episode_interventions"] == 0


def test_an_action_that_is_the_least_violating_one_already_is_no_intervention():
    vector = many(SCALAR, "cbf:alpha=5", start=[1.9], noise=0.0, input_bounds=[-1.0, 1.0])
    vector.reset(seed=0)
    info = vector.step(np.array([[-1.0], [1.0]]))[-1]
    assert info["filter_active"].tolist() == [True, True]
    assert info["feasible"].tolist() == [False, False]
    assert info["intervention"].tolist() == [False, True]
    assert info["active_barrier"].tolist() == [-1, 0]


@pytest.mark.oracle
def test_a_wrong_speed_settles_where_theory_says():
    # A model with speed v_hat settles at h = -2 v_hat (v - v_hat)/(p_1 p_2): thesis-notes, for
    # equal rates.
    p, v, v_hat = 2.0, 0.8, 0.5
    options = {"start": "valid", "input_bounds": [-50.0, 50.0], "dt": 0.005, "horizon": 40.0}
    env = one(DISK, f"hocbf:alpha={p},{p}", **options)
    env.reset(seed=0)
    for _ in range(8000):
        *_, info = env.step(np.zeros(1, dtype=np.float32))
    assert info["barrier"][0] == pytest.approx(-2 * v_hat * (v - v_hat) / p**2, abs=2e-3)


def test_a_known_speed_keeps_the_disk_and_a_wrong_one_does_not():
    lowest = []
    for knowledge in ("plant", "model"):
        env = one(
            DISK,
            "hocbf:alpha=2,2",
            given={"knowledge": knowledge},
            start="valid",
            dt=0.01,
            horizon=20.0,
        )
        env.reset(seed=0)
        for _ in range(1000):
            *_, info = env.step(np.zeros(1, dtype=np.float32))
        lowest.append(info["h_min"])
    assert info["episode_interventions"] > 0
    assert lowest[0] > -1e-6 > lowest[1]


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
def test_other_wrappers_may_change_actions_above_and_not_below():
    rescale, batched = gym.wrappers.RescaleAction, gym.wrappers.vector.RescaleAction
    env = SafetyFilterWrapper(rescale(gym.make(SCALAR), -2.0, 2.0), "scbf")
    envs = SafetyFilterVectorWrapper(batched(gym.make_vec(SCALAR, 2), -2.0, 2.0), "scbf")
    for each in (env, envs):
        each.reset(seed=0)
        with pytest.raises(ConfigurationError, match="changed the safe action"):
            each.step(np.ones(each.action_space.shape))
    outside = rescale(one(), -2.0, 2.0)
    outside.reset(seed=0)
    np.testing.assert_allclose(outside.step(np.array([1.0]))[4]["nominal_action"], [5.0])
    counted = gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec(DUBINS, 2, horizon=0.2))
    over, under = SafetyFilterVectorWrapper(counted, "scbf"), many(DUBINS, horizon=0.2)
    over.reset(seed=0)
    under.reset(seed=0)
    for _ in range(4):
        first, second = (e.step(np.full((2, 1), 0.7, dtype=np.float32)) for e in (over, under))
        np.testing.assert_allclose(first[0], second[0], rtol=1e-6)
    assert "episode" in first[4]


def test_a_goal_of_the_filter_takes_the_place_of_the_policy():
    start = {"start": [21.0, 20.0, 37.9]}
    env = one(ACC, "cbf", given={"objective": "clf"}, **start)
    observation, _ = env.reset(seed=0)
    problem = env.unwrapped.problem
    goal, _ = CLFController(problem).predict(observation.astype(np.float64))
    for proposal in (0.7, -0.4):  # the policy has no say
        env.reset(seed=0)
        info = env.step(np.array([proposal]))[-1]
        np.testing.assert_allclose(
            info["nominal_action"], goal * problem.input_bounds[0][1], rtol=1e-4
        )
        assert info["intervention"]
        assert info["safe_action"][0] < info["nominal_action"][0] - 1.0


def test_priorities_say_which_barrier_gives_way():
    state = [0.0] * 12  # too fast towards the floor, and tilting further
    state[2], state[5], state[6], state[9] = 3.2, -6.0, 0.49, 1.0
    slacks = []
    for priorities in (None, [1.0, 1.0, 1e4]):
        env = one(LIMITS, "hocbf", given={"priorities": priorities}, start=state)
        again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
        for each in (env, again):
            each.reset(seed=0)
            info = each.step(np.zeros(4))[-1]
            assert info["slack"] == info["slacks"].max() > 0
            slacks.append(info["slacks"])
    plain, same, weighed, again = slacks
    np.testing.assert_array_equal(plain, same)
    np.testing.assert_array_equal(weighed, again)
    assert plain[2] > 1.0
    assert weighed[2] < 1e-2 * plain[2]
    assert weighed[0] > plain[0]


def test_the_action_space_knows_the_inputs_at_its_ends():
    inner = gym.make(DUBINS, input_bounds=(-3.0, 5.0))
    space = SafetyFilterWrapper(inner, "scbf").action_space
    assert space == inner.action_space
    assert inner.action_space == space
    assert repr(space) == repr(inner.action_space)
    # Whoever loads it does not need this package.
    assert b"safe_envs" not in pickle.dumps(space)
    for each in (space, pickle.loads(pickle.dumps(space)), copy.deepcopy(space)):
        assert type(each) is gym.spaces.Box
        assert [end.tolist() for end in ends_of(each)] == [[-3.0], [5.0]]
    assert ends_of(inner.action_space) is None
    envs = many(DUBINS, input_bounds=(-3.0, 5.0))
    assert envs.single_action_space.at_low.tolist() == [-3.0]
    assert envs.action_space.shape == (2, 1)


@pytest.mark.parametrize("make", [one, many])
@pytest.mark.parametrize("action", [[np.nan], [np.inf], [0.0, 0.0], [[0.0]], ["a"], None])
def test_actions_that_are_none_are_refused(make, action):
    env = make()
    env.reset(seed=0)
    with pytest.raises(InvalidInputError):
        env.step(action if make is one else [[0.0], action])


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        *(
            (lambda given=given: one(condition=given), ConfigurationError, "Condition")
            for given in (None, 3, [None], ("scbf",))
        ),
        (lambda: one(condition="scb"), ConfigurationError, "'scbf'"),
        (lambda: one(given={"knowledge": "none"}), ConfigurationError, "knowledge"),
        (lambda: one(DISK, "cbf"), RelativeDegreeError, "hocbf"),
        (lambda: one("Pendulum-v1"), ConfigurationError, "not one of this project"),
        (
            lambda: one(LIMITS, "hocbf", given={"priorities": [1.0]}),
            ConfigurationError,
            "priorities",
        ),
        (lambda: one(given={"nois": 0.1}), TypeError, "'nois'"),
        (lambda: many(given={"nois": 0.1}), ConfigurationError, "'nois'"),
    ],
)
def test_what_does_not_fit_is_explained(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()


def test_the_filter_of_a_problem_is_that_of_its_env():
    problem = problem_of(LIMITS)
    assert [b for b, _ in one(LIMITS, "hocbf").safety_filter.pairs] == list(problem.barriers)
