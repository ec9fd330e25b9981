"""Episodes that begin at a given state, start or time, and states that are set, in every engine."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError
from tests.wrappers.cases import assert_close as assert_same

DUBINS, QUADROTOR, SCALAR = (
    f"safe_envs/{n}-v0" for n in ("StochasticDubins", "Quadrotor", "Scalar")
)
ENGINES = ("numpy", "compiled")
UNSAFE = np.array([3.5, 0.5, 1.0])


def played(env, actions):
    """Return what the env gives for some actions, without the counters of the episode."""
    found = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        kept = [info[key] for key in ("cost", "violation", "barrier")]
        found.append([observation, reward, terminated, truncated, *kept])
    return found


def actions_of(env, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, *env.action_space.shape))


def batch(engine="numpy", env_id=DUBINS, num_envs=3, mode="NextStep", **arguments):
    return gym.make_vec(env_id, num_envs, engine=engine, autoreset_mode=mode, **arguments)


def test_an_episode_goes_on_from_its_state_and_time(env_id):
    env = gym.make(env_id, horizon=1.0)
    steps = env.unwrapped.problem.steps
    actions = actions_of(env, steps)
    for seed in (3, None):
        # Without a seed it is the second episode of the seed.
        env.reset(seed=seed)
        played(env, actions[:4])
        x, t = env.unwrapped.state, 4 * env.unwrapped.problem.dt
        rest = played(env, actions[4:8])
        options = {"state": x, "t": t}
        if seed is None:
            env.reset(seed=3)
        env.reset(seed=seed, options=options)
        assert env.unwrapped.episode.steps == 4
        for mine, other in zip(played(env, actions[4:8]), rest, strict=True):
            for a, b in zip(mine, other, strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("env_id", [DUBINS, QUADROTOR, SCALAR])
def test_a_batch_does_what_single_envs_do(env_id, engine, plain):
    envs = batch(engine, env_id, horizon=0.5)
    singles = [gym.make(env_id, horizon=0.5) for _ in range(3)]
    for env in singles:
        env.reset(seed=1)
    x = np.array([0.999 * env.unwrapped.state for env in singles])
    period = singles[0].unwrapped.problem.dt
    t = period * np.array([0, 2, 5])
    # The second time there is noise that was drawn ahead.
    for seed in (7, None):
        observation, info = envs.reset(seed=seed, options={"state": x, "t": t})
        for i, env in enumerate(singles):
            options = {"state": x[i], "t": t[i]}
            alone, one = env.reset(seed=None if seed is None else 7 + i, options=options)
            assert_same(observation[i], alone, "reset")
            assert_same(info["h_min"][i], one["h_min"], "h_min")
        for action in actions_of(envs, 4):
            *found, info = envs.step(action)
            for i, env in enumerate(singles):
                *theirs, one = env.step(action[i])
                for mine, other in zip(found, theirs, strict=True):
                    assert_same(mine[i], other, "step")
                assert_same(info["episode_cost"][i], one["episode_cost"], "cost")


@pytest.mark.parametrize("engine", ENGINES)
def test_an_unsafe_state_is_reported_like_any_other(engine, plain):
    envs = batch(engine)
    for options in ({"state": UNSAFE.copy()}, {"state": np.tile(UNSAFE, (3, 1))}):
        _, infos = envs.reset(seed=0, options=options)
        assert infos["violation"].all()
        np.testing.assert_array_equal(infos["episode_cost"], [1.0, 1.0, 1.0])
        options["state"][:] = 5.0
        np.testing.assert_array_equal(envs.unwrapped.state, np.tile(UNSAFE, (3, 1)))
    _, info = gym.make(DUBINS).reset(options={"state": UNSAFE.tolist()})
    assert (info["violation"], info["cost"], info["episode_cost"]) == (True, 1.0, 1.0)


def test_a_start_is_drawn_from_the_distribution_of_its_name():
    envs, env = batch("numpy", QUADROTOR, 2), gym.make(QUADROTOR)
    assert len(env.unwrapped.problem.starts) > 1
    for name in env.unwrapped.problem.starts:
        found = envs.reset(seed=4, options={"start": name})[0]
        for i, seen in enumerate(found):
            expected = gym.make(QUADROTOR, start=name).reset(seed=4 + i)[0]
            again = env.reset(seed=4 + i, options={"start": name})[0]
            np.testing.assert_array_equal(again, expected)
            assert_same(seen, expected, name)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_mask_leaves_the_other_envs_where_they_are(engine, mode, plain):
    envs = batch(engine, mode=mode)
    envs.reset(seed=0)
    envs.step(np.zeros((3, 1)))
    before, mask = envs.unwrapped.state, np.array([False, True, False])
    given = np.full((3, 3), np.nan)
    given[1] = UNSAFE
    _, infos = envs.reset(options={"state": given, "t": [np.nan, 1.0, -4.0], "reset_mask": mask})
    np.testing.assert_array_equal(envs.unwrapped.state[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(envs.unwrapped.state[1], UNSAFE)
    np.testing.assert_array_equal(
        envs.unwrapped.episodes.steps, [1, round(1.0 / envs.unwrapped.problem.dt), 1]
    )
    np.testing.assert_array_equal(infos["_cost"], mask)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_follows_a_late_start_begins_at_time_0(engine, mode, plain):
    envs = batch(engine, num_envs=2, mode=mode, horizon=0.5)
    period = envs.unwrapped.problem.dt
    last = envs.unwrapped.problem.steps - 1
    envs.reset(seed=0, options={"t": [last * period, 0.0]})
    truncated = envs.step(np.zeros((2, 1)))[3]
    assert truncated.tolist() == [True, False]
    if mode == "NextStep":
        envs.step(np.zeros((2, 1)))
    assert envs.unwrapped.episodes.steps.tolist() == [0, 1 + (mode == "NextStep")]
    other = batch(engine, num_envs=2, mode=mode, horizon=0.5)
    other.reset(seed=0)
    other.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(envs.unwrapped.state[0], other.unwrapped.state[0])


@pytest.mark.parametrize(
    ("options", "error", "fragment"),
    [
        ({"stat": UNSAFE}, ConfigurationError, "did you mean 'state'"),
        ({1: 2}, ConfigurationError, "option 1"),
        ([], ConfigurationError, "mapping"),
        ({"state": UNSAFE, "start": "thesis"}, ConfigurationError, "both"),
        ({"start": "elsewhere"}, ConfigurationError, "'elsewhere'"),
        ({"start": ["thesis"]}, ConfigurationError, r"\['thesis'\]"),
        ({"state": [1.0, 2.0]}, InvalidInputError, r"\(2,\)"),
        ({"state": [np.nan, 0.0, 0.0]}, InvalidInputError, "= nan"),
        ({"state": [99.0, 0.0, 0.0]}, InvalidInputError, "= 99.0"),
        ({"state": "origin"}, InvalidInputError, "real numbers"),
        ({"t": -0.1}, InvalidInputError, "t = -0.1"),
        ({"t": 0.0123}, InvalidInputError, "t = 0.0123"),
        ({"t": 1.0}, InvalidInputError, "0.95"),
        ({"t": [0.0, 0.1]}, InvalidInputError, r"\(2,\)"),
        ({"t": "late"}, InvalidInputError, "real numbers"),
    ],
)
def test_what_is_not_allowed_is_refused_and_changes_nothing(options, error, fragment):
    settings = {"horizon": 1.0, "dt": 0.05}
    for make in (lambda: gym.make(DUBINS, **settings), lambda: batch(**settings)):
        env, other = make(), make()
        env.reset(seed=0)
        other.reset(seed=0)
        with pytest.raises(error, match=fragment):
            env.reset(seed=5, options=options)
        for _ in range(2):
            np.testing.assert_array_equal(env.unwrapped.state, other.unwrapped.state)
            env.reset()
            other.reset()


@pytest.mark.parametrize(
    "options", [{"reset_mask": np.array([True])}, {"state": UNSAFE[None]}, {"t": [0.0]}]
)
def test_single_envs_take_no_mask_and_no_batch(options):
    with pytest.raises((ConfigurationError, InvalidInputError), match=next(iter(options))):
        gym.make(DUBINS).reset(options=options)


def test_a_state_that_is_set_is_stepped_from_with_the_same_noise():
    env, other = gym.make(DUBINS), gym.make(DUBINS)
    actions = actions_of(env, 6)
    env.reset(seed=2)
    other.reset(seed=2)
    for each in (env, other):
        played(each, actions[:3])
    env.unwrapped.state = UNSAFE
    assert type(env.unwrapped.components[0]) is float
    assert env.unwrapped.episode.steps == 3
    assert env.unwrapped.episode.cost == other.unwrapped.episode.cost
    other.reset(seed=2, options={"state": UNSAFE, "t": 3 * other.unwrapped.problem.dt})
    for mine, theirs in zip(played(env, actions[3:]), played(other, actions[3:]), strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_a_batch_can_be_set(engine, plain):
    envs, single = batch(engine), gym.make(DUBINS)
    envs.reset(seed=2)
    single.reset(seed=3)
    actions = actions_of(envs, 4)
    for action in actions[:2]:
        envs.step(action)
        single.step(action[1])
    counters = {name: v for name, v in envs.unwrapped.snapshot().items() if name != "state"}
    states = envs.unwrapped.state.copy()
    states[1] = single.unwrapped.state = UNSAFE
    envs.unwrapped.state = states
    for name, value in counters.items():
        np.testing.assert_array_equal(envs.unwrapped.snapshot()[name], value)
    assert (envs.unwrapped.episodes.placements > 0).tolist() == [False, True, False]
    for action in actions[2:]:
        observation, _, _, _, infos = envs.step(action)
        theirs = single.step(action[1])
        assert_same(observation[1], theirs[0], "observation")
        assert infos["h_min"][1] == pytest.approx(theirs[4]["h_min"], rel=1e-12)
    envs.unwrapped.state = UNSAFE
    np.testing.assert_array_equal(envs.unwrapped.state, np.tile(UNSAFE, (3, 1)))


@pytest.mark.parametrize("make", [lambda: gym.make(DUBINS), batch], ids=["one", "batch"])
@pytest.mark.parametrize("wrong", [[99.0, 0.0, 0.0], [np.inf, 0.0, 0.0], [0.0], "x", None])
def test_a_state_that_cannot_be_is_not_set(make, wrong):
    env = make()
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.state = UNSAFE
    env.reset(seed=0)
    before = env.unwrapped.state
    with pytest.raises(InvalidInputError):
        env.unwrapped.state = wrong
    np.testing.assert_array_equal(env.unwrapped.state, before)


def test_inputs_under_way_arrive_where_a_state_was_set():
    env, envs = gym.make(DUBINS, delay=2), batch(delay=2)
    env.reset(seed=0)
    envs.reset(seed=0)
    for each, shape in ((env, (1,)), (envs, (3, 1))):
        for sent in (0.25, 0.5):
            each.step(np.full(shape, sent))
        each.unwrapped.state = UNSAFE
        *_, info = each.step(np.full(shape, 1.0))
        assert info["executed_action"] == pytest.approx(0.25 * info["sent_action"])
        each.reset(options={"state": UNSAFE, "t": 1.0})
        *_, info = each.step(np.full(shape, 1.0))
        assert not info["executed_action"].any()
