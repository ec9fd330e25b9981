"""The promise filter in the gym wrappers: what it remembers of episodes, through all resets."""

from __future__ import annotations

import copy
import importlib.util

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.values.guesses import SCALAR, guess

SHORT = {"horizon": 0.06}
KEYS = ("promise", "safe_action", "feasible", "intervention", "slack", "episode_interventions")


def scalar_env(observe=False, **options):
    env = gym.make(SCALAR, **options)
    return SafetyFilterWrapper(env, guess(**options), observe_promise=observe)


def vector_env(mode="NextStep", envs=4, observe=False, engine="numpy", **options):
    env = gym.make_vec(SCALAR, num_envs=envs, autoreset_mode=mode, engine=engine, **options)
    return SafetyFilterVectorWrapper(env, guess(**options), observe_promise=observe)


def actions(k, envs=4):
    return np.random.default_rng(k).uniform(-1.0, 1.0, (envs, 1))


def test_info_has_p_with_one_type_at_reset_and_at_each_step():
    env, envs = scalar_env(), vector_env()
    _, info = env.reset(seed=0)
    _, infos = envs.reset(seed=0)
    assert 0.0 < info["promise"] <= 0.97
    usual = set(SafetyFilterWrapper(gym.make(SCALAR), "scbf").reset(seed=0)[1])
    for k in range(8):
        assert set(info) == usual | {"promise"}
        assert type(info["promise"]) is float
        assert (type(info["slack"]), info["slacks"].shape) == (float, (1,))
        assert set(infos) == set(info) | {f"_{key}" for key in info}
        assert (infos["promise"].dtype, infos["promise"].shape) == (np.float64, (4,))
        assert 0.0 <= info["promise"] <= 1.0
        assert -10.0 <= info["safe_action"][0] <= 10.0
        info, infos = env.step(actions(k)[0])[-1], envs.step(actions(k))[-1]
        assert infos["_promise"].all()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_batch_plays_the_episodes_of_scalar_envs(mode):
    envs, singles = vector_env(mode, **SHORT), [scalar_env(**SHORT) for _ in range(4)]
    _, infos = envs.reset(seed=3)
    alone = [env.reset(seed=3 + i) for i, env in enumerate(singles)]
    starts = [info["promise"] for _, info in alone]
    assert infos["promise"].tolist() == starts
    resting = np.zeros(4, dtype=bool)
    interventions = 0
    for k in range(20):
        _, _, terminated, truncated, infos = envs.step(actions(k))
        ended = terminated | truncated
        for i, env in enumerate(singles):
            if resting[i]:  # the step that resets ignores its action
                _, found = env.reset()
                assert found["promise"] > 0.0
            else:
                _, _, *ends, found = env.step(actions(k)[i])
                assert any(ends) == ended[i]
            source = infos
            if ended[i] and mode == "SameStep":
                source = infos["final_info"]
                _, begun = env.reset()
                assert infos["promise"][i] == pytest.approx(begun["promise"], abs=1e-12)
                assert not infos["intervention"][i]
            for key in KEYS:
                np.testing.assert_allclose(source[key][i], found[key], atol=1e-12, err_msg=key)
            interventions += found["intervention"]
        resting = ended if mode == "NextStep" else np.zeros(4, dtype=bool)
        if mode == "Disabled" and ended.any():
            _, infos = envs.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                begun = singles[i].reset()[1]["promise"]
                assert infos["promise"][i] == pytest.approx(begun, abs=1e-12)
            assert infos["_promise"].tolist() == ended.tolist()
    assert 5 < interventions < 75


def test_the_last_info_of_an_episode_has_p_of_its_last_state():
    envs = vector_env("SameStep", **SHORT)
    envs.reset(seed=0)
    for k in range(6):
        *_, truncated, infos = envs.step(actions(k))
    assert truncated.all()
    memory = envs._filter
    last, x = infos["final_info"]["promise"], tuple(envs.unwrapped.episodes.last_states.T)
    # Below 1 it is p times the table's value there, and not that of the next start.
    assert (last > 0.0).all()
    assert (last <= memory.safety_filter.look_ahead.values(np.full(4, 6), x)).all()
    assert (infos["promise"] == memory.safety_filter.start(envs.unwrapped.components)).all()
    assert (x[0] != envs.unwrapped.components[0]).all()


def test_a_snapshot_has_what_the_filter_remembers():
    envs = vector_env(horizon=0.5)
    envs.reset(seed=0)
    for k in range(5):
        envs.step(actions(k))
    snapshot = envs.snapshot()

    def goes_on():
        return [envs.step(actions(k))[-1]["promise"] for k in range(5, 12)]

    envs.restore(snapshot, seed=9)
    first = goes_on()
    assert (envs.snapshot()["instant"] == 12).all()
    envs.restore(snapshot, seed=9)
    np.testing.assert_array_equal(goes_on(), first)
    unfiltered = {k: v for k, v in snapshot.items() if k != "promise"}
    with pytest.raises(InvalidInputError, match=r"has no promise.*without a promise filter"):
        envs.restore(unfiltered)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_p_is_observed_on_request(mode):
    env, envs = scalar_env(observe=True, **SHORT), vector_env(mode, observe=True, **SHORT)
    assert env.observation_space.shape == (2,)
    assert (envs.single_observation_space, envs.observation_space.shape) == (
        env.observation_space,
        (4, 2),
    )
    seen, info = env.reset(seed=0)
    both, infos = envs.reset(seed=0)
    for k in range(7):
        assert (seen.dtype, both.dtype) == (np.float32, np.float32)
        assert env.observation_space.contains(seen)
        assert envs.observation_space.contains(both)
        assert seen[-1] == np.float32(info["promise"])
        np.testing.assert_array_equal(both[:, -1], infos["promise"].astype(np.float32))
        if "final_obs" in infos:
            last = np.stack(infos["final_obs"])
            np.testing.assert_array_equal(
                last[:, 1], infos["final_info"]["promise"].astype(np.float32)
            )
        seen, *_, info = env.step(actions(k)[0])
        both, *_, infos = envs.step(actions(k))
    assert "final_obs" not in infos or mode == "SameStep"


def test_stepping_on_after_the_end_gives_nothing():
    env = scalar_env(**SHORT)
    env.reset(seed=0)
    for k in range(6):
        *_, truncated, info = env.step(actions(k)[0])
    assert truncated
    assert info["promise"] > 0.0
    *_, info = env.step(actions(6)[0])
    assert (info["promise"], info["feasible"], info["safe_action"][0]) == (0.0, False, -10.0)


def test_what_does_not_fit_is_explained():
    with pytest.raises(ConfigurationError, match="has another dt than"):
        SafetyFilterWrapper(gym.make(SCALAR, dt=0.02, horizon=1.0), guess())
    with pytest.raises(ConfigurationError, match="priorities are of conditions"):
        SafetyFilterWrapper(gym.make(SCALAR), guess(), priorities=[1.0])
    with pytest.raises(ConfigurationError, match="use 'nearest'"):
        SafetyFilterWrapper(gym.make(SCALAR), guess(), objective="clf")
    for wrapper, env in (
        (SafetyFilterWrapper, gym.make(SCALAR)),
        (SafetyFilterVectorWrapper, gym.make_vec(SCALAR, num_envs=2)),
    ):
        with pytest.raises(ConfigurationError, match="scbf has no p_k to observe"):
            wrapper(env, "scbf", observe_promise=True)


@pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="needs Numba")
def test_only_numpy_decides():
    with pytest.raises(NotCompilableError, match=r"promise:p=0\.97.*no compiled form"):
        vector_env(engine="compiled", **SHORT)
    found, wanted = vector_env(engine="auto", **SHORT), vector_env(**SHORT)
    for env in (found, wanted):
        env.reset(seed=0)
    for k in range(9):
        first, second = found.step(actions(k))[-1], wanted.step(actions(k))[-1]
        np.testing.assert_allclose(first["promise"], second["promise"], rtol=1e-9)


def test_copies_go_their_own_ways():
    env = scalar_env()
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    for k in range(3):
        assert env.step(actions(k)[0])[-1]["promise"] == twin.step(actions(k)[0])[-1]["promise"]
    env.step(actions(4)[0])
    assert env._filter.levels[0] != twin._filter.levels[0]


def followed(env, count, first=0):
    """Return what the filter says of some steps."""
    infos = [env.step(actions(k)[: getattr(env, "num_envs", 1)])[-1] for k in range(first, count)]
    return [{key: info[key] for key in KEYS} for info in infos]


@pytest.mark.parametrize("state", [0.3, 0.99, -2.5])
def test_from_a_state_that_is_set_is_kept_what_can_be_from_there(state):
    env, late = scalar_env(), scalar_env()
    env.reset(seed=0)
    late.reset(seed=0, options={"state": [state], "t": 3 * late.unwrapped.problem.dt})
    for k in range(3):
        env.step(actions(k)[0])
    memory, before = env._filter, env._filter.levels.item()
    assert before > 0.0
    losses, env._interventions = memory.losses, 0
    env.unwrapped.state = [state]
    for k in range(3, 6):
        mine, theirs = env.step(actions(k)[0])[-1], late.step(actions(k)[0])[-1]
        for key in KEYS:
            np.testing.assert_array_equal(mine[key], theirs[key])
        assert mine["promise"] > 0.0
    # What the other state was worth is no loss of the table's.
    assert memory.losses - losses == late._filter.losses


def test_nothing_is_kept_from_an_unsafe_state():
    env = scalar_env()
    env.reset(seed=0)
    env.unwrapped.state = [1.5]
    info = env.step(actions(0)[0])[-1]
    assert (info["feasible"], info["promise"]) == (False, 0.0)
    _, info = env.reset(options={"state": [1.5]})
    assert (info["violation"], info["promise"]) == (True, 0.0)
    # What is kept from a safe state on is of the rest of the episode.
    env.unwrapped.state = [0.0]
    info = env.step(actions(0)[0])[-1]
    assert info["feasible"]
    assert info["promise"] > 0.0


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_envs_whose_states_stay_keep_what_they_kept(mode):
    env, other = vector_env(mode), vector_env(mode)
    for each in (env, other):
        each.reset(seed=0)
        followed(each, 3)
    states, kept = env.unwrapped.state.copy(), env._filter.levels.copy()
    states[2] = 0.9
    env.unwrapped.state = states
    levels = env._filter.safety_filter.start((np.array([0.9]),), np.array([3]))
    # Envs that are reset meanwhile do not hide the one that was set.
    mask = np.array([True, False, False, False])
    for each in (env, other):
        each.reset(options={"reset_mask": mask})
    env.follow()
    np.testing.assert_array_equal(env._filter.levels[[1, 3]], kept[[1, 3]])
    assert env._filter.levels[2] == levels.item() != kept[2]
    for mine, theirs in zip(followed(env, 6, 3), followed(other, 6, 3), strict=True):
        for key in KEYS:
            np.testing.assert_array_equal(mine[key][[0, 1, 3]], theirs[key][[0, 1, 3]])


def test_a_snapshot_that_the_env_restores_alone_leaves_no_old_bound():
    env = vector_env()
    env.reset(seed=0)
    begun = env.unwrapped.snapshot()
    followed(env, 5)
    env.unwrapped.restore(begun)
    env.follow()
    x = tuple(begun["state"].T)
    np.testing.assert_array_equal(env._filter.levels, env._filter.safety_filter.start(x))
    np.testing.assert_array_equal(env._filter._instants, 0)


def test_a_late_start_ends_with_the_table():
    env = scalar_env(**SHORT)
    steps, dt = env.unwrapped.problem.steps, env.unwrapped.problem.dt
    env.reset(seed=0, options={"t": (steps - 1) * dt})
    *_, truncated, info = env.step(actions(0)[0])
    assert truncated
    assert info["promise"] > 0.0
    assert not env.step(actions(0)[0])[-1]["feasible"]
