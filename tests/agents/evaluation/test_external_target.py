"""Evaluations of envs that know nothing of this project, through a filter's spec."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from typer.testing import CliRunner

from safe_envs.agents import evaluate
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.cli import app
from safe_envs.wrappers import FilterSpec, SafetyFilterWrapper

pytestmark = pytest.mark.slow

PLACE = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"
SPEC = FilterSpec.load(PLACE)
FEW = {"filter_spec": SPEC, "episodes": 4}


def test_the_filter_of_the_spec_makes_the_difference():
    bare, filtered = evaluate("Pendulum-v1", **FEW).rows
    assert (bare.safe, filtered.safe) == (0, 4)
    assert filtered.filter == SPEC.filter
    assert filtered.continuous_bound is None
    assert "may differ from the model" in filtered.continuous_note


def test_the_rate_is_that_of_episodes_played_by_hand():
    (row,) = evaluate("Pendulum-v1", "zero", ["cbf:alpha=1"], **FEW).rows
    env = SafetyFilterWrapper(
        gym.make("Pendulum-v1"),
        "cbf:alpha=1",
        model=SPEC.model,
        barriers=SPEC.barriers,
        state_fn=SPEC.state_fn,
    )
    from safe_envs.agents.evaluation.episodes import episode_seed

    smallest, returns = [], []
    for i in range(4):
        env.reset(seed=episode_seed(0, i))
        total, truncated, info = 0.0, False, {}
        while not truncated:
            _, reward, _, truncated, info = env.step([0.0])
            total += float(reward)
        smallest.append(info["h_min"])
        returns.append(total)
    assert row.safe == sum(h > 0 for h in smallest)
    assert row.min_h_median == pytest.approx(np.median(smallest))
    assert row.return_mean == pytest.approx(np.mean(returns))


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["nominal", "random"])
def test_the_answer_does_not_depend_on_the_size_of_the_batch(policy):
    one, many = (evaluate("Pendulum-v1", policy, num_envs=n, **FEW) for n in (1, 3))
    assert one.rows == many.rows


def test_an_agent_of_stable_baselines3_is_evaluated_behind_the_filter(tmp_path):
    env = SafetyFilterWrapper(
        gym.make("Pendulum-v1"),
        SPEC.filter,
        model=SPEC.model,
        barriers=SPEC.barriers,
        state_fn=SPEC.state_fn,
    )
    model = PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    model.save(tmp_path / "agent.zip")
    found = evaluate("Pendulum-v1", str(tmp_path / "agent.zip"), trust=True, **FEW)
    assert found.rows[1].safe == 4
    with pytest.raises(ConfigurationError, match="another observation space"):
        evaluate("safe_envs/Scalar-v0", str(tmp_path / "agent.zip"), trust=True, episodes=2)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"filters": ["bayesian-scbf"]}, "learned from a log"),
        ({"policy": "clf"}, "Lyapunov"),
        ({"engine": "compiled"}, "third-party env, which only its own code can step"),
        ({"knowledge": "plant"}, "nothing is known but the model"),
        ({"options": {"noise": 0.1}}, "without noise"),
        ({"problem": "safe_envs/Pendulum-v0"}, "barriers of its own"),
        ({"filter_spec": "nowhere.py:spec"}, "there is no file"),
        ({"filter_spec": PLACE.replace(":spec", ":pendulum")}, "give a FilterSpec"),
    ],
)
def test_what_does_not_fit_is_explained(arguments, says):
    with pytest.raises(ConfigurationError, match=says):
        evaluate(**{"problem": "Pendulum-v1", "filter_spec": SPEC, "episodes": 2, **arguments})


def test_inverted_pendulum_of_mujoco_where_it_is_installed():
    pytest.importorskip("mujoco")
    import sympy as sp

    from safe_envs import ControlAffineSDE

    # The mass of the cart and the pole make an input of 1 (times the gear of 100 N) accelerate the
    # cart by about 9.8 m/s^2.
    q, angle, v, w, a = sp.symbols("q angle v w a", real=True)
    model = ControlAffineSDE(
        (q, angle, v, w), (a,), [v, w, 0, 24 * angle], [0, 0, 9.8, -22.0], [0, 0, 0, 0]
    )
    spec = FilterSpec(model, 0.15**2 - angle**2, lambda o: o[..., :4], gains=(6.0, 6.0))
    bare, filtered = evaluate("InvertedPendulum-v5", "zero", filter_spec=spec, episodes=3).rows
    assert filtered.min_h_median > bare.min_h_median


def test_the_command_prints_the_table():
    result = CliRunner().invoke(
        app, ["evaluate", "Pendulum-v1", "--filter-spec", PLACE, "--episodes", "2"]
    )
    assert result.exit_code == 0, result.output
    assert (
        f"seen through {PLACE}, dt = 0.05 s, horizon 10 s; filters know the model" in result.output
    )
