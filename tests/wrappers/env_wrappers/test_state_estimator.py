"""State estimators over envs, and filters at their estimates."""

import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_for_sb3

from safe_envs.errors import ConfigurationError, NotCompilableError
from safe_envs.wrappers import (
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    StateEstimatorVectorWrapper,
    StateEstimatorWrapper,
)

ID = "safe_envs/StochasticDubins-v0"
SENSOR = {"measurement": ["default:dropout=0.2", "delay=1"], "horizon": 1.0}
ADDED = (
    "estimate",
    "estimate_covariance",
    "innovation",
    "nees",
    "nees_dof",
    "nis",
    "nis_dof",
    "lost",
)


def one(text="scbf:belief=0.05", observe="estimate", **options):
    env = StateEstimatorWrapper(gym.make(ID, **SENSOR, **options), "ekf", observe)
    return SafetyFilterWrapper(env, text)


def many(text="scbf:belief=0.05", observe="estimate", count=3, **options):
    env = gym.make_vec(ID, num_envs=count, **SENSOR, **options)
    return SafetyFilterVectorWrapper(StateEstimatorVectorWrapper(env, "ekf", observe), text)


@pytest.mark.parametrize("observe", ["estimate", "measurement"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_batch_is_many_envs_in_every_mode_of_autoreset(mode, observe):
    single, batch = one(observe=observe), many(observe=observe, autoreset_mode=mode)
    seen, info = single.reset(seed=4)
    all_seen, infos = batch.reset(seed=4)
    np.testing.assert_array_equal(all_seen[0], seen)
    skip = False
    for _ in range(45):
        all_seen, _, ended, cut, infos = batch.step(np.full((3, 1), 0.3))
        if skip:
            seen, info = single.reset()
            skip = False
        else:
            seen, _, terminated, truncated, info = single.step([0.3])
            if terminated or truncated:
                skip = mode == "NextStep"
                if mode == "SameStep":
                    last = infos["final_info"]
                    for key, value in info.items():
                        np.testing.assert_allclose(last[key][0], value, atol=1e-9, err_msg=key)
                    np.testing.assert_array_equal(infos["final_obs"][0], seen)
                    seen, info = single.reset()
                elif mode == "Disabled":
                    mask = ended | cut
                    all_seen, infos = batch.reset(options={"reset_mask": mask})
                    seen, info = single.reset()
        np.testing.assert_array_equal(all_seen[0], seen)
        for key, value in info.items():
            np.testing.assert_allclose(infos[key][0], value, atol=1e-9, err_msg=key)


def test_trajectories_do_not_depend_on_the_size_of_the_batch():
    small, large = many(count=2), many(count=5)
    small.reset(seed=7)
    large.reset(seed=7)
    for _ in range(30):
        *_, a = small.step(np.full((2, 1), 0.4))
        *_, b = large.step(np.full((5, 1), 0.4))
        np.testing.assert_allclose(a["state"], b["state"][:2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(a["estimate"], b["estimate"][:2], rtol=0, atol=1e-12)


def test_the_truth_is_what_it_is_without_an_estimator():
    bare = gym.make(ID, horizon=1.0)
    estimated = StateEstimatorWrapper(gym.make(ID, **SENSOR))
    _, expected = bare.reset(seed=2)
    _, info = estimated.reset(seed=2)
    for _ in range(20):
        for key in expected:
            np.testing.assert_array_equal(info[key], expected[key])
        _, reward, *ends, expected = bare.step([0.7])
        _, other, *others, info = estimated.step([0.7])
        assert (reward, ends) == (other, others)


def test_observed_estimates_have_the_space_of_the_env_without_a_sensor():
    env = one()
    assert env.observation_space == gym.make(ID).observation_space
    seen, info = env.reset(seed=0)
    x, y, theta = info["estimate"]
    np.testing.assert_allclose(seen, [x, y, np.cos(theta), np.sin(theta)], rtol=1e-6)
    raw = one(observe="measurement")
    assert raw.observation_space == raw.unwrapped.observation_space


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version:UserWarning")
@pytest.mark.parametrize("observe", ["estimate", "measurement"])
def test_checkers_pass(observe):
    check_env(one(observe=observe), skip_render_check=True)
    check_for_sb3(one(observe=observe))


def test_keys_have_one_type_at_reset_and_at_every_step():
    env = one()
    _, at_reset = env.reset(seed=0)
    *_, at_step = env.step([0.0])
    assert set(at_reset) == set(at_step) >= {*ADDED, "lost", "belief_barrier"}
    for key, value in at_step.items():
        assert type(value) is type(at_reset[key]), key
        assert np.isfinite(value).all(), key
        assert np.shape(value) == np.shape(at_reset[key]), key
    assert isinstance(at_step["nees"], float)
    assert isinstance(at_step["lost"], int)


def test_an_env_is_made_again_from_its_spec():
    env = SafetyFilterWrapper(gym.make(ID, **SENSOR), "scbf:belief=0.1", estimator="ukf:alpha=0.5")
    text = env.spec.to_json()
    again = gym.make(EnvSpec.from_json(text))
    assert json.loads(text)["additional_wrappers"]
    env.reset(seed=3)
    again.reset(seed=3)
    for _ in range(5):
        *_, a = env.step([0.5])
        *_, b = again.step([0.5])
        np.testing.assert_array_equal(a["safe_action"], b["safe_action"])
        np.testing.assert_array_equal(a["estimate"], b["estimate"])


def test_a_snapshot_of_a_batch_goes_on():
    env, other = many(), many()
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.full((3, 1), 0.2))
    kept = env.snapshot()
    other.reset(seed=9)
    seeds = [1, 2, 3]
    env.restore(kept, seeds)
    other.restore(kept, seeds)
    for _ in range(5):
        *_, a = env.step(np.full((3, 1), 0.2))
        *_, b = other.step(np.full((3, 1), 0.2))
        np.testing.assert_array_equal(a["state"], b["state"])
        np.testing.assert_array_equal(a["estimate"], b["estimate"])


def test_the_estimator_is_not_told_of_states_that_are_set():
    env = StateEstimatorWrapper(gym.make(ID, measurement="default"))
    _, info = env.reset(seed=0, options={"state": [1.0, 0.5, 0.3]})
    assert not np.allclose(info["estimate"], [1.0, 0.5, 0.3], atol=1e-6)
    env.unwrapped.state = [0.0, -1.0, 0.3]
    *_, info = env.step([0.0])
    assert info["nees"] > 20.0


def test_filters_by_themselves_act_at_estimates():
    env = SafetyFilterWrapper(
        gym.make("safe_envs/DubinsDisk-v0", measurement="default", model={"v": 0.8}),
        "backup",
        estimator="ekf",
    )
    env.reset(seed=0)
    *_, info = env.step([0.3])
    assert {"estimate", "feasible"} <= set(info)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SafetyFilterWrapper(gym.make(ID, **SENSOR), "scbf"), "estimator='ekf'"),
        (lambda: SafetyFilterWrapper(gym.make(ID), "scbf", estimator="ekf"), "nothing to estimate"),
        (lambda: SafetyFilterWrapper(gym.make(ID), "scbf:belief=.1"), "knows the true state"),
        (lambda: StateEstimatorWrapper(gym.make(ID, **SENSOR), "ekf", "all"), "observe"),
        (lambda: StateEstimatorWrapper(gym.make(ID, **SENSOR), knowledge="god"), "knowledge"),
        (lambda: StateEstimatorWrapper(gym.make(ID, delay=2, **SENSOR)), "delay or a slew limit"),
        (
            lambda: SafetyFilterVectorWrapper(gym.make_vec(ID, num_envs=2, **SENSOR), "scbf"),
            "estimator='ekf'",
        ),
        (
            lambda: StateEstimatorVectorWrapper(gym.make(ID, **SENSOR)),
            "put StateEstimatorWrapper over it",
        ),
        (lambda: StateEstimatorWrapper(gym.make("Pendulum-v1")), "option measurement"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ConfigurationError, match=words):
        make()


def test_the_compiled_engine_has_no_sensors():
    with pytest.raises(NotCompilableError, match="sensor"):
        gym.make_vec(ID, num_envs=2, engine="compiled", **SENSOR)
