"""Rates of an evaluation, at control instants and between them, against exact laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp
from scipy.stats import kstest, norm

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import RandomPolicy, evaluate, make_problem
from safe_envs.agents.evaluation.brownian_bridge import Exponentials, bridge_notes
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.statistics import wilson_interval
from safe_envs.dynamics.noise import (
    BRIDGE,
    EPISODE,
    NOISE,
    POLICY,
    START,
    StreamReader,
    episode_seeds,
    key_of,
    standard_exponentials,
)
from tests.agents.evaluation.evaluated import Constant, Levelling
from tests.oracles.laws import X, brownian, first_passage, survival, walk_passage

pytestmark = pytest.mark.slow

PLAIN = {"filters": ["none"], "bounds": False}


@pytest.mark.parametrize("scheme", ["policy", "filter"])
def test_gaussian_law_of_adaptive_cruise_control(scheme):
    # A h = 0 makes h_t = h_0 - tau sigma_1 W_t; an Euler-Maruyama step keeps that exactly. In one
    # case a policy holds A h at 0, in the other the scbf holds a policy back that only wants to
    # drive faster.
    tau, sigma, dt, horizon, distance, episodes = 1.8, 1.0, 0.1, 10.0, 5.0, 4000
    options = {
        "start": [15.0, 20.0, tau * 15 + distance],
        "input_bounds": [-1e5, 1e5],
        "horizon": horizon,
        "noise": sigma,
        "dt": dt,
    }
    problem = make_problem("ACC-v0", **options)
    policy, name = (
        (Levelling(problem, tau), "none") if scheme == "policy" else (Constant(1.0), "scbf")
    )
    (row,) = evaluate(problem, policy, name, episodes=episodes, seed=1, bounds=False).rows
    steps, deviation = round(horizon / dt), tau * sigma * math.sqrt(dt)
    low, high = wilson_interval(row.safe, row.episodes, 0.999)
    assert low <= survival(distance, steps, 1.0, deviation) <= high
    # The distribution of the smallest h, from the same law at other levels.
    for key, level in (("min_h_median", 0.5), ("min_h_p05", 0.05)):
        below = 1.0 - survival(distance - getattr(row, key), steps, 1.0, deviation)
        assert below == pytest.approx(level, abs=4.0 * math.sqrt(level * (1 - level) / episodes))
    if scheme == "filter":
        assert (row.intervention_rate, row.infeasible_rate) == (1.0, 0.0)


def test_law_of_the_scalar_system():
    # The nominal controller makes dh = -h dt + sigma dW, symmetric about the edge: P(safe) = 2
    # Phi(mean/deviation) - 1 in continuous time by reflection, and by quadrature at the control
    # instants.
    sigma, dt, horizon, distance = 0.8, 0.01, 0.6, 0.5
    options = {"start": [1 - distance], "noise": sigma, "horizon": horizon, "dt": dt}
    options["input_bounds"] = [-100.0, 100.0]
    (row,) = evaluate("Scalar-v0", options=options, episodes=8000, seed=2, **PLAIN).rows
    mean = distance * math.exp(-horizon)
    deviation = sigma * math.sqrt((1 - math.exp(-2 * horizon)) / 2)
    continuous = 2 * norm.cdf(mean / deviation) - 1
    exact = survival(distance, round(horizon / dt), 1 - dt, sigma * math.sqrt(dt))
    assert continuous < exact < continuous + 0.1
    low, high = wilson_interval(row.safe, row.episodes, 0.999)
    assert low <= exact <= high


def test_discrete_rate_flatters_and_continuous_rate_is_exact():
    dt, drift, sigma, horizon = 0.05, 0.4, 0.5, 1.0
    problem = brownian(dt, horizon, drift, sigma)
    exact = 1 - first_passage(1.0, drift, sigma, horizon)
    seen = 1 - walk_passage(1.0, round(horizon / dt), drift * dt, sigma * math.sqrt(dt))
    given = {"episodes": 4000, "seed": 2, "confidence": 0.99, **PLAIN}
    discrete, continuous = (
        evaluate(problem, monitoring=m, **given) for m in ("discrete", "continuous")
    )
    assert exact < discrete.rows[0].ci_low < seen < discrete.rows[0].ci_high
    assert continuous.rows[0].ci_low < exact < continuous.rows[0].ci_high < seen
    # Not the rate alone: the smallest h has the law of first passages at every level.
    lowest = continuous.episode_columns()["min_h"]
    law = np.vectorize(lambda y: first_passage(1.0 - y, drift, sigma, horizon) if y < 1 else 1.0)
    assert kstest(lowest, law).pvalue > 0.01


def test_between_instants_the_variance_is_that_of_the_beginning_of_the_period():
    # One period of two channels: h of its end is known for each noise, and its minimum given both
    # ends is that of a Brownian bridge.
    x, y, u = sp.symbols("x y u", real=True)
    diffusion = [[0.3 + 0.5 * x, 0.2], [0.1, 0.4 * y]]
    system = ControlAffineSDE((x, y), (u,), [0, 0], [1, 0], diffusion)
    at, dt = {x: 0.5, y: -0.6}, 0.2
    problem = define_problem(
        system,
        1 - x**2 - y**2,
        input_bounds=(-1.0, 1.0),
        start=[0.5, -0.6],
        dt=dt,
        horizon=dt,
        nominal=0,
        workspace={x: (-9.0, 9.0), y: (-9.0, 9.0)},
    )
    given = {"episodes": 2000, "monitoring": "continuous", **PLAIN}
    lowest = evaluate(problem, **given).episode_columns()["min_h"]
    nodes, weights = np.polynomial.hermite_e.hermegauss(48)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    noise = np.array(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    matrix = np.array(sp.Matrix(diffusion).subs(at), dtype=float)
    state = np.array([[0.5], [-0.6]]) + math.sqrt(dt) * matrix @ noise
    before, after = 1 - 0.25 - 0.36, 1 - (state**2).sum(axis=0)
    rate = float(((np.array([-1.0, 1.2]) @ matrix) ** 2).sum())

    def law(levels):
        gap = np.maximum(after[:, None] - levels, 0.0) * np.maximum(before - levels, 0.0)
        reached = np.exp(-2 * gap / (rate * dt))
        return weights.ravel() @ reached

    assert kstest(lowest, law).pvalue > 0.01


def test_several_barriers_have_bridges_of_their_own():
    # Two walls, so far apart that a path does not meet both: the probabilities add.
    problem = brownian(0.1, 1.0, 0.0, 0.5, [1 - X, 1 + X])
    given = {"episodes": 4000, "monitoring": "continuous", "confidence": 0.99, **PLAIN}
    (row,) = evaluate(problem, **given).rows
    assert row.ci_low < 1 - 2 * first_passage(1.0, 0.0, 0.5, 1.0) < row.ci_high
    assert len(bridge_notes(problem)) == 1


def test_control_and_noise_are_those_of_discrete_monitoring():
    options = {"horizon": 1.0, "noise": 0.3, "dt": 0.05, "start": [-0.1, 0.5]}
    given = {"options": options, "episodes": 100, "seed": 2, "bounds": False, "record": True}
    discrete, continuous = (
        evaluate("CubicSDEDisk-v0", filters=["none", "scbf"], monitoring=m, **given)
        for m in ("discrete", "continuous")
    )
    for first, second in zip(discrete.rows, continuous.rows, strict=True):
        name = first.filter
        assert first.return_mean == second.return_mean
        assert second.safe < first.safe
        assert second.min_h_median < first.min_h_median
        assert second.curve.safe[-1] == second.safe
        for kept in ("barrier", "states"):
            one, other = (getattr(e.trajectories[name], kept) for e in (discrete, continuous))
            assert one.tobytes() == other.tobytes()
        # Whoever violates at an instant violates.
        late, early = (each.episodes[name][0].safe for each in (continuous, discrete))
        assert not (late & ~early).any()


def test_without_noise_in_h_nothing_changes_and_a_note_says_so():
    problem = make_problem("ACC-v0", noise=0.0, horizon=1.0)
    assert len(bridge_notes(problem)) == 1
    assert bridge_notes(make_problem("ACC-v0")) == []
    rows = [
        evaluate(problem, episodes=4, monitoring=m, **PLAIN).rows
        for m in ("discrete", "continuous")
    ]
    assert rows[0] == rows[1]


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
        uniforms = reader.seek(key, 0, POLICY).uniforms((periods, 4))
        np.testing.assert_array_equal(actions[row], 2.0 * uniforms - 1.0)
        uniforms = reader.seek(key, 0, BRIDGE).uniforms((periods, 3))
        np.testing.assert_array_equal(drawn[row], standard_exponentials(uniforms))


def test_the_seed_of_an_episode_depends_on_neither_the_others_nor_the_purpose():
    words = StreamReader().seek(key_of(5), 0, EPISODE).words(40)
    assert episode_seeds(5, range(10)) == words[::4].tolist()
    assert episode_seeds(5, range(3, 7)) == [episode_seed(5, i) for i in range(3, 7)]
    assert episode_seeds(5, range(2, 2)) == []
    assert len({s for seed in range(20) for s in episode_seeds(seed, range(200))}) == 4000
    reader, drawn = StreamReader(), []
    for purpose in (POLICY, NOISE, START, BRIDGE):
        seeds = episode_seeds(0, range(400))
        drawn.append([reader.seek(key_of(s), 0, purpose).uniforms(1)[0] for s in seeds])
    apart = np.corrcoef(drawn) - np.eye(4)
    assert np.abs(apart).max() < 5 / math.sqrt(400)
