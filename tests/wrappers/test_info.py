"""What every env and wrapper reports: the table of `safe_envs.envs.info`, with its types."""

from __future__ import annotations

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

from safe_envs.envs import info as contract
from tests.wrappers.cases import CASES, actions, of_env

ROW = re.compile(r"^\| `(\w+)` \| (\w+)(?: \((.*)\))? \|", re.M)
BASE, FILTER, PROMISE, DELAY, SENSOR, ESTIMATOR, BELIEF, SPECIFICATION = (
    {key: (kind, shape) for key, kind, shape in ROW.findall(part)}
    for part in re.split(r"^\|---\|---\|---\|$", contract.__doc__ or "", flags=re.M)[1:]
)
GROUPS = {
    "ends at different times": (BASE,),
    "several barriers": (BASE, FILTER),
    "compiled filter": (BASE, FILTER),
    "backup": (BASE, FILTER),
    "third party": (BASE, FILTER),
    "promise": (BASE, FILTER, PROMISE),
    "late": (BASE, DELAY),
    "late, with a filter": (BASE, FILTER, DELAY),
    "measured": (BASE, SENSOR),
    "estimates": (BASE, FILTER, SENSOR, ESTIMATOR, BELIEF),
    "bounded specification": (BASE, SPECIFICATION),
    "specification": (BASE, FILTER, SPECIFICATION),
}
KINDS = {"float": float, "bool": bool, "int": int, "float64": np.ndarray}
DTYPES = {"float": np.float64, "float64": np.float64, "bool": np.bool_, "int": np.int64}


def assert_contract(make, groups, steps=4):
    """Check the infos of one env and of a batch, at resets and at steps."""
    one, batch, rng = make(), make(3), np.random.default_rng(0)
    problem = one.unwrapped.problem if hasattr(one.unwrapped, "problem") else one.env.problem
    expected = {key: row for group in groups for key, row in group.items()}
    channels = problem.measurement and len(problem.measurement.channels)
    sizes = {"n": problem.plant.n, "m": problem.plant.m, "2": 2}

    def shape_of(key):
        letters = re.findall(r"\w", expected[key][1])
        k = channels if key in ("received", "innovation") else len(problem.barriers)
        return tuple({**sizes, "k": k}[letter] for letter in letters)

    def finite(key, value):
        return key == "robustness" or np.isfinite(value).all()

    for info in (one.reset(seed=0)[1], *(one.step(actions(one, rng))[-1] for _ in range(steps))):
        assert info.keys() == expected.keys()
        for key, value in info.items():
            kind = np.ndarray if expected[key][1] else KINDS[expected[key][0]]
            assert type(value) is kind, key
            assert np.shape(value) == shape_of(key), key
            assert np.asarray(value).dtype == DTYPES[expected[key][0]], key
            assert finite(key, value), key
    for info in (
        batch.reset(seed=0)[1],
        *(batch.step(actions(batch, rng))[-1] for _ in range(steps)),
    ):
        assert info.keys() - {"final_obs", "_final_obs", "final_info", "_final_info"} == {
            name for key in expected for name in (key, f"_{key}")
        }
        for key, (kind, _) in expected.items():
            assert info[key].dtype == DTYPES[kind], key
            assert info[key].shape == (3, *shape_of(key)), key
            assert info[f"_{key}"].all(), key
            assert finite(key, info[key]), key


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("name", GROUPS)
def test_each_key_has_its_type_at_reset_and_at_every_step(name):
    assert_contract(CASES[name], GROUPS[name])


@pytest.mark.parametrize("filtered", [False, True])
def test_the_keys_of_every_env(env_id, filtered):
    assert_contract(of_env(env_id, filtered=filtered), (BASE, FILTER) if filtered else (BASE,))


def test_a_filter_with_a_goal_of_its_own_has_no_bounds_of_proposals():
    rest = {key: value for key, value in FILTER.items() if key != "input_bounds"}
    assert_contract(CASES["goal of the filter"], (BASE, rest))


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.parametrize("filtered", [False, True])
def test_checkers_accept_every_env(env_id, filtered):
    env = of_env(env_id, filtered=filtered)()
    check_env(env if filtered else env.unwrapped, skip_render_check=True)
    check_env_for_sb3(env)


@pytest.mark.parametrize("name", ["measured and late", "estimates", "measurements", "third party"])
def test_checkers_accept_wrappers(name):
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=".*(unwrapped version|WARN|symmetric and normalized)"
        )
        check_env(CASES[name](), skip_render_check=True)
        check_env_for_sb3(CASES[name]())


@pytest.mark.parametrize(
    "make",
    [of_env("safe_envs/DubinsReach-v0", filtered=False)]
    + [
        CASES[name]
        for name in ("several barriers", "late, with a filter", "estimates", "statistics")
    ],
)
def test_an_env_is_made_again_from_its_spec(make):
    env = make()
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert str(again) == str(env)
    assert again.unwrapped.problem == env.unwrapped.problem
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(env.reset(seed=3)[0], again.reset(seed=3)[0])
    for _ in range(3):
        action = actions(env, rng)
        (*ours, info), (*theirs, other) = env.step(action), again.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]
        assert repr(info) == repr(other)
