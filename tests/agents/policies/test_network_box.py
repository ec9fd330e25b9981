"""Trained policies in envs with another physical box."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC

from safe_envs.agents import make_policy, make_problem
from safe_envs.agents.policies.network import save_policy
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.filters.learning.data import load

DUBINS, QUADROTOR = "safe_envs/StochasticDubins-v0", "safe_envs/Quadrotor-v0"
BOXES = {DUBINS: (-10.0, 10.0), QUADROTOR: [(0.0, 20.0), (-1.0, 1.0), (-0.5, 1.0), (-0.1, 0.1)]}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(
    scope="module",
    params=[(DUBINS, PPO, {}), (QUADROTOR, SAC, {"buffer_size": 10})],
    ids=["ppo, m = 1", "sac, m = 4"],
)
def trained(request, tmp_path_factory):
    """A policy whose actions vary and reach their bounds: the env's id and the folder."""
    env_id, algorithm, arguments = request.param
    folder = tmp_path_factory.mktemp("trained")
    model = algorithm(
        "MlpPolicy", gym.make(env_id, box=BOXES[env_id]), device="cpu", seed=0, **arguments
    )
    last = model.policy.action_net if algorithm is PPO else model.policy.actor.mu
    with torch.no_grad():
        last.weight.mul_(300.0 if algorithm is PPO else 30.0)
    save_policy(model, folder, make_problem(env_id, box=BOXES[env_id]))
    return env_id, folder


def box_of(trained):
    """The box of the training, shape (m, 2)."""
    return np.array(make_problem(trained[0], box=BOXES[trained[0]]).box)


def actions_in(trained, box):
    """What the policy does in a box: actions, and the inputs for which they stand there."""
    env_id, folder = trained
    problem = make_problem(env_id, box=box.tolist())
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    given = np.random.default_rng(0).uniform(low, high, (300, len(low))).astype(np.float32)
    actions = make_policy(str(folder), problem).predict(given)[0]
    center, half = center_and_half_width(problem)
    return actions, center + np.array(half) * actions


@pytest.mark.parametrize(
    "change",
    [
        lambda low, high: (low + 0.45 * (high - low), high - 0.15 * (high - low)),
        lambda low, high: (3.0 * low - 1.0, 2.0 * high),
        lambda low, high: (high, high + 1.0),
    ],
    ids=["narrower", "wider", "beside"],
)
def test_another_box_gets_the_same_inputs_or_the_nearest_ones(trained, change):
    low, high = box_of(trained).T
    least, most = change(low, high)
    _, wanted = actions_in(trained, box_of(trained))
    actions, found = actions_in(trained, np.transpose([least, most]))
    assert (actions.dtype, actions.shape) == (np.float32, wanted.shape)
    assert np.abs(actions).max() <= 1.0
    assert (np.ptp(wanted, axis=0) > 0.8 * (high - low)).all()
    np.testing.assert_allclose(
        found, np.clip(wanted, least, most), rtol=0, atol=1e-6 * (high - low).max()
    )


def test_the_env_executes_the_same_input(trained):
    reached = []
    for box in (BOXES[trained[0]], (-20.0, 30.0)):
        env = gym.make(trained[0], box=box)
        observation, _ = env.reset(seed=0)
        before = env.unwrapped.state  # pyright: ignore[reportAttributeAccessIssue]
        policy = make_policy(str(trained[1]), make_problem(trained[0], box=box))
        env.step(policy.predict(observation)[0])
        reached.append(env.unwrapped.state - before)  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(reached[1], reached[0], rtol=0, atol=1e-6)


def test_an_input_with_the_same_range_keeps_its_actions(trained):
    box = box_of(trained)
    wanted, _ = actions_in(trained, box)
    box[0] *= 1.5
    found, _ = actions_in(trained, box)
    np.testing.assert_allclose(found[:, 1:], wanted[:, 1:], rtol=0, atol=1e-7)
    assert np.abs(found[:, 0] - wanted[:, 0]).max() > 0.1


def test_the_description_holds_the_box_of_the_training(trained):
    found = load(trained[1] / "policy.npz").details
    assert found["box"] == box_of(trained).tolist()
