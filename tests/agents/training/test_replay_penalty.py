"""To which actions a penalty on interventions belongs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from safe_envs.agents.training.replay_buffer import replay_options
from safe_envs.agents.training.vec_env import make_sb3_env
from tests.agents.training.test_replay_buffer import (
    BOX,
    ENV_ID,
    View,
    add,
    buffer_of,
    learned,
    stored,
)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


def test_each_env_gets_its_own_penalty_back():
    given = {"safe_action": np.array([2.0, 1.0])}
    batch = {"intervention_penalty": np.array([0.5, 1.0, 2.0]), "safe_action": np.full((3, 2), 1.0)}
    for infos, own in (
        ([{**given, "intervention_penalty": 0.5}, {}, given], [3.5, 3.0, 3.0]),
        ([View(batch, k) for k in (0, 2, 1)], [3.5, 5.0, 4.0]),
        ([View({}, k, **given, intervention_penalty=float(k)) for k in range(3)], [3.0, 4.0, 5.0]),
        ([given] * 3, [3.0] * 3),
    ):
        buffer = buffer_of()
        add(buffer, infos, rewards=[3.0] * 3)
        assert buffer.rewards[0].tolist() == own


def filled(penalty, action="executed", n_steps=1, kind=None):
    """A buffer after episodes of random actions under a penalty on interventions, fed with native
    infos or those of another kind."""
    env = make_sb3_env(
        ENV_ID, 3, "scbf", intervention_penalty=penalty, horizon=0.25, box=BOX, seed=0
    )
    options = replay_options(env, action, n_steps, gamma=0.9)
    spaces = (env.observation_space, env.action_space)
    buffer = options["replay_buffer_class"](
        300, *spaces, device="cpu", n_envs=3, **options["replay_buffer_kwargs"]
    )
    last = env.reset()
    for proposed in np.random.default_rng(0).uniform(-1.0, 1.0, (24, 3, 1)).astype(np.float32):
        observations, rewards, dones, infos = env.step(proposed)
        buffer.add(
            last,
            observations,
            proposed,
            rewards,
            dones,
            [kind(info) for info in infos] if kind else infos,
        )
        last = observations
    return buffer


@pytest.mark.parametrize("kind", [None, dict], ids=["native", "dicts"])
def test_a_penalty_belongs_to_the_proposal(kind):
    own, penalised, executed, both = (
        buffer.rewards[: buffer.size()]
        for buffer in (
            filled(0.0),
            filled(2.0, "proposed"),
            filled(2.0, kind=kind),
            filled(2.0, "both", kind=kind),
        )
    )
    assert np.any(own - penalised > 0.1)
    np.testing.assert_allclose(executed, own, rtol=1e-5, atol=1e-6)
    assert both[0::2].tobytes() == executed.tobytes()
    assert both[1::2].tobytes() == penalised.tobytes()


@pytest.mark.parametrize("kind", [None, dict], ids=["native", "dicts"])
def test_n_step_returns_of_executed_actions_are_without_the_penalty(kind):
    def returns(buffer):
        np.random.seed(0)  # noqa: NPY002  (of which Stable-Baselines3 samples)
        return buffer.sample(200).rewards.numpy()

    free, executed, proposed = (
        returns(filled(c, action, 3, kind))
        for c, action in ((0.0, "executed"), (2.0, "executed"), (2.0, "proposed"))
    )
    np.testing.assert_allclose(executed, free, rtol=1e-5, atol=1e-6)
    assert np.any(free - proposed > 0.1)


def test_penalties_pass_through_the_wrappers():
    env = VecNormalize(
        VecMonitor(make_sb3_env(ENV_ID, 3, "scbf", intervention_penalty=2.0, horizon=0.25, box=BOX))
    )
    model, _ = learned(SAC, env, **replay_options(env, "both"))
    rewards = model.replay_buffer.rewards[: model.replay_buffer.size()]
    distances = np.abs(stored(model)[0::2] - stored(model)[1::2])[..., 0]
    assert np.any(distances > 0.1)
    np.testing.assert_allclose(rewards[0::2] - rewards[1::2], 2.0 * distances, atol=1e-5)
