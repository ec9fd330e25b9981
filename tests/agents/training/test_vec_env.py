"""The native VecEnv does what DummyVecEnv does over the scalar envs, and infos are made as far as
they are read."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.agents.training.vec_env import SB3VecEnv, make_sb3_env
from safe_envs.wrappers import SCBF, SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"
NUM_ENVS = 3


def pair(env_id, filter_text, **options):
    """Our env, and the DummyVecEnv over the scalar ones, with the same seeds."""

    def scalar():
        env = gym.make(env_id, **options)
        return env if filter_text is None else SafetyFilterWrapper(env, filter_text)

    theirs = DummyVecEnv([scalar] * NUM_ENVS)
    theirs.seed(7)
    return make_sb3_env(env_id, NUM_ENVS, filter_text, seed=7, **options), theirs


def drawn_actions(env, steps, seed=0):
    return (
        np.random.default_rng(seed)
        .uniform(-1.0, 1.0, (steps, env.num_envs, *env.action_space.shape))
        .astype(np.float32)
    )


def assert_same_info(ours, theirs, where):
    assert set(ours) == set(theirs), where
    for key, wanted in theirs.items():
        assert type(ours[key]) is type(wanted), (where, key)
        if isinstance(wanted, np.ndarray):
            assert (ours[key].dtype, ours[key].shape) == (wanted.dtype, wanted.shape), (where, key)
        assert np.allclose(ours[key], wanted, rtol=1e-6, atol=1e-9), (where, key, ours[key], wanted)


def assert_same_steps(ours, theirs, actions):
    """Step both, compare all they show, and return the dones and the infos."""
    shown = []
    np.testing.assert_allclose(ours.reset(), theirs.reset(), rtol=1e-6)
    for k, action in enumerate(actions):
        *mine, my_infos = ours.step(action)
        *other, other_infos = theirs.step(action)
        for name, a, b in zip(("observations", "rewards", "dones"), mine, other, strict=True):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), (k, name)
            assert np.allclose(a, b, rtol=1e-6, atol=1e-7), (k, name, a, b)
        for i in range(NUM_ENVS):
            assert_same_info(my_infos[i], other_infos[i], f"step {k}, env {i}")
            assert_same_info(
                ours.reset_infos[i], theirs.reset_infos[i], f"step {k}, reset of env {i}"
            )
        for key, values in ours.batch_info.items():
            assert np.array_equal(values, [info[key] for info in my_infos]), (k, key)
        shown.append((mine[2], my_infos))
    return shown


@pytest.mark.parametrize("filtered", [False, True])
def test_equals_dummy_vec_env(env_id, filtered):
    problem = problem_of(env_id)
    ours, theirs = pair(
        env_id, problem.filter if filtered else None, noise=0.05, horizon=4 * problem.dt
    )
    shown = assert_same_steps(ours, theirs, drawn_actions(ours, 9))
    assert sum(dones.sum() for dones, _ in shown) >= 2 * NUM_ENVS


def ends_of(shown):
    return [
        (info["TimeLimit.truncated"], info["violation"])
        for dones, infos in shown
        for done, info in zip(dones, infos, strict=True)
        if done
    ]


SCALAR_ID = "safe_envs/Scalar-v0"
EARLY = {"start": [0.8], "noise": 1.0, "horizon": 0.1, "terminate_on_violation": True}


@pytest.mark.parametrize(
    ("filter_text", "options", "wanted"),
    [
        ("scbf", {"noise": 6.0, "horizon": 0.3}, {True, False}),
        (None, EARLY, {(True, False), (False, True)}),
        ("scbf", EARLY, {(True, False), (False, True)}),
    ],
)
def test_equals_dummy_vec_env_when_episodes_end_at_different_steps(filter_text, options, wanted):
    ours, theirs = pair(SCALAR_ID, filter_text, **options)
    shown = assert_same_steps(ours, theirs, np.abs(drawn_actions(ours, 70)))
    found = ends_of(shown)
    assert {(end if "start" in options else end[0]) for end in found} == wanted
    assert any(dones.any() and not dones.all() for dones, _ in shown)


def test_an_end_in_the_last_control_period_is_no_truncation():
    dt = problem_of(DUBINS).dt
    ours, theirs = pair(DUBINS, None, start=[6.0, 0.0, 0.0], noise=0.0, horizon=dt)
    shown = assert_same_steps(ours, theirs, drawn_actions(ours, 1))
    assert [truncated for truncated, _ in ends_of(shown)] == [False] * NUM_ENVS


def test_infos_stay_as_they_were():
    envs = [make_sb3_env(DUBINS, 2, "scbf", seed=0, max_episode_steps=3) for _ in range(2)]
    for env in envs:
        env.reset()
    actions = drawn_actions(envs[0], 8)
    kept = [envs[0].step(action)[3] for action in actions]
    for infos, action in zip(kept, actions, strict=True):
        for late, early in zip(infos, envs[1].step(action)[3], strict=True):
            assert_same_info(late, early, "read late")


def test_seeds_are_used_once():
    env = make_sb3_env(DUBINS, 2, seed=5)
    first = env.reset()
    assert env.seed(5) == [5, 6]
    second, third = env.reset(), env.reset()
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(second, third)
    assert env.get_attr("np_random_seed") == [5, 6]
    np.testing.assert_array_equal(first[1], gym.make(DUBINS).reset(seed=6)[0])
    env.seed()
    assert len(set(env._seeds)) == 2


def test_options_are_of_the_next_reset_alone():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=5)
    states = np.array([[0.5, 0.1, 0.2], [-0.4, 0.3, 1.0]])
    env.set_options([{"state": x, "t": t} for x, t in zip(states, (0.1, 0.2), strict=True)])
    env.reset()
    np.testing.assert_array_equal(env.get_attr("state"), states)
    np.testing.assert_array_equal(
        env.env.unwrapped.episodes.steps * env.env.unwrapped.problem.dt, [0.1, 0.2]
    )
    assert env._options == [{}, {}]
    env.set_options({"state": states[0]})
    env.reset()
    np.testing.assert_array_equal(env.get_attr("state"), states[[0, 0]])
    env.reset()
    assert not (np.array(env.get_attr("state")) == states).any()


@pytest.mark.parametrize(
    "options",
    [
        {"reset_mask": [True, False]},
        [{"t": 0.1}, {}],
        [{"start": "one"}, {"start": "other"}],
        {"speed": 1.0},
    ],
)
def test_options_that_do_not_fit_are_refused(options):
    env = make_sb3_env(DUBINS, 2, seed=5)
    env.set_options(options)
    with pytest.raises(ConfigurationError, match=r"set_options|unknown option 'speed'"):
        env.reset()


def test_attributes_and_methods_are_those_of_dummy_vec_env():
    ours, theirs = pair("safe_envs/QuadrotorLimits-v0", "hocbf", noise=0.05)
    (action,) = drawn_actions(ours, 1)
    for env in (ours, theirs):
        env.reset()
        env.step(action)
    for name in ("state", "executed", "components"):
        values = ours.get_attr(name)
        np.testing.assert_allclose(values, theirs.get_attr(name), rtol=1e-6)
        np.testing.assert_array_equal(ours.get_attr(name, [2]), values[2:])
        assert name == "state" or {type(u) for value in values for u in value} == {float}
    for name in ("observation_space", "action_space"):
        assert ours.get_attr(name) == theirs.get_attr(name)
    assert ours.get_attr("spec", 0)[0].id == theirs.get_attr("spec", 0)[0].id
    assert ours.get_attr("np_random")[0] is not ours.get_attr("np_random")[1]
    for name in ("executed", "nothing"):
        found = [env.env_method("has_wrapper_attr", name) for env in (ours, theirs)]
        assert found[0] == found[1] == [ours.has_attr(name)] * NUM_ENVS
    with pytest.raises(AttributeError, match="'nothing'"):
        ours.get_attr("nothing")
    # Once for the batch.
    wanted = [env.unwrapped.physical_action(a) for env, a in zip(theirs.envs, action, strict=True)]
    np.testing.assert_allclose(ours.env_method("physical_action", action), wanted, rtol=1e-6)
    (found,) = ours.env_method("physical_action", action, indices=1)
    np.testing.assert_allclose(found, wanted[1], rtol=1e-6)
    with pytest.raises(ConfigurationError, match="'reset'"):
        ours.env_method("reset", indices=[0])
    for kind, wrapped in ((SafetyFilterWrapper, True), (gym.wrappers.TimeLimit, False)):
        assert ours.env_is_wrapped(kind) == [wrapped] * NUM_ENVS
    assert ours.env_is_wrapped(SafetyFilterVectorWrapper, 0) == [True]
    assert make_sb3_env(DUBINS, 2).env_is_wrapped(SafetyFilterWrapper) == [False, False]


def test_attributes_are_rows_of_arrays_or_shared_and_are_set_for_all_envs():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0)
    env.reset()
    for name, holder in (("problem", env.env.unwrapped), ("safety_filter", env.env)):
        values = [*env.get_attr(name), *env.env_method("get_wrapper_attr", name, indices=[0])]
        assert all(value is getattr(holder, name) for value in values)
    for shared in ("read", (), [], (np.zeros(2), 1.0), (np.zeros(3),)):
        env.set_attr("note", shared)
        assert all(value is shared for value in env.get_attr("note"))
    env.set_attr("of_matrices", [np.arange(4.0).reshape(2, 2)])
    ((row,),) = env.get_attr("of_matrices", 1)
    np.testing.assert_array_equal(row, [2.0, 3.0])
    env.set_attr("safety_filter", "another", indices=[0, 1])
    assert env.env.safety_filter == "another"
    with pytest.raises(ConfigurationError, match="'note' is shared by all 2 envs"):
        env.set_attr("note", "changed", indices=0)
    with pytest.raises(AttributeError):
        env.set_attr("components", np.zeros((2, 3)))
    env.set_attr("state", [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    np.testing.assert_array_equal(env.get_attr("state"), [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def test_render_of_each_env_is_its_picture():
    env = make_sb3_env(DUBINS, 2)
    assert env.render_mode is None
    for call, found in (
        (env.get_images, [None, None]),
        (env.render, None),
        (lambda: env.env_method("render"), [None, None]),
    ):
        with pytest.warns(UserWarning, match="render.mode"):
            assert call() == found
    env = make_sb3_env(DUBINS, 3, "scbf", seed=1, render_mode="rgb_array")
    env.reset()
    pictures = env.env_method("render")
    assert [picture.shape for picture in pictures] == [(540, 960, 3)] * 3
    for ours, theirs in zip(pictures, env.get_images(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    (last,) = env.env_method("render", indices=2)
    np.testing.assert_array_equal(last, pictures[2])
    assert (last != pictures[0]).any()


def test_penalty_is_the_distance_in_units_of_the_box():
    env_id, c = "safe_envs/QuadrotorLimits-v0", 0.7
    given = {"seed": 3, "noise": 0.05, "max_episode_steps": 12}
    envs = [make_sb3_env(env_id, 2, "hocbf", intervention_penalty=p, **given) for p in (0.0, c)]
    for env in envs:
        env.reset()
    half = np.diff(np.array(envs[0].get_attr("problem")[0].input_bounds))[:, 0] / 2.0
    reduced = 0
    for action in drawn_actions(envs[0], 24):
        (_, plain, dones, infos), (_, rewards, _, penalised) = (env.step(action) for env in envs)
        moved = [(info["safe_action"] - info["nominal_action"]) / half for info in infos]
        distances = np.linalg.norm(moved, axis=1)
        np.testing.assert_allclose(rewards, plain - c * distances, rtol=1e-5, atol=1e-6)
        assert rewards.dtype == np.float32
        reduced += (distances[dones] > 0.0).sum()
        assert all(
            (d > 0.0) == info["intervention"] for d, info in zip(distances, infos, strict=True)
        )
        np.testing.assert_allclose(
            [info["intervention_penalty"] for info in penalised], c * distances, rtol=1e-12
        )
    assert reduced, "an episode should end with an intervention"


def test_penalty_is_in_all_infos_if_there_is_one():
    free, penalised = (
        make_sb3_env(DUBINS, 2, "scbf", seed=3, intervention_penalty=c, max_episode_steps=3)
        for c in (0.0, 0.5)
    )
    for env in (free, penalised):
        env.reset()
        assert all(
            ("intervention_penalty" in info) == (env is penalised) for info in env.reset_infos
        )
    for action in drawn_actions(penalised, 3):
        infos = penalised.step(action)[3]
        assert all("intervention_penalty" not in info for info in free.step(action)[3])
        values = penalised.batch_info["intervention_penalty"]
        assert (values.dtype, values.shape) == (np.float64, (2,))
        for info, at_rest in zip(infos, penalised.reset_infos, strict=True):
            assert type(info["intervention_penalty"]) is float
            assert set(info) - set(at_rest) <= {"TimeLimit.truncated", "terminal_observation"}
            assert set(at_rest) <= set(info)
            assert at_rest["intervention_penalty"] == 0.0
    assert "terminal_observation" in infos[0]


@pytest.mark.parametrize("given", [None, "none", "scbf", SCBF(), [SCBF()]], ids=str)
def test_filters_are_texts_conditions_or_nothing(given):
    env = make_sb3_env("StochasticDubins-v0", 2, given, knowledge="plant", noise=0.1, horizon=None)
    assert isinstance(env.env, SafetyFilterVectorWrapper) == (given not in (None, "none"))
    env.reset()
    assert ("safe_action" in env.reset_infos[0]) == (given not in (None, "none"))


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ({"env_id": "StochasticDubin-v0"}, "'safe_envs/StochasticDubins-v0'"),
        ({"env_id": "CartPole-v1"}, "CartPole-v1"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 2.0}, r"num_envs = 2\.0"),
        ({"filter": 3}, "3"),
        ({"filter": "scbf", "intervention_penalty": -0.1}, r"intervention_penalty = -0\.1"),
        ({"filter": "scbf", "intervention_penalty": float("nan")}, "intervention_penalty = nan"),
        ({"filter": "scbf", "intervention_penalty": "1"}, "intervention_penalty = '1'"),
        ({"intervention_penalty": 0.1}, "without a filter"),
        ({"filter": "scbf", "estimator": "ekf"}, "measurement"),
        ({"seed": -1}, "seed = -1"),
        ({"horizn": 1.0}, "'horizon'"),
        ({"render_mode": "human"}, "render_mode = 'human'"),
        ({"engine": "fast"}, "engine = 'fast'"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_wrong_arguments_are_errors(arguments, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make_sb3_env(**{"env_id": DUBINS, "num_envs": 2, **arguments})


def test_other_envs_are_errors():
    for env, fragment in (("CartPole-v1", "vector envs"), (DUBINS, "'SameStep'")):
        with pytest.raises(ConfigurationError, match=fragment):
            SB3VecEnv(gym.make_vec(env, num_envs=2))


def test_wrong_actions_are_errors():
    env = make_sb3_env(DUBINS, 2, "scbf")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 1), dtype=np.float32))
    env.reset()
    with pytest.raises(InvalidInputError, match=r"actions have shape \(2,\)"):
        env.step(np.zeros(2, dtype=np.float32))
    with pytest.raises(InvalidInputError, match=r"envs \[1\] are not finite"):
        env.step(np.array([[0.0], [np.nan]], dtype=np.float32))


def test_agents_learn_behind_the_promise_filter_and_may_observe_p():
    env = SafetyFilterVectorWrapper(
        gym.make_vec(SCALAR_ID, num_envs=4, autoreset_mode="SameStep", horizon=0.2),
        "promise:p=0.97",
        observe_promise=True,
    )
    envs = SB3VecEnv(env, intervention_penalty=0.1)
    assert envs.observation_space.shape == (2,)
    seen = envs.reset()
    rng = np.random.default_rng(0)
    for k in range(41):
        if k % 20 == 0:
            levels = np.float32([info["promise"] for info in envs.reset_infos])
            np.testing.assert_array_equal(seen[:, 1], levels)
        seen, _, dones, infos = envs.step(rng.uniform(-1.0, 1.0, (4, 1)).astype(np.float32))
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"][1] == np.float32(infos[i]["promise"])
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, device="cpu", seed=0).learn(32)
    assert model.predict(seen)[0].shape == (4, 1)


def test_with_an_estimator_the_features_are_those_at_the_estimate_and_filters_act_there():
    given = {"measurement": "default", "estimator": "ekf", "seed": 0}
    env = make_sb3_env(DUBINS, 3, "scbf", **given)
    observation = env.reset()
    assert observation.shape == (3, len(problem_of(DUBINS).features))
    for _ in range(5):
        observation, _, _, infos = env.step(np.zeros((3, 1), dtype=np.float32))
    for seen, info in zip(observation, infos, strict=True):
        x, y, theta = info["estimate"]
        np.testing.assert_allclose(seen, [x, y, np.cos(theta), np.sin(theta)], rtol=1e-5)
        assert not np.allclose(info["estimate"], info["state"])
        assert info["nees_dof"] == 3
    measured = make_sb3_env(DUBINS, 3, "scbf", observe="measurement", **given)
    assert measured.reset().shape == (3, 3)


def test_monitor_reports_the_last_step_of_an_episode(tmp_path):
    native = make_sb3_env(DUBINS, 2, "scbf", seed=0, max_episode_steps=4)
    env = VecMonitor(native, str(tmp_path), info_keywords=("episode_cost",))
    env.reset()
    total = np.zeros(2)
    for action in drawn_actions(env, 4):
        _, rewards, dones, infos = env.step(action)
        total += rewards
    assert dones.all()
    for info, wanted in zip(infos, total, strict=True):
        assert info["episode"]["r"] == pytest.approx(wanted)
        assert (info["episode"]["l"], info["episode"]["episode_cost"]) == (4, info["episode_cost"])
    env.close()


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        (PPO, {"n_steps": 32, "batch_size": 64, "n_epochs": 2}),
        (SAC, {"learning_starts": 100, "batch_size": 32}),
    ],
)
def test_algorithms_learn_behind_the_wrappers_of_stable_baselines3(algorithm, settings):
    native = make_sb3_env(DUBINS, 4, "scbf", intervention_penalty=0.1, max_episode_steps=10)
    env = VecNormalize(VecMonitor(native, info_keywords=("episode_cost", "episode_interventions")))
    model = algorithm("MlpPolicy", env, device="cpu", seed=0, **settings).learn(300)
    assert len(model.ep_info_buffer) >= 28
    assert all(episode["l"] == 10 for episode in model.ep_info_buffer)
    assert native.get_attr("np_random_seed") == [0, 1, 2, 3]


READINGS = {
    "keys": lambda info: {key: info[key] for key in info.keys()},  # noqa: SIM118
    "items": lambda info: dict(info.items()),
    "values": lambda info: dict(zip(info, info.values(), strict=True)),
    "iteration": lambda info: {key: info[key] for key in info},
    "reversed": lambda info: {key: info[key] for key in reversed(info)},
    "dict": dict,
    "unpacked": lambda info: {**info},
    "or": lambda info: info | {},
    "reflected or": lambda info: {} | info,
    "update": lambda info: [target := {}, target.update(info)][0],
    "copy": lambda info: info.copy(),
    "pickle": lambda info: pickle.loads(pickle.dumps(info)),
    "deepcopy": copy.deepcopy,
    "setdefault": lambda info: {key: info.setdefault(key, None) for key in tuple(info)},
    "pop": lambda info: {key: info.pop(key) for key in tuple(info)},
    "popitem": lambda info: dict([info.popitem() for _ in range(len(info))]),
    "repr": lambda info: eval(repr(info), {"array": np.array, "float32": np.float32}),
}


def test_infos_are_made_as_far_as_they_are_read():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0)
    env.reset()
    info = env.step(np.ones((2, 1), dtype=np.float32))[3][1]
    assert (info.batch is env.batch_info, info.index) == (True, 1)
    assert ("cost" in info, "terminal_observation" in info) == (True, False)
    assert (info.get("episode"), info.get("episode", 3)) == (None, 3)
    with pytest.raises(KeyError, match="episode"):
        info["episode"]
    assert dict.keys(info) == set()
    assert isinstance(info["cost"], float)
    assert info.get("barrier") is info["barrier"]
    for twin in (info.copy(), copy.copy(info)):
        assert (twin.batch is info.batch, twin.index) == (True, info.index)
        assert twin["barrier"] is info["barrier"]
        assert dict.keys(twin) == {"barrier"}


def test_every_way_to_read_an_info_gives_all_of_it():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0, max_episode_steps=1)
    env.reset()
    info = env.step(np.ones((2, 1), dtype=np.float32))[3][1]
    wanted = {key: values[1] for key, values in env.batch_info.items()}
    wanted["terminal_observation"] = dict.get(info, "terminal_observation")
    for name, reading in READINGS.items():
        read = reading(info.copy())
        assert len(read) == len(wanted) == 18, name
        for key, value in wanted.items():
            # The text of an array has eight digits.
            np.testing.assert_allclose(read[key], value, rtol=1e-7, err_msg=f"{name}: {key}")


def test_infos_are_equal_if_their_entries_are():
    # An array of several barriers has no truth value of its own.
    envs = [make_sb3_env("safe_envs/QuadrotorLimits-v0", 2, "hocbf", seed=0) for _ in range(2)]
    for env in envs:
        env.reset()
    info, twin = (env.step(np.ones((2, 4), dtype=np.float32))[3][1] for env in envs)
    changed = [info.copy() for _ in range(4)]
    changed[0]["cost"] = 7.0
    changed[1]["barrier"][1] += 1.0
    changed[2]["another"] = 1
    del changed[3]["cost"]
    # A copy of a lazy one is lazy, so that no comparison can rely on an earlier one.
    for other, same in (
        (twin, True),
        (info, True),
        (dict(twin.copy()), True),
        *((other, False) for other in changed),
    ):
        for a, b in (
            (info.copy(), other),
            (other, info.copy()),
            (info.copy(), other.copy()),
            (other.copy(), info.copy()),
        ):
            assert ((a == b), (a != b)) == (same, not same)
    assert info.copy() != 3


def test_infos_can_be_changed_without_changing_the_batch():
    env = make_sb3_env(DUBINS, 2, seed=0)
    env.reset()
    info, other = env.reset_infos
    unchanged = info.copy()
    info["cost"] = 7.0
    info["barrier"][:] = 7.0
    del info["h_min"]
    assert info.get("cost") == info["cost"] == 7.0
    assert "h_min" not in info
    assert info.get("h_min") is None
    assert info != unchanged
    assert unchanged == {key: values[0] for key, values in env.batch_info.items()}
    assert (len(info), len(other)) == (4, 5)
    assert other["cost"] == 0.0
    assert env.batch_info["barrier"][0] != 7.0
    copied = pickle.loads(pickle.dumps(info))
    assert type(copied) is dict
    assert type(copy.deepcopy(info)) is dict
    info.clear()
    assert "violation" not in info
