"""The native vector env does what Gymnasium's SyncVectorEnv over the scalar envs does, autoreset
included."""

from __future__ import annotations

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from safe_envs import ConfigurationError
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.systems import vectors
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of

NUM_ENVS = 5


def pair(env_id, mode, filtered, num_envs=NUM_ENVS, **arguments):
    def scalar():
        env = gym.make(env_id, **arguments)
        return SafetyFilterWrapper(env, env.unwrapped.problem.filter) if filtered else env

    native = gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=mode.value, **arguments)
    if filtered:
        native = SafetyFilterVectorWrapper(native, native.unwrapped.problem.filter)
    return native, SyncVectorEnv([scalar] * num_envs, autoreset_mode=mode)


def assert_same(ours, theirs, where):
    """Compare arrays, or infos key by key; floats to rounding, since NumPy and `math` differ in the
    last bit of a sine."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), where
        for key in theirs:
            assert_same(ours[key], theirs[key], f"{where}[{key}]")
        return
    assert ours.dtype == theirs.dtype, where
    assert ours.shape == theirs.shape, where
    if ours.dtype == object:
        for mine, other in zip(ours, theirs, strict=True):
            assert (mine is None) == (other is None), where
            if other is not None:
                assert_same(mine, other, where)
    elif ours.dtype == bool or np.issubdtype(ours.dtype, np.integer):
        np.testing.assert_array_equal(ours, theirs, err_msg=where)
    elif not np.array_equal(ours, theirs):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9, err_msg=where)


def only_where_present(info):
    """Leave out what is masked: SyncVectorEnv has zeros where an env reported nothing."""
    result = {}
    for key, value in info.items():
        if key.startswith("_"):
            result[key] = value
        elif isinstance(value, dict):
            result[key] = only_where_present(value)
        elif value.dtype == object:
            result[key] = value
        else:
            mask = info[f"_{key}"].reshape(-1, *[1] * (value.ndim - 1))
            result[key] = np.where(mask, value, np.zeros_like(value))
    return result


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_equals_sync_vector_env(env_id, mode, filtered):
    dt = gym.make(env_id).unwrapped.problem.dt
    ours, theirs = pair(env_id, mode, filtered, num_envs=3, noise=0.05, horizon=11 * dt)
    assert_same(*[e.reset(seed=7)[0] for e in (ours, theirs)], "reset")
    rng = np.random.default_rng(0)
    # Three episodes, and what comes after them.
    for step in range(38):
        actions = rng.uniform(-1.0, 1.0, ours.action_space.shape).astype(np.float32)
        *mine, my_info = ours.step(actions)
        *other, other_info = theirs.step(actions)
        for name, a, b in zip(
            ("observation", "reward", "terminated", "truncated"), mine, other, strict=True
        ):
            assert_same(a, b, f"step {step}: {name}")
        assert_same(
            only_where_present(my_info), only_where_present(other_info), f"step {step}: info"
        )


def test_equals_sync_vector_env_when_episodes_end_at_different_steps():
    # Random actions drive the scalar system out of its workspace at different times, so that noise
    # streams drift apart.
    ours, theirs = pair(
        "safe_envs/Scalar-v0", AutoresetMode.NEXT_STEP, False, noise=0.5, horizon=1.7
    )
    assert_same(*[e.reset(seed=3)[0] for e in (ours, theirs)], "reset")
    ends = set()
    for step in range(600):
        actions = np.linspace(0.2, 1.0, NUM_ENVS, dtype=np.float32)[:, None]
        *mine, _ = ours.step(actions)
        *other, _ = theirs.step(actions)
        for a, b in zip(mine, other, strict=True):
            assert_same(a, b, f"step {step}")
        ends |= {step for done in mine[2] | mine[3] if done}
    assert len(ends) > 10


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("start", [[0.9], [1.1]])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_equals_sync_vector_env_when_violations_end_episodes(mode, start, filtered):
    # Reset does not end an episode, wherever it begins.
    ours, theirs = pair(
        "safe_envs/Scalar-v0", mode, filtered, start=start, noise=1.0, terminate_on_violation=True
    )
    assert_same(*[e.reset(seed=3)[0] for e in (ours, theirs)], "reset")
    ends = 0
    for step in range(60):
        actions = np.linspace(0.2, 1.0, NUM_ENVS, dtype=np.float32)[:, None]
        *mine, my_info = ours.step(actions)
        *other, other_info = theirs.step(actions)
        for a, b in zip(mine, other, strict=True):
            assert_same(a, b, f"step {step}")
        assert_same(only_where_present(my_info), only_where_present(other_info), f"step {step}")
        ends += mine[2].sum()
    # Behind the filter there are fewer.
    assert ends >= NUM_ENVS


@pytest.mark.parametrize("filtered", [False, True])
def test_disabled_autoreset_waits_for_a_masked_reset(filtered):
    ours, theirs = pair(
        "safe_envs/StochasticDubins-v0", AutoresetMode.DISABLED, filtered, horizon=0.5
    )
    for env in (ours, theirs):
        env.reset(seed=5)
    actions = np.full((NUM_ENVS, 1), 0.4, dtype=np.float32)
    for _ in range(10):
        *_, truncated, _ = ours.step(actions)
        theirs.step(actions)
    assert truncated.all()
    with pytest.raises(gym.error.ResetNeeded):
        ours.step(actions)
    for mask in ([True, False, True, False, False], [False, True, False, True, True]):
        results = [
            e.reset(seed=None, options={"reset_mask": np.array(mask)}) for e in (ours, theirs)
        ]
        assert_same(results[0][0], results[1][0], "masked reset")
        assert_same(
            only_where_present(results[0][1]),
            only_where_present(results[1][1]),
            "masked reset info",
        )
    for _ in range(9):
        mine, other = ours.step(actions), theirs.step(actions)
        assert_same(mine[0], other[0], "after the reset")
        assert_same(
            only_where_present(mine[4]), only_where_present(other[4]), "info after the reset"
        )


def test_trajectories_do_not_depend_on_the_size_of_the_batch(env_id):
    results = []
    for num_envs in (1, 3, 64):
        env = gym.make_vec(env_id, num_envs=num_envs, noise=0.05)
        observation, _ = env.reset(seed=11)
        rows = [observation[0]]
        for _ in range(20):
            observation, *_ = env.step(np.full(env.action_space.shape, 0.2, dtype=np.float32))
            rows.append(observation[0])
        results.append(np.array(rows))
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_what_was_handed_out_does_not_change_afterwards():
    env = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=3, horizon=0.2), "scbf"
    )
    handed_out = [
        env.reset(seed=0),
        *(env.step(np.full((3, 1), 0.9, dtype=np.float32)) for _ in range(12)),
    ]
    again = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=3, horizon=0.2), "scbf"
    )
    for step in range(13):
        fresh = (
            again.reset(seed=0) if step == 0 else again.step(np.full((3, 1), 0.9, dtype=np.float32))
        )
        for old, new in zip(handed_out[step][:-1], fresh[:-1], strict=True):
            np.testing.assert_array_equal(old, new)
        assert_same(handed_out[step][-1], fresh[-1], f"info of step {step}")


def test_what_a_user_writes_into_an_info_stays_there():
    env = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=3), "scbf"
    )
    again = SafetyFilterVectorWrapper(
        gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=3), "scbf"
    )
    env.reset(seed=0)
    again.reset(seed=0)
    for _ in range(3):
        actions = np.full((3, 1), 0.9, dtype=np.float32)
        info, expected = env.step(actions)[4], again.step(actions)[4]
        assert_same(info, expected, "info")
        for value in info.values():
            value[...] = 0


def test_seeds_may_be_a_list():
    env = gym.make_vec("safe_envs/StochasticDubins-v0", num_envs=2)
    first, _ = env.reset(seed=[4, 9])
    np.testing.assert_array_equal(first[1], env.reset(seed=[9, 4])[0][0])
    np.testing.assert_array_equal(first, env.reset(seed=np.array([4, 9]))[0])
    np.testing.assert_array_equal(env.reset(seed=np.int64(4))[0], env.reset(seed=4)[0])
    with pytest.raises(ConfigurationError, match="3 seeds were given for 2 envs"):
        env.reset(seed=[1, 2, 3])
    for seed in (1.5, [4, 9.7], "ab", [True, 1], [-1, 1]):
        with pytest.raises(ConfigurationError, match="give a whole number from 0"):
            env.reset(seed=seed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 2, "autoreset_mode": "never"}, "autoreset_mode = 'never'"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        gym.make_vec("safe_envs/Scalar-v0", **arguments)


def test_reset_masks_may_be_used_again():
    env = gym.make_vec("safe_envs/Scalar-v0", num_envs=2)
    env.reset(seed=0)
    mask = np.array([True, False])
    _, info = env.reset(options={"reset_mask": mask})
    mask[:] = False
    np.testing.assert_array_equal(info["_cost"], [True, False])


def test_reset_masks_are_checked():
    env = gym.make_vec("safe_envs/Scalar-v0", num_envs=2)
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    for mask in (np.array([True]), np.array([1, 0]), np.array([False, False])):
        with pytest.raises(ConfigurationError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})


def test_a_fixed_start_is_that_of_every_env():
    envs = SafeVectorEnv(
        problem_of("safe_envs/DubinsObstacle-v0", start=[2.0, 1.3, 0.3, 0.5, 1.0]), 3
    )
    envs.reset(seed=0)
    np.testing.assert_array_equal(envs.state, [[2.0, 1.3, 0.3, 0.5, 1.0]] * 3)
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    np.testing.assert_array_equal(envs.state, [[2.0, 1.3, 0.3, 0.5, 1.0]] * 3)


def test_the_batched_class_is_one_object_by_name(env_id):
    made = type(gym.make_vec(env_id, num_envs=1).unwrapped)
    assert made is getattr(vectors, made.__name__) is pickle.loads(pickle.dumps(made))
    assert gym.spec(env_id).vector_entry_point == f"{made.__module__}:{made.__name__}"


@pytest.mark.parametrize("name", ["Scalar", "NobodyVector", "Vector"])
def test_no_batched_class_of_another_name(name):
    with pytest.raises(AttributeError, match=name):
        getattr(vectors, name)
