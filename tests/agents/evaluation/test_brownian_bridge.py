"""The smallest h between control instants, against the exact laws of Brownian motion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.stats import kstest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials, bridge_notes
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.policies.nominal import RandomPolicy
from safe_envs.dynamics.noise import (
    BRIDGE,
    POLICY,
    StreamReader,
    episode_seeds,
    standard_exponentials,
)
from tests.oracles.laws import X, brownian, first_passage, walk_passage

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("before", "after"), [(1.0, 0.4), (0.2, 0.9), (0.3, 0.3), (0.1, -0.2)])
def test_minimum_has_the_law_of_a_brownian_bridge(before, after):
    dt, sigma, count = 0.05, 1.5, 20_000
    bridge = BrownianBridge(brownian(dt, 1.0, 0.0, sigma))
    first, last = (np.full((count, 1), value) for value in (before, after))
    lowest = bridge.sample_minimum(
        (np.zeros(count),), first, last, np.random.default_rng(0).standard_exponential((count, 1))
    )

    def law(y):
        return np.where(
            y < min(before, after), np.exp(-2 * (before - y) * (after - y) / (sigma**2 * dt)), 1.0
        )

    assert kstest(lowest[:, 0], law).pvalue > 0.01


def test_variance_is_that_of_the_beginning_of_the_period():
    problem = make_problem("safe_envs/CubicSDE-v0", noise=0.3)
    bridge, x = BrownianBridge(problem), (np.array([0.5, -1.0]), np.array([0.2, 0.8]))
    h = problem.barriers[0].expression
    points: list[Any] = [
        dict(zip(problem.plant.states, point, strict=True)) for point in np.stack(x, axis=1)
    ]
    row = sp.Matrix([h]).jacobian(problem.plant.states) * problem.plant.numeric(
        problem.plant.diffusion
    )
    rate = [float((row * row.T)[0, 0].subs(point)) for point in points]
    before, after, draws = (
        np.array([[0.3], [0.2]]),
        np.array([[0.25], [0.4]]),
        np.array([[0.7], [1.1]]),
    )
    wanted = 0.5 * (
        before
        + after
        - np.sqrt((after - before) ** 2 + 2 * np.array(rate)[:, None] * problem.dt * draws)
    )
    assert bridge.sample_minimum(x, before, after, draws) == pytest.approx(wanted)
    assert bridge.barriers(x)[:, 0] == pytest.approx([float(h.subs(point)) for point in points])


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "episodes"), [(0.05, 4000), (0.02, 6000)])
def test_discrete_rate_flatters_and_continuous_rate_is_exact(dt, episodes):
    drift, sigma, horizon = 0.4, 0.5, 1.0
    problem = brownian(dt, horizon, drift, sigma)
    exact = 1 - first_passage(1.0, drift, sigma, horizon)
    seen = 1 - walk_passage(1.0, round(horizon / dt), drift * dt, sigma * math.sqrt(dt))
    arguments = {
        "filters": ["none"],
        "episodes": episodes,
        "seed": 2,
        "confidence": 0.99,
        "bounds": False,
    }
    discrete, continuous = (
        evaluate(problem, monitoring=m, **arguments).rows[0] for m in ("discrete", "continuous")
    )
    assert exact < discrete.ci_low < seen < discrete.ci_high
    assert continuous.ci_low < exact < continuous.ci_high < seen


def test_control_and_noise_are_those_of_discrete_monitoring():
    arguments = {
        "filters": ["none", "scbf"],
        "episodes": 150,
        "seed": 2,
        "bounds": False,
        "record": True,
    }
    options = {"horizon": 1.0, "noise": 0.3, "dt": 0.05, "start": [-0.1, 0.5]}
    discrete, continuous = (
        evaluate("CubicSDEDisk-v0", options=options, monitoring=m, **arguments)
        for m in ("discrete", "continuous")
    )
    for first, second in zip(discrete.rows, continuous.rows, strict=True):
        assert first.return_mean == second.return_mean
        assert second.safe < first.safe
        assert second.min_h_median < first.min_h_median
        assert second.curve.safe[-1] == second.safe
        name = first.filter
        assert (
            discrete.trajectories[name].barrier.tobytes()
            == continuous.trajectories[name].barrier.tobytes()
        )
        # Whoever violates at an instant violates.
        late, early = (each.episodes[name][0].safe for each in (continuous, discrete))
        assert not (late & ~early).any()
    assert (discrete.config["monitoring"], continuous.config["monitoring"]) == (
        "discrete",
        "continuous",
    )


def test_answer_is_the_same_for_every_num_envs():
    # More control periods than there are numbers drawn ahead, and episodes that end early.
    arguments = {
        "options": {"horizon": 3.0, "noise": 0.6},
        "filters": ["none"],
        "episodes": 8,
        "bounds": False,
        "monitoring": "continuous",
    }
    first, *others = (evaluate("Scalar-v0", num_envs=n, **arguments) for n in (8, 1, 3))
    for other in others:
        assert first.rows == other.rows


def test_bridges_and_policies_draw_from_the_streams_of_their_episodes():
    """More control periods than there are numbers drawn ahead."""
    policy, periods = RandomPolicy(make_problem("Quadrotor-v0")), 400
    policy.begin(range(2, 5), 7)
    exponentials = Exponentials(episode_seeds(7, range(2, 5)), 3)
    actions = np.stack([policy.predict(np.zeros((3, 15)))[0] for _ in range(periods)], axis=1)
    drawn = np.stack([exponentials.next() for _ in range(periods)], axis=1)
    reader = StreamReader()
    for row, episode in enumerate(range(2, 5)):
        key = (episode_seed(7, episode), 0)
        uniforms = reader.seek(key, 0, POLICY).uniforms((periods, actions.shape[2]))
        np.testing.assert_array_equal(actions[row], 2.0 * uniforms - 1.0)
        uniforms = reader.seek(key, 0, BRIDGE).uniforms((periods, 3))
        np.testing.assert_array_equal(drawn[row], standard_exponentials(uniforms))


def test_without_noise_in_h_nothing_changes_and_a_note_says_so():
    problem = make_problem("safe_envs/ACC-v0", noise=0.0, horizon=1.0)
    (note,) = bridge_notes(problem)
    assert "no noise reaches" in note
    rows = [
        evaluate(problem, filters=["none"], episodes=4, monitoring=m).rows
        for m in ("discrete", "continuous")
    ]
    assert rows[0] == rows[1]
    assert bridge_notes(make_problem("safe_envs/ACC-v0")) == []


@pytest.mark.slow
def test_several_barriers_have_bridges_of_their_own():
    # Two walls, so far apart that a path does not meet both: the probabilities add.
    problem = brownian(0.1, 1.0, 0.0, 0.5, [1 - X, 1 + X])
    (note,) = bridge_notes(problem)
    assert "independently" in note
    row = evaluate(
        problem,
        filters=["none"],
        episodes=6000,
        monitoring="continuous",
        confidence=0.99,
        bounds=False,
    ).rows[0]
    assert row.ci_low < 1 - 2 * first_passage(1.0, 0.0, 0.5, 1.0) < row.ci_high


def test_unknown_word_and_third_party_env_are_refused():
    with pytest.raises(ConfigurationError, match="did you mean 'continuous'"):
        evaluate("Scalar-v0", monitoring="continous")
    place = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"
    with pytest.raises(ConfigurationError, match="unknown"):
        evaluate("Pendulum-v1", filter_spec=place, monitoring="continuous", episodes=2)
