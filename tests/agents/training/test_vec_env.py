"""The native VecEnv does what DummyVecEnv does over the scalar envs."""

from __future__ import annotations

import sys
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecVideoRecorder

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.agents.training.vec_env import SafeVecEnv, make_sb3_env
from safe_envs.engine.program import Program
from safe_envs.wrappers import SCBF, SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of
from tests.values.guesses import SCALAR, guess

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


def test_equals_dummy_vec_env_when_episodes_end_at_different_steps():
    ours, theirs = pair("safe_envs/Scalar-v0", "scbf", noise=6.0, horizon=0.3)
    shown = assert_same_steps(ours, theirs, np.abs(drawn_actions(ours, 70)))
    ends = [
        info["TimeLimit.truncated"]
        for dones, infos in shown
        for done, info in zip(dones, infos, strict=True)
        if done
    ]
    assert {True, False} == set(ends)
    assert any(dones.any() and not dones.all() for dones, _ in shown)


@pytest.mark.parametrize("filter_text", [None, "scbf"])
def test_equals_dummy_vec_env_when_violations_end_episodes(filter_text):
    ours, theirs = pair(
        "safe_envs/Scalar-v0",
        filter_text,
        start=[0.8],
        noise=1.0,
        horizon=0.1,
        terminate_on_violation=True,
    )
    shown = assert_same_steps(ours, theirs, np.abs(drawn_actions(ours, 70)))
    ends = [
        (info["TimeLimit.truncated"], info["violation"], info["cost"])
        for dones, infos in shown
        for done, info in zip(dones, infos, strict=True)
        if done
    ]
    assert {(True, False, 0.0), (False, True, 1.0)} == set(ends)
    assert not any(
        info["violation"]
        for dones, infos in shown
        for done, info in zip(dones, infos, strict=True)
        if not done
    )


def test_an_end_in_the_last_control_period_is_no_truncation():
    dt = problem_of(DUBINS).dt
    ours, theirs = pair(DUBINS, None, start=[6.0, 0.0, 0.0], noise=0.0, horizon=dt)
    ((dones, infos),) = assert_same_steps(ours, theirs, drawn_actions(ours, 1))
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_infos_of_an_end_are_those_of_the_episode():
    env = make_sb3_env(DUBINS, 4, "scbf", seed=0, max_episode_steps=5)
    env.reset()
    resets = list(env.reset_infos)
    for action in drawn_actions(env, 5):
        observations, _, dones, infos = env.step(action)
    assert dones.all()
    # Before the first step nothing was proposed: that info must not stand in for the last one.
    assert all(
        info["nominal_action"] == 10.0 * a
        for info, a in zip(infos, action[:, 0].astype(float), strict=True)
    )
    assert all(info["nominal_action"] == 0.0 for info in env.reset_infos)
    assert all(a is not b for a, b in zip(resets, env.reset_infos, strict=True))
    assert all(
        not np.array_equal(info["terminal_observation"], row)
        for info, row in zip(infos, observations, strict=True)
    )


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


def test_attributes_are_rows_or_shared():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0)
    env.reset()
    problems, filters = env.get_attr("problem"), env.get_attr("safety_filter")
    assert problems[0] is problems[1] is env.env.unwrapped.problem
    assert filters[0] is filters[1] is env.env.safety_filter
    np.testing.assert_array_equal(env.get_attr("state"), env.env.unwrapped.state)
    np.testing.assert_array_equal(env.get_attr("state", [1]), env.env.unwrapped.state[[1]])
    assert env.get_attr("observation_space", 0) == [env.observation_space]
    assert env.get_attr("action_space") == [env.action_space] * 2
    assert env.get_attr("np_random")[0] is not env.get_attr("np_random")[1]
    assert env.get_attr("spec", 0)[0].id == DUBINS
    assert env.has_attr("executed")
    assert not env.has_attr("nothing")
    with pytest.raises(AttributeError, match="'nothing'"):
        env.get_attr("nothing")


def test_attributes_are_set_for_all_envs():
    env = make_sb3_env(DUBINS, 2, "scbf")
    env.set_attr("note", "read")
    assert env.get_attr("note") == ["read", "read"]
    env.set_attr("safety_filter", "another", indices=[0, 1])
    assert env.env.safety_filter == "another"
    with pytest.raises(ConfigurationError, match="'note' is shared by all 2 envs"):
        env.set_attr("note", "changed", indices=0)
    with pytest.raises(AttributeError):
        env.set_attr("components", np.zeros((2, 3)))
    env.reset()
    env.set_attr("state", [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    np.testing.assert_array_equal(env.get_attr("state"), [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def test_methods_are_called_once_for_the_batch():
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0)
    env.reset()
    assert env.env_method("get_wrapper_attr", "problem", indices=[0]) == [
        env.get_attr("problem")[0]
    ]
    assert [env.env_method("has_wrapper_attr", name) for name in ("problem", "nothing")] == [
        [True, True],
        [False, False],
    ]
    rows = env.env_method("normalized_action", [np.array([5.0, -10.0])])
    np.testing.assert_array_equal(rows, [[0.5], [-1.0]])
    np.testing.assert_array_equal(
        env.env_method("normalized_action", [np.array([5.0, -10.0])], indices=1), [[-1.0]]
    )
    with pytest.raises(ConfigurationError, match="'reset', which acts on all envs"):
        env.env_method("reset", indices=[0])


def test_components_are_handed_out_by_env():
    env_id = "safe_envs/QuadrotorLimits-v0"
    ours, theirs = pair(env_id, "hocbf", noise=0.05)
    (action,) = drawn_actions(ours, 1)
    for env in (ours, theirs):
        env.reset()
        env.step(action)
    for name in ("executed", "components"):
        values = ours.get_attr(name)
        np.testing.assert_allclose(
            values, [getattr(env.unwrapped, name) for env in theirs.envs], rtol=1e-6
        )
        assert all(type(u) is float for value in values for u in value)
        assert ours.get_attr(name, [2]) == [values[2]]
    wanted = [env.unwrapped.physical_action(a) for env, a in zip(theirs.envs, action, strict=True)]
    np.testing.assert_allclose(ours.env_method("physical_action", action), wanted, rtol=1e-6)
    ours.set_attr("of_matrices", [np.arange(6.0).reshape(NUM_ENVS, 2)])
    ((row,),) = ours.get_attr("of_matrices", 1)
    np.testing.assert_array_equal(row, [2.0, 3.0])
    for shared in ((), [], (np.zeros(NUM_ENVS), 1.0), (np.zeros(NUM_ENVS + 1),)):
        ours.set_attr("shared", shared)
        assert all(value is shared for value in ours.get_attr("shared"))


def test_wrappers_are_found():
    env = make_sb3_env(DUBINS, 2, "scbf")
    assert env.env_is_wrapped(SafetyFilterVectorWrapper) == [True, True]
    assert env.env_is_wrapped(SafetyFilterWrapper, 0) == [True]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False, False]
    assert make_sb3_env(DUBINS, 2).env_is_wrapped(SafetyFilterWrapper) == [False, False]
    env.close()


def test_nothing_is_drawn_without_a_render_mode():
    env = make_sb3_env(DUBINS, 2)
    assert env.render_mode is None
    with pytest.warns(UserWarning, match="no images"):
        assert env.get_images() == [None, None]
    with pytest.warns(UserWarning, match="no `render_mode`"):
        assert env.render() is None


def test_render_of_each_env_is_its_picture():
    env = make_sb3_env(DUBINS, 3, "scbf", seed=1, render_mode="rgb_array")
    env.reset()
    pictures = env.env_method("render")
    assert [picture.shape for picture in pictures] == [(540, 960, 3)] * 3
    for ours, theirs in zip(pictures, env.get_images(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    (last,) = env.env_method("render", indices=2)
    np.testing.assert_array_equal(last, pictures[2])
    assert (last != pictures[0]).any()
    with pytest.warns(UserWarning, match="without a render mode"):
        assert make_sb3_env(DUBINS, 2).env_method("render") == [None, None]


def test_video_recorder_gets_what_it_asks_for(monkeypatch, tmp_path):
    # The render mode, the frame rate in the metadata, and one picture of all envs, here from a
    # stand-in for rendering.
    native = make_sb3_env(DUBINS, 2).env
    native.render_mode = "rgb_array"
    native.metadata = {**native.metadata, "render_modes": ["rgb_array"], "render_fps": 20}
    monkeypatch.setattr(
        type(native),
        "render",
        lambda self: tuple(np.full((4, 6, 3), i, dtype=np.uint8) for i in range(self.num_envs)),
    )
    monkeypatch.setitem(sys.modules, "moviepy", ModuleType("moviepy"))
    recorder = VecVideoRecorder(SafeVecEnv(native), str(tmp_path), lambda _: True, video_length=5)
    assert recorder.frames_per_sec == 20
    assert [picture.max() for picture in recorder.get_images()] == [0, 1]
    recorder.reset()
    recorder.step(np.zeros((2, 1), dtype=np.float32))
    assert [frame.shape for frame in recorder.recorded_frames] == [(8, 6, 3)] * 2
    recorder.recorded_frames.clear()


def test_penalty_is_the_distance_in_units_of_the_box():
    env_id, c = "safe_envs/QuadrotorLimits-v0", 0.7
    envs = [
        make_sb3_env(
            env_id, 2, "hocbf", seed=3, intervention_penalty=p, noise=0.05, max_episode_steps=12
        )
        for p in (0.0, c)
    ]
    for env in envs:
        env.reset()
    half = np.diff(np.array(envs[0].get_attr("problem")[0].box))[:, 0] / 2.0
    reduced = 0
    for action in drawn_actions(envs[0], 24):
        (_, plain, dones, infos), (_, rewards, _, penalised) = (env.step(action) for env in envs)
        distances = np.array(
            [
                np.linalg.norm((info["safe_action"] - info["nominal_action"]) / half)
                for info in infos
            ]
        )
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
    ("arguments", "message"),
    [
        ({"env_id": "StochasticDubin-v0"}, "did you mean 'safe_envs/StochasticDubins-v0'"),
        ({"env_id": "CartPole-v1"}, "not one of this project's envs"),
        ({"num_envs": 0}, "num_envs = 0; give a whole number from 1"),
        ({"num_envs": 2.0}, "num_envs = 2.0"),
        ({"filter": "scfb"}, "scbf"),
        ({"filter": 3}, "condition = 3"),
        ({"filter": "scbf", "knowledge": "oracle"}, "oracle"),
        ({"filter": "scbf", "objective": "fastest"}, "fastest"),
        (
            {"filter": "scbf", "intervention_penalty": -0.1},
            "intervention_penalty = -0.1; give a finite number from 0",
        ),
        ({"filter": "scbf", "intervention_penalty": float("nan")}, "intervention_penalty = nan"),
        ({"filter": "scbf", "intervention_penalty": "1"}, "intervention_penalty = '1'"),
        ({"intervention_penalty": 0.1}, "without a filter"),
        ({"seed": -1}, "seed = -1"),
        ({"horizn": 1.0}, "did you mean 'horizon'"),
        ({"render_mode": "human"}, "render_mode = 'human'"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_wrong_arguments_are_errors(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        make_sb3_env(**{"env_id": DUBINS, "num_envs": 2, **arguments})


def test_other_envs_are_errors():
    with pytest.raises(ConfigurationError, match="neither one of this project's vector envs"):
        SafeVecEnv(gym.make_vec("CartPole-v1", num_envs=2))
    with pytest.raises(ConfigurationError, match="make it with 'SameStep'"):
        SafeVecEnv(gym.make_vec(DUBINS, num_envs=2))


def test_wrong_actions_are_errors():
    env = make_sb3_env(DUBINS, 2, "scbf")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 1), dtype=np.float32))
    env.reset()
    with pytest.raises(InvalidInputError, match=r"actions have shape \(2,\)"):
        env.step(np.zeros(2, dtype=np.float32))
    with pytest.raises(InvalidInputError, match=r"envs \[1\] are not finite"):
        env.step(np.array([[0.0], [np.nan]], dtype=np.float32))


@pytest.mark.parametrize("condition", [None, "scbf"])
def test_engines_give_the_same_steps_to_rounding(condition, monkeypatch):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    ours, theirs = (
        make_sb3_env("Scalar-v0", 3, condition, seed=7, engine=engine, horizon=0.04)
        for engine in ("compiled", "numpy")
    )
    shown = assert_same_steps(ours, theirs, drawn_actions(ours, 10))
    assert sum(dones.sum() for dones, _ in shown) >= 3


def test_agents_learn_behind_the_promise_filter_and_may_observe_p():
    env = SafetyFilterVectorWrapper(
        gym.make_vec(SCALAR, num_envs=4, autoreset_mode="SameStep", horizon=0.06),
        guess(horizon=0.06),
        observe_promise=True,
    )
    envs = SafeVecEnv(env, intervention_penalty=0.1)
    assert envs.observation_space.shape == (2,)
    seen = envs.reset()
    rng = np.random.default_rng(0)
    for k in range(13):
        levels = [info["promise"] for info in envs.reset_infos] if k % 6 == 0 else None
        if levels is not None:
            np.testing.assert_array_equal(seen[:, 1], np.float32(levels))
        seen, _, dones, infos = envs.step(rng.uniform(-1.0, 1.0, (4, 1)).astype(np.float32))
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"][1] == np.float32(infos[i]["promise"])
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, device="cpu", seed=0)
    model.learn(32)
    assert model.predict(seen)[0].shape == (4, 1)
