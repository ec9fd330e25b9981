"""The backup filter around envs: scalar, in batches, with every way to reset them."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.envs.registered import SystemEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.oracles.carts import cart_problem

KEYS = (
    "nominal_action",
    "safe_action",
    "intervention",
    "filter_active",
    "feasible",
    "slack",
    "slacks",
    "active_barrier",
    "episode_interventions",
    "episode_infeasible",
    "input_bounds",
)


def one(text="backup", **options):
    return SafetyFilterWrapper(_env(**options), text)


def _env(**options):
    problem = cart_problem(**options)

    class Cart(SystemEnv):
        problem_factory = staticmethod(lambda: problem)

    return Cart()


def batch(text="backup", envs=4, engine="numpy", mode="NextStep", **options):
    problem = cart_problem(**options)
    return SafetyFilterVectorWrapper(
        SafeVectorEnv(problem, envs, autoreset_mode=mode, engine=engine), text
    )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_batch_is_kept_safe_through_all_resets(mode):
    env = batch(mode=mode, horizon=2.0)
    env.reset(seed=0)
    interventions = 0
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(np.ones((4, 1)))
        assert set(KEYS) <= set(info)
        assert not info["violation"].any()
        assert info["feasible"].all()
        interventions += info["intervention"].sum()
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            env.reset(options={"reset_mask": ended})
    assert interventions > 0


def test_a_scalar_env_plays_the_episodes_of_a_batch():
    envs, alone = batch(envs=1), one()
    envs.reset(seed=5)
    alone.reset(seed=5)
    assert np.array_equal(envs.unwrapped.components[0], [alone.unwrapped.components[0]])
    for _ in range(50):
        together, single = envs.step(np.ones((1, 1)))[-1], alone.step(np.ones(1))[-1]
        for key in KEYS:
            np.testing.assert_allclose(together[key][0], single[key], atol=1e-9, err_msg=key)
    assert single["episode_interventions"] > 0
    assert single["h_min"] > 0.0


def test_it_remembers_nothing():
    env = batch()
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.ones((4, 1)))
    kept = env.snapshot()
    first = [env.step(np.ones((4, 1)))[-1]["safe_action"] for _ in range(5)]
    env.restore(kept)
    again = [env.step(np.ones((4, 1)))[-1]["safe_action"] for _ in range(5)]
    assert np.array_equal(first, again)


def test_settings_and_filters_are_taken_as_well_as_text():
    problem = cart_problem()
    for given in (
        "backup:horizon=3",
        BackupSettings(horizon=3.0),
        BackupFilter.for_problem(problem, "backup:horizon=3"),
    ):
        env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 2), given)
        env.reset(seed=0)
        assert env.step(np.ones((2, 1)))[-1]["feasible"].all()
        assert env.safety_filter.text == "backup:horizon=3.0"


def test_a_filter_of_another_problem_is_refused():
    given = BackupFilter.for_problem(cart_problem(dt=0.05))
    with pytest.raises(ConfigurationError, match="control period"):
        SafetyFilterVectorWrapper(SafeVectorEnv(cart_problem(), 2), given)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"priorities": [1.0]}, "priorities are of conditions; the backup filter"),
        ({"objective": "clf"}, "the backup filter takes the input nearest"),
        ({"observe_promise": True}, "the filter backup has no p_k"),
        ({"delay": 2}, "backup filters are not for a delay"),
    ],
)
def test_arguments_of_other_filters_are_refused(options, words):
    with pytest.raises(ConfigurationError, match=words):
        SafetyFilterVectorWrapper(SafeVectorEnv(cart_problem(), 2), "backup", **options)


def test_an_env_without_a_backup_says_how_to_give_one():
    with pytest.raises(ConfigurationError, match=r"Scalar states no backup.*BackupLaw"):
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "backup")
