"""Costs are stored with the steps that they belong to, and sampled with them."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from safe_envs import ConfigurationError
from safe_envs.agents.training.replay_buffer import FilteredNStepReplayBuffer, FilteredReplayBuffer
from safe_envs.agents.training.sac_lagrangian import (
    CostReplayBuffer,
    FilteredCostReplayBuffer,
    with_costs,
)

SPACES = (gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Box(-1.0, 1.0, (1,)))
ENVS = 3
BOX = ((0.0, 4.0),)


def fill(buffer, steps, first=0):
    """Add steps whose numbers tell step and env: 10 k + i."""
    for k in range(first, first + steps):
        number = 10.0 * k + np.arange(ENVS)
        observations = np.stack([number, number], axis=1)
        infos = [
            {"cost": n, "safe_action": np.array([4.0]), "nominal_action": np.array([1.0])}
            for n in number.tolist()
        ]
        buffer.add(
            observations,
            observations + 0.5,
            np.full((ENVS, 1), -0.5, dtype=np.float32),
            -number,
            np.zeros(ENVS, dtype=bool),
            infos,
        )
    return buffer


def plain(kind=CostReplayBuffer, rows=7, **arguments):
    return kind(rows * ENVS, *SPACES, device="cpu", n_envs=ENVS, **arguments)


@pytest.mark.parametrize("steps", [5, 7, 12])
@pytest.mark.parametrize("small", [False, True])
def test_costs_are_those_of_the_sampled_steps(steps, small):
    memory = {"optimize_memory_usage": True, "handle_timeout_termination": False} if small else {}
    buffer = fill(plain(**memory), steps)
    np.random.seed(4)  # noqa: NPY002
    steps, costs = buffer.sample(200), buffer.last_sample().costs
    assert buffer.last_sample().steps is steps
    assert costs.shape == (200, 1)
    np.testing.assert_array_equal(costs, -steps.rewards)
    np.testing.assert_array_equal(costs[:, 0], steps.observations[:, 0])
    assert len(set(costs.ravel().tolist())) > ENVS


def test_it_draws_what_stable_baselines3_draws():
    batches, left = [], []
    for kind in (ReplayBuffer, CostReplayBuffer):
        buffer = fill(plain(kind), 9)
        np.random.seed(4)  # noqa: NPY002
        batches.append([buffer.sample(16) for _ in range(3)])
        left.append(np.random.random())  # noqa: NPY002
    for theirs, ours in zip(*batches, strict=True):
        for a, b in zip(theirs, ours, strict=True):
            assert (a is None and b is None) or (a == b).all()
    assert left[0] == left[1]


@pytest.mark.parametrize(
    ("action", "rows", "actions"),
    [("executed", 1, [1.0]), ("proposed", 1, [-0.5]), ("both", 2, [1.0, -0.5])],
)
def test_a_filtered_step_has_its_cost_in_each_row(action, rows, actions):
    buffer = fill(plain(FilteredCostReplayBuffer, box=BOX, action=action), 2)
    assert buffer.pos == 2 * rows
    np.testing.assert_array_equal(
        buffer.costs[: 2 * rows], np.repeat([[0, 1, 2], [10, 11, 12]], rows, axis=0)
    )
    np.testing.assert_array_equal(buffer.actions[:rows, 0, 0], actions)


def test_classes_have_a_counterpart_with_costs():
    assert with_costs(ReplayBuffer) is CostReplayBuffer
    assert with_costs(FilteredReplayBuffer) is FilteredCostReplayBuffer
    assert with_costs(FilteredCostReplayBuffer) is FilteredCostReplayBuffer
    for kind in (NStepReplayBuffer, FilteredNStepReplayBuffer):
        with pytest.raises(ConfigurationError, match="n_steps = 1"):
            with_costs(kind)


def test_a_step_without_cost_is_an_error_and_there_is_no_batch_before_the_first():
    buffer = plain()
    step = np.zeros((ENVS, 2)), np.zeros((ENVS, 2)), np.zeros((ENVS, 1)), np.zeros(ENVS)
    with pytest.raises(ConfigurationError, match="cost"):
        buffer.add(*step, np.zeros(ENVS, dtype=bool), [{"cost": 0.0}, {}, {"cost": 1.0}])
    with pytest.raises(ConfigurationError, match="sample"):
        buffer.last_sample()
