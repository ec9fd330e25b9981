"""The gym wrappers: they execute what the filter decides, from the model alone, and report it by
the contract."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError, RelativeDegreeError
from safe_envs.agents.policies.nominal import CLFController
from safe_envs.wrappers import HOCBF, SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of

BASE = {
    "cost": float,
    "violation": bool,
    "barrier": np.ndarray,
    "h_min": float,
    "episode_cost": float,
}
FILTER = {
    "nominal_action": np.ndarray,
    "safe_action": np.ndarray,
    "intervention": bool,
    "filter_active": bool,
    "feasible": bool,
    "slack": float,
    "slacks": np.ndarray,
    "active_barrier": int,
    "episode_interventions": int,
    "episode_infeasible": int,
    "input_bounds": np.ndarray,
}
DTYPES = {float: np.float64, bool: np.bool_, int: np.int64, np.ndarray: np.float64}


@pytest.mark.parametrize("filtered", [False, True])
def test_info_has_every_key_with_one_type_at_reset_and_at_each_step(env_id, filtered):
    contract = {**BASE, **FILTER} if filtered else BASE
    env, vector = gym.make(env_id), gym.make_vec(env_id, num_envs=3)
    if filtered:
        natural = env.unwrapped.problem.filter
        env, vector = SafetyFilterWrapper(env, natural), SafetyFilterVectorWrapper(vector, natural)
    env.action_space.seed(0)
    vector.action_space.seed(0)
    infos = [env.reset(seed=0)[1]] + [env.step(env.action_space.sample())[4] for _ in range(5)]
    for info in infos:
        assert {key: type(value) for key, value in info.items()} == contract
        for value in info.values():
            assert np.isfinite(value).all()
    infos = [vector.reset(seed=0)[1]] + [
        vector.step(vector.action_space.sample())[4] for _ in range(5)
    ]
    count = len(env.unwrapped.problem.barriers)
    shapes = dict.fromkeys(("barrier", "slacks"), (3, count))
    shapes |= dict.fromkeys(("nominal_action", "safe_action"), vector.action_space.shape)
    shapes["input_bounds"] = (*vector.action_space.shape, 2)
    for info in infos:
        assert set(info) == set(contract) | {f"_{key}" for key in contract}
        for key, kind in contract.items():
            assert info[key].dtype == DTYPES[kind], key
            assert info[key].shape == shapes.get(key, (3,)), key
            assert info[f"_{key}"].all()


def test_executed_action_is_the_safe_one():
    filtered = SafetyFilterWrapper(gym.make("safe_envs/StochasticDubins-v0"), "hocbf")
    bare = gym.make("safe_envs/StochasticDubins-v0")
    filtered.reset(seed=3)
    bare.reset(seed=3)
    interventions = 0
    for _ in range(60):
        observation, *_, info = filtered.step(np.array([0.3], dtype=np.float32))
        replayed, *_ = bare.step(bare.unwrapped.normalized_action(info["safe_action"]))
        np.testing.assert_allclose(observation, replayed, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(info["nominal_action"], [3.0], rtol=1e-6)
        assert info["intervention"] == (
            abs(info["safe_action"][0] - info["nominal_action"][0]) > 1e-7
        )
        assert -10.0 <= info["safe_action"][0] <= 10.0
        interventions += info["intervention"]
        assert info["episode_interventions"] == interventions
    assert 0 < interventions < 60


def test_filter_sees_the_model_and_never_the_plant():
    env_id, start = "safe_envs/DubinsDisk-v0", {"start": [0.5, 0.0, 0.4], "box": [-50.0, 50.0]}

    def first(knowledge="model", **arguments):
        env = SafetyFilterWrapper(
            gym.make(env_id, **start, **arguments), "hocbf:p=0.5,0.5", knowledge
        )
        env.reset(seed=2)
        return env.step(np.zeros(1, dtype=np.float32))[4]["safe_action"][0]

    assert first() == first(plant={"v": 0.6})
    assert first() != first(model={"v": 0.6})
    assert first("plant") == first("plant", model={"v": 0.6})
    assert first("plant") != first("plant", plant={"v": 0.6})
    assert first("plant", plant={"v": 0.5}) == first("model")


def test_vector_filter_sees_the_model_and_never_the_plant():
    def first(knowledge="model", **arguments):
        env = gym.make_vec(
            "safe_envs/DubinsDisk-v0",
            num_envs=2,
            start=[0.5, 0.0, 0.4],
            box=[-50.0, 50.0],
            **arguments,
        )
        env = SafetyFilterVectorWrapper(env, HOCBF((0.5, 0.5)), knowledge)
        env.reset(seed=0)
        return env.step(np.zeros((2, 1), dtype=np.float32))[4]["safe_action"][0, 0]

    assert first() == first(plant={"v": 0.6}) != first(model={"v": 0.6})
    assert first("plant") == first("plant", model={"v": 0.6}) != first("plant", plant={"v": 0.6})


def test_what_is_reported_at_a_reset_does_not_change_what_was_executed():
    envs = SafetyFilterVectorWrapper(
        gym.make_vec(
            "safe_envs/StochasticDubins-v0", num_envs=3, horizon=0.1, autoreset_mode="SameStep"
        ),
        "scbf",
    )
    envs.reset(seed=0)
    for _ in range(2):
        _, _, _, truncated, info = envs.step(np.full((3, 1), 0.9, dtype=np.float32))
    assert truncated.all()
    assert (info["final_info"]["safe_action"] != 0).all()
    np.testing.assert_array_equal(
        envs.unwrapped.executed[0], info["final_info"]["safe_action"][:, 0]
    )


def test_the_noise_of_filtered_and_unfiltered_envs_is_the_same():
    bare, filtered = (
        gym.make("safe_envs/StochasticDubins-v0"),
        SafetyFilterWrapper(gym.make("safe_envs/StochasticDubins-v0"), "scbf"),
    )
    for seed in (4, None):
        bare.reset(seed=seed)
        filtered.reset(seed=seed)
        np.testing.assert_array_equal(bare.unwrapped.state, filtered.unwrapped.state)
        for _ in range(20):
            *_, info = filtered.step(np.zeros(1, dtype=np.float32))
            bare.unwrapped.step_physical(info["safe_action"].tolist())
            np.testing.assert_array_equal(bare.unwrapped.state, filtered.unwrapped.state)


def test_infeasible_steps_are_counted_and_flagged():
    env = SafetyFilterWrapper(
        gym.make("safe_envs/Scalar-v0", start=[0.9], box=[-0.5, 0.5], noise=0.0), "cbf:alpha=1"
    )
    env.reset(seed=0)
    for step in range(1, 4):
        *_, info = env.step(np.ones(1, dtype=np.float32))
        assert (info["feasible"], info["episode_infeasible"], info["safe_action"][0]) == (
            False,
            step,
            -0.5,
        )
        assert info["slack"] > 0
    _, info = env.reset()
    assert (
        info["feasible"],
        info["episode_infeasible"],
        info["episode_interventions"],
        info["slack"],
    ) == (True, 0, 0, 0.0)


def test_wrong_speed_settles_where_theory_says():
    # A model with speed v_hat settles at h = -2 v_hat (v - v_hat)/(p_1 p_2): thesis-notes, for
    # equal rates.
    p, v, v_hat = 2.0, 0.8, 0.5
    arguments = {"start": "valid", "box": [-50.0, 50.0], "dt": 0.005, "horizon": 40.0}
    env = SafetyFilterWrapper(gym.make("safe_envs/DubinsDisk-v0", **arguments), f"hocbf:p={p},{p}")
    env.reset(seed=0)
    for _ in range(8000):
        *_, info = env.step(np.zeros(1, dtype=np.float32))
    assert info["barrier"][0] == pytest.approx(-2 * v_hat * (v - v_hat) / p**2, abs=2e-3)


def test_known_speed_keeps_the_disk():
    env = SafetyFilterWrapper(
        gym.make("safe_envs/DubinsDisk-v0", start="valid", dt=0.01, horizon=20.0),
        "hocbf:p=2,2",
        knowledge="plant",
    )
    env.reset(seed=0)
    for _ in range(2000):
        *_, info = env.step(np.zeros(1, dtype=np.float32))
    assert info["h_min"] > -1e-6
    assert info["episode_interventions"] > 0


def test_bad_actions_and_bad_arguments_are_errors():
    env = SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "scbf")
    env.reset(seed=0)
    for action in (np.array([np.nan]), np.array([np.inf]), np.zeros(2)):
        with pytest.raises(InvalidInputError):
            env.step(action)
    vector = SafetyFilterVectorWrapper(gym.make_vec("safe_envs/Scalar-v0", num_envs=2), "scbf")
    vector.reset(seed=0)
    for action in (np.array([[0.0], [np.nan]]), np.zeros((3, 1)), np.zeros(2)):
        with pytest.raises(InvalidInputError):
            vector.step(action)
    with pytest.raises(ConfigurationError, match="did you mean 'scbf'"):
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "scb")
    with pytest.raises(ConfigurationError, match="knowledge"):
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "scbf", knowledge="none")
    with pytest.raises(RelativeDegreeError, match="use hocbf"):
        SafetyFilterWrapper(gym.make("safe_envs/DubinsDisk-v0"), "cbf")
    with pytest.raises(ConfigurationError, match="is not one of this project's envs"):
        SafetyFilterWrapper(gym.make("Pendulum-v1"), "scbf")
    with pytest.raises(ConfigurationError, match="is not one of this project's envs"):
        SafetyFilterVectorWrapper(gym.make_vec("Pendulum-v1", num_envs=2), "scbf")


def test_wrapping_under_other_wrappers_works():
    vector = gym.wrappers.vector.RecordEpisodeStatistics(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=2, horizon=0.2)
    )
    over = SafetyFilterVectorWrapper(vector, "scbf")
    under = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=2, horizon=0.2), "scbf"
    )
    for env in (over, under):
        env.reset(seed=0)
    for _ in range(4):
        actions = np.full((2, 1), 0.7, dtype=np.float32)
        first, second = over.step(actions), under.step(actions)
        np.testing.assert_allclose(first[0], second[0], rtol=1e-6)
    assert "episode" in first[4]


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
def test_wrapper_that_changes_the_safe_action_is_an_error():
    rescaled = gym.wrappers.RescaleAction(gym.make("safe_envs/Scalar-v0"), -2.0, 2.0)
    env = SafetyFilterWrapper(rescaled, "scbf")
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="changed the safe action"):
        env.step(np.ones(1))
    outside = gym.wrappers.RescaleAction(
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "scbf"), -2.0, 2.0
    )
    outside.reset(seed=0)
    np.testing.assert_allclose(outside.step(np.array([1.0]))[4]["nominal_action"], [5.0])
    vector = gym.wrappers.vector.RescaleAction(
        gym.make_vec("safe_envs/Scalar-v0", num_envs=2), -2.0, 2.0
    )
    batch = SafetyFilterVectorWrapper(vector, "scbf")
    batch.reset(seed=0)
    with pytest.raises(ConfigurationError, match="changed the safe action"):
        batch.step(np.ones((2, 1)))


def test_copies_and_processes():
    env = SafetyFilterWrapper(gym.make("safe_envs/StochasticDubins-v0"), "scbf")
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(env.step([0.2])[0], twin.step([0.2])[0])
    problem = env.unwrapped.problem
    assert pickle.loads(pickle.dumps(problem)) == problem


def test_joint_program_reports_what_the_goal_alone_asks_for():
    env = SafetyFilterWrapper(
        gym.make("safe_envs/ACC-v0", start=[21.0, 20.0, 37.9]), "cbf", objective="clf"
    )
    vector = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/ACC-v0", num_envs=2, start=[21.0, 20.0, 37.9]),
        "cbf",
        objective="clf",
    )
    observation, _ = env.reset(seed=0)
    vector.reset(seed=0)
    goal, _ = CLFController(env.unwrapped.problem).predict(observation.astype(np.float64))
    for proposal in (0.7, -0.4):  # the policy has no say
        env.reset(seed=0)
        info = env.step(np.array([proposal]))[-1]
        np.testing.assert_allclose(
            info["nominal_action"], goal * env.unwrapped.problem.box[0][1], rtol=1e-4
        )
        assert info["intervention"]
        assert info["safe_action"][0] < info["nominal_action"][0] - 1.0
    infos = vector.step(np.zeros((2, 1)))[-1]
    np.testing.assert_allclose(infos["nominal_action"][0], info["nominal_action"], rtol=1e-9)
    np.testing.assert_allclose(infos["safe_action"][0], info["safe_action"], rtol=1e-9)


def test_priorities_and_slacks_reach_the_gym_wrappers():
    problem = problem_of("safe_envs/QuadrotorLimits-v0")
    state = [0.0] * 12
    state[2], state[5], state[6], state[9] = (
        3.2,
        -6.0,
        0.49,
        1.0,
    )  # too fast towards the floor, and tilting further
    slacks = []
    for priorities in (None, [1.0, 1.0, 1e4]):
        env = SafetyFilterWrapper(
            gym.make("safe_envs/QuadrotorLimits-v0", start=state), "hocbf", priorities=priorities
        )
        env.reset(seed=0)
        info = env.step(np.zeros(4))[-1]
        assert info["slacks"].shape == (len(problem.barriers),)
        assert info["slack"] == info["slacks"].max() > 0
        again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
        again.reset(seed=0)
        np.testing.assert_array_equal(again.step(np.zeros(4))[-1]["slacks"], info["slacks"])
        slacks.append(info["slacks"])
    assert slacks[0][2] > 1.0
    assert slacks[1][2] < 1e-2 * slacks[0][2]
    assert slacks[1][0] > slacks[0][0]
    with pytest.raises(ConfigurationError, match="priorities"):
        SafetyFilterWrapper(gym.make("safe_envs/QuadrotorLimits-v0"), "hocbf", priorities=[1.0])


def test_an_action_that_is_the_least_violating_one_already_is_no_intervention():
    # Infeasible, and the proposal is the end of the box that the filter wants: active, but nothing
    # is changed.
    vector = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/Scalar-v0", num_envs=2, start=[1.9], noise=0.0, box=[-1.0, 1.0]),
        "cbf:alpha=5",
    )
    vector.reset(seed=0)
    info = vector.step(np.array([[-1.0], [1.0]]))[-1]
    assert info["filter_active"].tolist() == [True, True]
    assert info["feasible"].tolist() == [False, False]
    assert info["intervention"].tolist() == [False, True]
    assert info["active_barrier"].tolist() == [-1, 0]


@pytest.mark.parametrize("condition", [None, 3, [None], ("scbf",)])
def test_what_is_no_condition_is_explained(condition):
    with pytest.raises(
        ConfigurationError, match="give a Condition, one for each barrier, or their text"
    ):
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), condition)
