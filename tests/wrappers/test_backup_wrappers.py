"""The backup filter around envs."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError, SafeVectorEnv
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.wrappers.cases import MODES, cart_problem


def batch(given="backup", mode="NextStep", **options):
    env = SafeVectorEnv(cart_problem(**options), 4, autoreset_mode=mode)
    return SafetyFilterVectorWrapper(env, given)


@pytest.mark.parametrize("mode", MODES)
def test_a_batch_is_kept_safe_through_all_resets(mode):
    env = batch(mode=mode, horizon=2.0)
    env.reset(seed=0)
    interventions = 0
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(np.ones((4, 1)))
        assert not info["violation"].any()
        assert info["feasible"].all()
        interventions += info["intervention"].sum()
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            env.reset(options={"reset_mask": ended})
    assert interventions > 0


@pytest.mark.parametrize(
    "given", ["backup:horizon=3", BackupSettings(horizon=3.0), "a filter of its own"]
)
def test_settings_and_filters_are_taken_as_well_as_text(given):
    if given == "a filter of its own":
        given = BackupFilter.for_problem(cart_problem(), "backup:horizon=3")
    env = batch(given)
    env.reset(seed=0)
    assert env.step(np.ones((4, 1)))[-1]["feasible"].all()
    assert env.safety_filter.text == "backup:horizon=3.0"


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: batch(BackupFilter.for_problem(cart_problem(dt=0.05))), "control period"),
        *(
            (
                lambda given=given: SafetyFilterVectorWrapper(
                    SafeVectorEnv(cart_problem(), 2), "backup", **given
                ),
                fragment,
            )
            for given, fragment in (
                ({"priorities": [1.0]}, "priorities"),
                ({"objective": "clf"}, "nearest"),
                ({"observe_promise": True}, "p_k"),
                ({"delay": 2}, "delay"),
            )
        ),
        (lambda: SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0"), "backup"), "BackupLaw"),
    ],
)
def test_what_does_not_fit_is_refused(make, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make()
