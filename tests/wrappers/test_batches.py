"""A batch does what its envs do one by one, whatever is around them and whenever they restart."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.engine.program import Program
from tests.wrappers.cases import (
    CASES,
    actions,
    assert_close,
    assert_plays_as_alone,
    each_mode,
    few_cases,
    of_env,
)


@pytest.fixture(autouse=True)
def plain(monkeypatch, request):
    """Run programs as plain Python, but where they are to be compiled."""
    if "compiles" not in request.fixturenames:
        monkeypatch.setattr(Program, "compiled", Program.plain)


@pytest.fixture
def compiles():
    """For tests of compiled programs."""


@each_mode
def test_a_batch_plays_as_its_envs_do(make, mode):
    assert assert_plays_as_alone(make, mode) >= 1


@pytest.mark.parametrize(
    ("filtered", "engine"), [(False, "numpy"), (True, "numpy"), (True, "compiled")]
)
def test_a_batch_of_every_env_plays_as_its_envs_do(env_id, filtered, engine):
    make = of_env(env_id, filtered=filtered, engine=engine)
    assert assert_plays_as_alone(make, "SameStep" if filtered else "NextStep") >= 1


@pytest.mark.oracle
def test_compiled_programs_of_every_env_play_as_its_envs_do(env_id, compiles):
    assert_plays_as_alone(of_env(env_id, engine="compiled"), "SameStep")


def test_a_compiled_program_plays_as_its_envs_do(compiles):
    assert assert_plays_as_alone(of_env("safe_envs/Scalar-v0", engine="compiled"), "SameStep") >= 1


@few_cases
def test_the_size_of_a_batch_changes_nothing(make):
    rows, rng, envs = [], np.random.default_rng(0), [make(1), make(4)]
    given = [actions(envs[0], rng) for _ in range(8)]
    for count, env in zip((1, 4), envs, strict=True):
        found = [env.reset(seed=11)[0][0]]
        found += [env.step(np.tile(each, (count, 1)))[0][0] for each in given]
        rows.append(np.array(found))
    np.testing.assert_allclose(*rows, rtol=1e-12, atol=1e-12)


@few_cases
def test_a_snapshot_goes_on_in_another_batch(make):
    first, second, rng = make(2), make(2), np.random.default_rng(0)
    first.reset(seed=1)
    second.reset(seed=9)
    for _ in range(4):
        first.step(actions(first, rng))
    snapshot = first.snapshot()
    kept = {key: np.copy(value) for key, value in snapshot.items()}
    first.step(actions(first, rng))
    for key, value in snapshot.items():
        np.testing.assert_array_equal(value, kept[key])
    for env in (first, second):
        env.restore(snapshot, seed=1)
    for k in range(9):
        given = actions(first, rng)
        ours, theirs = first.step(given), second.step(given)
        for mine, other in zip(ours[:-1], theirs[:-1], strict=True):
            np.testing.assert_array_equal(mine, other)
        for key in theirs[-1].keys() - {"final_obs", "final_info"}:
            assert_close(ours[-1][key], theirs[-1][key], f"step {k}: {key}")


@pytest.mark.parametrize("name", ["ended by violations", "compiled filter", "specification"])
def test_without_a_reset_nothing_goes_on(name):
    env = CASES[name](3, "Disabled")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1)))
    env.reset(seed=0)
    while not (ended := np.logical_or(*env.step(np.ones((3, 1)))[2:4])).any():
        pass
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.ones((3, 1)))
    env.reset(options={"reset_mask": ended})
    env.step(np.ones((3, 1)))
