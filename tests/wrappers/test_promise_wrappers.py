"""The promise filter in the gym wrappers: what it remembers of episodes, through all resets."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.wrappers.cases import MODES, SCALAR, guess

SHORT = {"horizon": 0.06}
KEYS = ("promise", "safe_action", "feasible", "intervention", "slack", "episode_interventions")


def one(observe=False, **options):
    env = gym.make(SCALAR, **options)
    return SafetyFilterWrapper(env, guess(**options), observe_promise=observe)


def many(mode="NextStep", observe=False, engine="numpy", **options):
    env = gym.make_vec(SCALAR, num_envs=4, autoreset_mode=mode, engine=engine, **options)
    return SafetyFilterVectorWrapper(env, guess(**options), observe_promise=observe)


def actions(k, envs=4):
    return np.random.default_rng(k).uniform(-1.0, 1.0, (envs, 1))


def said(env, first, count):
    """What the filter says of some steps."""
    batched = hasattr(env, "num_envs")
    given = (actions(k) if batched else actions(k)[0] for k in range(first, count))
    infos = [env.step(each)[-1] for each in given]
    return [{key: info[key] for key in KEYS} for info in infos]


def test_the_last_info_of_an_episode_has_p_of_its_last_state():
    envs = many("SameStep", **SHORT)
    _, infos = envs.reset(seed=0)
    assert ((infos["promise"] > 0.0) & (infos["promise"] <= 0.97)).all()
    for k in range(6):
        *_, truncated, infos = envs.step(actions(k))
    assert truncated.all()
    last, x = infos["final_info"]["promise"], tuple(envs.unwrapped.episodes.last_states.T)
    # Below 1 it is p times the table's value there, and not that of the next start.
    assert (last > 0.0).all()
    assert (last <= envs.safety_filter.look_ahead.values(np.full(4, 6), x)).all()
    assert (infos["promise"] == envs.safety_filter.start(envs.unwrapped.components)).all()


def test_a_snapshot_has_what_the_filter_remembers():
    envs = many(horizon=0.5)
    envs.reset(seed=0)
    said(envs, 0, 5)
    snapshot = envs.snapshot()
    found = []
    for _ in range(2):
        envs.restore(snapshot, seed=9)
        found.append(np.array([info["promise"] for info in said(envs, 5, 12)]))
        assert (envs.snapshot()["instant"] == 12).all()
    np.testing.assert_array_equal(*found)
    with pytest.raises(InvalidInputError, match="promise"):
        envs.restore({k: v for k, v in snapshot.items() if k != "promise"})


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_p_is_observed_on_request(mode):
    env, envs = one(observe=True, **SHORT), many(mode, observe=True, **SHORT)
    assert envs.single_observation_space == env.observation_space
    assert env.observation_space.shape == (2,)
    assert envs.observation_space.shape == (4, 2)
    seen, info = env.reset(seed=0)
    both, infos = envs.reset(seed=0)
    for k in range(7):
        assert env.observation_space.contains(seen)
        assert envs.observation_space.contains(both)
        assert seen[-1] == np.float32(info["promise"])
        np.testing.assert_array_equal(both[:, -1], infos["promise"].astype(np.float32))
        if "final_obs" in infos:
            last = np.stack(infos["final_obs"])[:, 1]
            np.testing.assert_array_equal(last, infos["final_info"]["promise"].astype(np.float32))
        seen, *_, info = env.step(actions(k)[0])
        both, *_, infos = envs.step(actions(k))


@pytest.mark.parametrize("late", [False, True])
def test_stepping_on_after_the_end_gives_nothing(late):
    env = one(**SHORT)
    problem = env.unwrapped.problem
    env.reset(seed=0, options={"t": (problem.steps - 1) * problem.dt} if late else None)
    for k in range(1 if late else 6):
        *_, truncated, info = env.step(actions(k)[0])
    assert truncated
    assert info["promise"] > 0.0
    *_, info = env.step(actions(6)[0])
    assert (info["promise"], info["feasible"], info["safe_action"][0]) == (0.0, False, -10.0)


@pytest.mark.parametrize("state", [0.3, 0.99, -2.5])
def test_from_a_state_that_is_set_is_kept_what_can_be_from_there(state):
    env, late = one(), one()
    env.reset(seed=0)
    late.reset(seed=0, options={"state": [state], "t": 3 * late.unwrapped.problem.dt})
    before = sum(info["intervention"] for info in said(env, 0, 3))
    env.unwrapped.state = [state]
    for mine, theirs in zip(said(env, 3, 6), said(late, 3, 6), strict=True):
        mine["episode_interventions"] -= before
        np.testing.assert_equal(mine, theirs)
        assert mine["promise"] > 0.0


def test_nothing_is_kept_from_an_unsafe_state():
    env = one()
    env.reset(seed=0)
    env.unwrapped.state = [1.5]
    (info,) = said(env, 0, 1)
    assert (info["feasible"], info["promise"]) == (False, 0.0)
    _, info = env.reset(options={"state": [1.5]})
    assert (info["violation"], info["promise"]) == (True, 0.0)
    # What is kept from a safe state on is of the rest of the episode.
    env.unwrapped.state = [0.0]
    (info,) = said(env, 0, 1)
    assert info["feasible"]
    assert info["promise"] > 0.0


@pytest.mark.parametrize("mode", MODES)
def test_envs_whose_states_stay_keep_what_they_kept(mode):
    env, other = many(mode), many(mode)
    for each in (env, other):
        each.reset(seed=0)
        said(each, 0, 3)
    states = env.unwrapped.state.copy()
    states[2] = 0.9
    env.unwrapped.state = states
    level = env.safety_filter.start((np.array([0.9]),), np.array([3])).item()
    # Envs that are reset meanwhile do not hide the one that was set.
    mask = np.array([True, False, False, False])
    for each in (env, other):
        each.reset(options={"reset_mask": mask})
    env.follow()
    assert env.snapshot()["promise"][2] == level != other.snapshot()["promise"][2]
    for mine, theirs in zip(said(env, 3, 6), said(other, 3, 6), strict=True):
        for key in KEYS:
            np.testing.assert_array_equal(mine[key][[0, 1, 3]], theirs[key][[0, 1, 3]])


def test_a_snapshot_that_the_env_restores_alone_leaves_no_old_bound():
    env = many()
    env.reset(seed=0)
    begun = env.unwrapped.snapshot()
    said(env, 0, 5)
    env.unwrapped.restore(begun)
    env.follow()
    found = env.snapshot()
    np.testing.assert_array_equal(
        found["promise"], env.safety_filter.start(tuple(begun["state"].T))
    )
    np.testing.assert_array_equal(found["instant"], 0)


@pytest.mark.usefixtures("plain")
def test_only_numpy_decides():
    pytest.importorskip("numba")
    with pytest.raises(NotCompilableError, match="promise"):
        many(engine="compiled", **SHORT)
    found, wanted = many(engine="auto", **SHORT), many(**SHORT)
    for env in (found, wanted):
        env.reset(seed=0)
    for mine, theirs in zip(said(found, 0, 9), said(wanted, 0, 9), strict=True):
        np.testing.assert_allclose(mine["promise"], theirs["promise"], rtol=1e-9)


def wrapped(env=None, filter=None, **given):  # noqa: A002
    env = gym.make(SCALAR) if env is None else env
    kind = SafetyFilterVectorWrapper if hasattr(env, "num_envs") else SafetyFilterWrapper
    return kind(env, guess() if filter is None else filter, **given)


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: wrapped(gym.make(SCALAR, dt=0.02, horizon=1.0)), "another dt"),
        (lambda: wrapped(priorities=[1.0]), "priorities"),
        (lambda: wrapped(objective="clf"), "nearest"),
        (lambda: wrapped(filter="scbf", observe_promise=True), "scbf"),
        (lambda: wrapped(gym.make_vec(SCALAR, 2), "scbf", observe_promise=True), "scbf"),
        (lambda: wrapped(filter="scbf").ask_promise(0.5), "scbf"),
        (lambda: one().ask_promise(0.98), "0.98"),
        (lambda: one().ask_promise(0.0), "probability"),
    ],
)
def test_what_does_not_fit_is_explained(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


def test_a_lower_probability_is_of_the_next_episodes():
    env = one()
    _, first = env.reset(seed=0)
    env.ask_promise(0.5)
    assert env.step([0.0])[-1]["promise"] > 0.5
    _, second = env.reset(seed=0)
    assert second["promise"] == 0.5 < first["promise"]
