"""Action spaces that know the inputs at their ends."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import safe_envs  # noqa: F401  (registers the envs)
from safe_envs.plugins import load_object
from safe_envs.wrappers import ActionMap, SafetyFilterVectorWrapper, SafetyFilterWrapper
from safe_envs.wrappers.filter_layers import ends_of

ENV_ID = "safe_envs/StochasticDubins-v0"


def test_filtered_envs_know_their_bounds():
    inner = gym.make(ENV_ID, box=(-3.0, 5.0))
    space = SafetyFilterWrapper(inner, "scbf").action_space
    assert (space.at_low.tolist(), space.at_high.tolist()) == ([-3.0], [5.0])
    assert space == inner.action_space
    assert inner.action_space == space
    assert repr(space) == repr(inner.action_space)
    # Whoever loads it does not need this package.
    data = pickle.dumps(space)
    assert b"safe_envs" not in data
    for again in (pickle.loads(data), copy.deepcopy(space)):
        assert type(again) is gym.spaces.Box
        assert [end.tolist() for end in ends_of(again)] == [[-3.0], [5.0]]
    assert ends_of(inner.action_space) is None
    envs = SafetyFilterVectorWrapper(gym.make_vec(ENV_ID, 3, box=(-3.0, 5.0)), "scbf")
    assert envs.single_action_space.at_low.tolist() == [-3.0]
    assert envs.action_space.shape == (3, 1)


@pytest.mark.parametrize(
    ("actions", "ends"),
    [
        (None, ([-2.0], [2.0])),
        (ActionMap.scaled(-3.0, 1.0), ([7.0], [-5.0])),
        (ActionMap(np.sinh, np.arcsinh), None),
    ],
)
def test_third_party_maps(actions, ends):
    spec = load_object("examples/pendulum_v1.py:spec")
    env = SafetyFilterWrapper(
        gym.make("Pendulum-v1"),
        "cbf:alpha=2",
        model=spec.model,
        barriers=spec.barriers,
        state_fn=spec.state_fn,
        action_map=actions,
    )
    if ends is None:
        assert ends_of(env.action_space) is None
    else:
        assert tuple(end.tolist() for end in ends_of(env.action_space)) == ends
