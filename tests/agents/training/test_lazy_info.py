"""Infos that are made as far as they are read."""

from __future__ import annotations

import copy
import json
import pickle

import numpy as np
import pytest

from safe_envs.agents.training.vec_env import make_sb3_env

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"

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
    assert info.batch is env.batch_info
    assert info.index == 1
    assert dict.keys(info) == set()
    assert "cost" in info
    assert "terminal_observation" not in info
    assert info.get("episode") is None
    assert info.get("episode", 3) == 3
    with pytest.raises(KeyError, match="episode"):
        info["episode"]
    assert dict.keys(info) == set()
    assert isinstance(info["cost"], float)
    assert info.get("barrier") is info["barrier"]
    assert dict.keys(info) == {"barrier"}
    twin = info.copy()
    assert (twin.batch, twin.index) == (info.batch, info.index)
    assert twin["barrier"] is info["barrier"]
    assert dict.keys(twin) == {"barrier"}
    assert copy.copy(info).batch is info.batch


@pytest.mark.parametrize("reading", READINGS.values(), ids=READINGS)
def test_every_way_to_read_an_info_gives_all_of_it(reading):
    env = make_sb3_env(DUBINS, 2, "scbf", seed=0, max_episode_steps=1)
    env.reset()
    info = env.step(np.ones((2, 1), dtype=np.float32))[3][1]
    wanted = {
        **{key: values[1] for key, values in env.batch_info.items()},
        "terminal_observation": dict.get(info, "terminal_observation"),
    }
    read = reading(info)
    assert len(read) == len(wanted) == 18
    for key, value in wanted.items():
        # The text of an array has eight digits.
        np.testing.assert_allclose(read[key], value, rtol=1e-7, err_msg=key)


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


def test_a_dict_of_an_info_is_written_as_json():
    env = make_sb3_env(DUBINS, 2, seed=0)
    env.reset()
    info = env.reset_infos[1]
    assert set(json.loads(json.dumps(dict(info), default=list))) == set(env.batch_info)


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
