"""Rates of an evaluation against exact laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from safe_envs.agents import RandomPolicy, evaluate, make_problem
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.statistics import wilson_interval
from safe_envs.dynamics.noise import (
    BRIDGE,
    EPISODE,
    NOISE,
    START,
    StreamReader,
    episode_seeds,
    key_of,
)
from tests.agents.evaluation.evaluated import Constant, Levelling
from tests.oracles.laws import survival

pytestmark = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "tolerance"), [("policy", 0.999), ("filter", 0.999)])
def test_gaussian_law_of_adaptive_cruise_control(scheme, tolerance):
    # A h = 0 makes h_t = h_0 - tau sigma_1 W_t; an Euler-Maruyama step keeps that exactly. In one
    # case a policy holds A h at 0, in the other the scbf holds a policy back that only wants to
    # drive faster.
    tau, sigma, dt, horizon, distance = 1.8, 1.0, 0.05, 10.0, 5.0
    options = {
        "start": [15.0, 20.0, tau * 15 + distance],
        "box": [-1e5, 1e5],
        "horizon": horizon,
        "noise": sigma,
        "dt": dt,
    }
    problem = make_problem("ACC-v0", **options)
    policy, filters = (
        (Levelling(problem, tau), ["none"]) if scheme == "policy" else (Constant(1.0), ["scbf"])
    )
    (row,) = evaluate(
        "ACC-v0", policy, filters, options=options, episodes=6000, seed=1, bounds=False
    ).rows
    deviation = tau * sigma * math.sqrt(horizon)
    shifted = 1 - 2 * norm.cdf(-(distance + 0.5826 * tau * sigma * math.sqrt(dt)) / deviation)
    low, high = wilson_interval(row.safe, row.episodes, tolerance)
    assert low <= shifted <= high
    exact = survival(distance, round(horizon / dt), 1.0, tau * sigma * math.sqrt(dt))
    assert exact == pytest.approx(shifted, abs=1e-3)
    assert low <= exact <= high
    # The distribution of the smallest h, from the same law at other levels.
    for key, level in (("min_h_median", 0.5), ("min_h_p05", 0.05)):
        below = 2 * norm.cdf(
            -(distance - getattr(row, key) + 0.5826 * tau * sigma * math.sqrt(dt)) / deviation
        )
        assert below == pytest.approx(level, abs=4.0 * math.sqrt(level * (1 - level) / 6000))
    if scheme == "filter":
        assert (row.intervention_rate, row.infeasible_rate) == (1.0, 0.0)


@pytest.mark.slow
def test_law_of_the_scalar_system():
    # The nominal controller makes dh = -h dt + sigma dW, symmetric about the edge: P(safe) = 2
    # Phi(mean/deviation) - 1 in continuous time by reflection, and by quadrature at the control
    # instants.
    sigma, dt, horizon, distance = 0.8, 0.01, 0.6, 0.5
    options = {
        "start": [1 - distance],
        "noise": sigma,
        "horizon": horizon,
        "dt": dt,
        "box": [-100.0, 100.0],
    }
    (row,) = evaluate(
        "Scalar-v0", filters=["none"], options=options, episodes=8000, seed=2, bounds=False
    ).rows
    mean, deviation = (
        distance * math.exp(-horizon),
        sigma * math.sqrt((1 - math.exp(-2 * horizon)) / 2),
    )
    continuous = 2 * norm.cdf(mean / deviation) - 1
    exact = survival(distance, round(horizon / dt), 1 - dt, sigma * math.sqrt(dt))
    assert continuous < exact < continuous + 0.1
    assert survival(distance, 6 * 60, 1 - dt / 6, sigma * math.sqrt(dt / 6)) == pytest.approx(
        continuous, abs=0.03
    )
    low, high = wilson_interval(row.safe, row.episodes, 0.999)
    assert low <= exact <= high


def test_episode_seeds_differ():
    seeds = {s for seed in range(20) for s in episode_seeds(seed, range(200))}
    assert len(seeds) == 4000
    assert all(0 <= s < 2**64 for s in seeds)


def test_the_seed_of_an_episode_does_not_depend_on_the_others():
    words = StreamReader().seek(key_of(5), 0, EPISODE).words(40)
    assert episode_seeds(5, range(10)) == words[::4].tolist()
    assert episode_seeds(5, range(3, 7)) == [episode_seed(5, i) for i in range(3, 7)]
    assert episode_seeds(5, range(3, 7)) == words[12:28:4].tolist()
    assert episode_seeds(5, range(2, 2)) == []


def test_random_policy_and_noise_do_not_share_their_numbers():
    problem = make_problem("Scalar-v0")
    policy = RandomPolicy(problem)
    policy.begin(range(400), seed=0)
    actions = policy.predict(np.zeros((400, 1)))[0][:, 0]
    reader = StreamReader()
    for purpose in (NOISE, START, BRIDGE):
        others = [
            reader.seek(key_of(episode_seed(0, i)), 0, purpose).uniforms(1)[0] for i in range(400)
        ]
        assert abs(np.corrcoef(actions, others)[0, 1]) < 5 / math.sqrt(400)
