"""Evaluations of envs that know nothing of this project, through a filter's spec."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from stable_baselines3 import PPO

from safe_envs import ControlAffineSDE
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers import FilterSpec, SafetyFilterWrapper

pytestmark = pytest.mark.slow

PLACE = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"
SPEC = FilterSpec.load(PLACE)
FEW = {"filter_spec": SPEC, "episodes": 3}


def filtered(name):
    return SafetyFilterWrapper(
        gym.make("Pendulum-v1"),
        name,
        model=SPEC.model,
        barriers=SPEC.barriers,
        state_fn=SPEC.state_fn,
    )


def test_the_filter_of_the_spec_makes_the_difference():
    bare, row = evaluate("Pendulum-v1", **FEW).rows
    assert (bare.safe, row.safe) == (0, 3)
    assert (row.filter, row.continuous_bound) == (SPEC.filter, None)
    assert "may differ from the model" in row.continuous_note


def test_the_rate_is_that_of_episodes_played_by_hand_in_batches_of_any_size():
    rows = [
        evaluate("Pendulum-v1", "zero", ["cbf:alpha=1"], num_envs=n, **FEW).rows for n in (1, 3)
    ]
    assert rows[0] == rows[1]
    env, smallest, returns = filtered("cbf:alpha=1"), [], []
    for i in range(3):
        env.reset(seed=episode_seed(0, i))
        total, truncated, info = 0.0, False, {}
        while not truncated:
            _, reward, _, truncated, info = env.step([0.0])
            total += float(reward)
        smallest.append(info["h_min"])
        returns.append(total)
    ((row,), _) = rows
    assert row.safe == sum(h > 0 for h in smallest)
    assert row.min_h_median == pytest.approx(np.median(smallest))
    assert row.return_mean == pytest.approx(np.mean(returns))


def test_an_agent_of_stable_baselines3_is_evaluated_behind_the_filter(tmp_path):
    env = filtered(SPEC.filter)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.save(tmp_path / "agent.zip")
    found = evaluate("Pendulum-v1", str(tmp_path / "agent.zip"), trust=True, **FEW)
    assert found.rows[1].safe == 3
    with pytest.raises(ConfigurationError, match="observation space"):
        evaluate("safe_envs/Scalar-v0", str(tmp_path / "agent.zip"), trust=True, episodes=2)


def test_inverted_pendulum_of_mujoco_where_it_is_installed():
    pytest.importorskip("mujoco")
    # The mass of the cart and the pole make an input of 1 (times the gear of 100 N) accelerate the
    # cart by about 9.8 m/s^2.
    q, angle, v, w, a = sp.symbols("q angle v w a", real=True)
    model = ControlAffineSDE(
        (q, angle, v, w), (a,), [v, w, 0, 24 * angle], [0, 0, 9.8, -22.0], [0, 0, 0, 0]
    )
    spec = FilterSpec(model, 0.15**2 - angle**2, lambda o: o[..., :4], gains=(6.0, 6.0))
    bare, row = evaluate("InvertedPendulum-v5", "zero", filter_spec=spec, episodes=3).rows
    assert row.min_h_median > bare.min_h_median
