"""Importance sampling by a drift of the noise, and when its answer is taken."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.statistics import log_normal_interval
from safe_envs.agents.rare_events.estimate import (
    PlainEpisodes,
    RareEstimate,
    doubt_of,
    estimate_rare,
    skewed_interval,
)
from safe_envs.agents.rare_events.numpy_paths import TiltedNoiseEnv
from safe_envs.agents.rare_events.splitting import (
    ImportanceSampling,
    Splitting,
    log_ratio,
    optimal_tilt,
)
from tests.agents.rare_events.conftest import paths_of
from tests.oracles.laws import X, brownian, first_passage, walk_passage

pytestmark = pytest.mark.slow


def both(problem, continuous=False):
    player = paths_of(problem, NominalController(problem), continuous=continuous)
    return Splitting(player, 0), ImportanceSampling(player, 0)


def test_exact_for_several_barriers_and_substeps():
    # The walls are so far apart that a path does not meet both: the probabilities add.
    problem = replace(brownian(0.1, 1.0, 0.0, 0.3, [1 - X, 1 + X]), substeps=2)
    splitting, drifting = both(problem, continuous=True)
    found = splitting.estimate(0.5, 100, 10)
    length, deviation = optimal_tilt(*found.violating(), 1.0)
    estimates, steps = drifting.estimate(length, 250, 20)
    low, high = log_normal_interval(estimates, 0.99)
    assert low < 2 * first_passage(1.0, 0.0, 0.3, 1.0) < high
    assert high / low < 1.5
    assert steps <= 20 * 250 * problem.steps
    # What splitting's paths say of the drift is what its own episodes say.
    error = estimates.std(ddof=1) / estimates.mean() / math.sqrt(20)
    assert error == pytest.approx(deviation / math.sqrt(20 * 250), rel=0.5)


def test_ratios_undo_a_drift_of_several_channels():
    x, y, u, v = sp.symbols("x y u v", real=True)
    diffusion = [[0.3, 0.2], [0.0, 0.4]]
    system = ControlAffineSDE(
        states=(x, y),
        inputs=(u, v),
        drift=[0, 0],
        input_matrix=[[1, 0], [0, 1]],
        diffusion=diffusion,
    )
    problem = state_problem(
        system,
        3 - x - y,
        box=(-1.0, 1.0),
        start=[0.0, 0.0],
        dt=0.1,
        horizon=0.5,
        substeps=2,
        nominal=[0, 0],
    )
    env = TiltedNoiseEnv(problem, np.full(5000, 1.5))
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros((5000, 2)))
    ratios, time = np.exp(log_ratio(env.girsanov_integrals, 1.5)), 0.4
    moments = [
        ratios,
        ratios * env.state[:, 0],
        ratios * env.state[:, 1],
        ratios * env.state[:, 0] * env.state[:, 1],
    ]
    for found, exact in zip(moments, (1.0, 0.0, 0.0, time * 0.2 * 0.4), strict=True):
        assert found.mean() == pytest.approx(exact, abs=4 * found.std() / math.sqrt(5000))
    # The drift is the steepest way, (.3, .6) for x + y, and of length 1.5.
    push = np.array(diffusion) @ np.array([0.3, 0.6]) / math.hypot(0.3, 0.6) * 1.5
    assert env.state.mean(axis=0) == pytest.approx(push * time, abs=0.01)
    assert env.girsanov_integrals[:, 1] == pytest.approx(time)
    env.reset()
    assert not env.girsanov_integrals.any()


def test_best_drift_of_a_walk_goes_straight_to_the_level():
    problem = brownian(0.05, 1.0, 0.0, 0.2)
    found = both(problem)[0].estimate(0.5, 100, 10)
    length, deviation = optimal_tilt(*found.violating(), 1.0)
    # Five deviations away, in the time that there is.
    assert length == pytest.approx(5.0, rel=0.1)
    assert 1.0 < deviation < 5.0
    plain = 1 / math.sqrt(walk_passage(1.0, 20, 0.0, 0.2 * math.sqrt(0.05)))
    integrals, shares = found.violating()
    assert optimal_tilt(0.0 * integrals, shares, 1.0)[1] == pytest.approx(plain, rel=0.5)


def test_violations_on_another_way_count_against_a_drift():
    problem = brownian(0.05, 1.0, 0.0, 0.2)
    found = both(problem)[0].estimate(0.5, 100, 10)
    good = optimal_tilt(*found.violating(), 1.0)[1]
    girsanov_integrals, shares = found.violating()
    girsanov_integrals[::50, 0] = 0.0
    assert optimal_tilt(girsanov_integrals, shares, 1.0)[1] > 30 * good


@pytest.mark.slow
def test_two_ways_to_fail_in_different_units_are_both_found():
    x, y, u, v = sp.symbols("x y u v", real=True)
    system = ControlAffineSDE(
        states=(x, y),
        inputs=(u, v),
        drift=[0, 0],
        input_matrix=[[1, 0], [0, 1]],
        diffusion=[[0.2, 0], [0, 3 / 5.15]],
    )
    problem = state_problem(
        system,
        [1 - x, 3 - y],
        box=(-1.0, 1.0),
        start=[0.0, 0.0],
        dt=0.05,
        horizon=1.0,
        nominal=[0, 0],
    )
    exact = walk_passage(1.0, 20, 0.0, 0.2 * math.sqrt(0.05)) + walk_passage(
        3.0, 20, 0.0, 3 / 5.15 * math.sqrt(0.05)
    )
    (row,) = estimate_rare(problem, filters=["none"], particles=400).rows
    assert row.method.startswith("splitting")
    assert row.ci_low < exact < row.ci_high


def test_without_noise_chance_may_come_from_the_policy():
    arguments = {
        "filters": ["none"],
        "options": {"horizon": 3.0, "start": [0.0, 0.0, 0.0], "barrier": {"radius": 2.35}},
    }
    (found,) = estimate_rare(
        "DubinsDisk-v0", "random", particles=50, repetitions=10, **arguments
    ).rows
    (plain,) = evaluate("DubinsDisk-v0", "random", episodes=2000, bounds=False, **arguments).rows
    assert found.status == "estimated"
    assert found.check is None
    assert found.ci_low < 1 - plain.ci_low
    assert found.ci_high > 1 - plain.ci_high


def estimate(p, width, spread=0.1):
    estimates = p * np.exp(spread * np.resize((-1, 1), 20))
    return RareEstimate("splitting on h", p, p / width, p * width, 0.1, estimates.tolist())


NOTHING_SEEN = PlainEpisodes(5000, 0, 0.0, 7e-4)
FEW_SEEN = PlainEpisodes(5000, 5, 4e-4, 2e-3)


@pytest.mark.parametrize(
    ("found", "check", "plain", "doubt"),
    [
        (estimate(1e-7, 1.5), None, NOTHING_SEEN, None),
        (estimate(1e-7, 1.1), estimate(1.2e-7, 1.5), NOTHING_SEEN, None),
        (estimate(1e-7, 1.1), estimate(2e-7, 1.5), NOTHING_SEEN, "splitting on h says 2e-07"),
        (estimate(1e-7, 1.5), None, FEW_SEEN, "5 violations among 5000 contradict it"),
        (estimate(1e-7, 1.5, 0.38), None, NOTHING_SEEN, None),
        (estimate(1e-7, 1.5, 0.45), None, NOTHING_SEEN, "standard deviation of 0.46"),
    ],
)
def test_what_contradicts_an_estimate(found, check, plain, doubt):
    told = doubt_of(found, check, plain)
    assert (told is None) if doubt is None else (doubt in told)


def test_an_interval_of_skewed_estimates_reaches_further_up():
    even = np.array([0.9, 1.0, 1.1] * 7)
    assert skewed_interval(even, 0.95) == log_normal_interval(even)
    skewed = np.array([1.0] * 19 + [3.0])
    (low, high), (coxs_low, coxs_high) = skewed_interval(skewed, 0.95), log_normal_interval(skewed)
    assert (low, high > coxs_high) == (coxs_low, True)
    assert skewed_interval(even, 0.95, 2.0)[1] > log_normal_interval(even)[1]
    assert skewed_interval(np.array([2.0, 2.0]), 0.95) == (2.0, 2.0)


@pytest.mark.parametrize("skew", [0.0, 1.0])
def test_an_interval_of_skewed_estimates_covers(skew):
    # Sums of log-normal numbers and of rarer, larger ones: of mean 1 and a deviation of .3.
    rng = np.random.default_rng(0)
    parts = np.exp(0.25 * rng.standard_normal((2000, 20)) - 0.25**2 / 2)
    rare = 1.0 * (rng.random(parts.shape) < 0.03)
    estimates = (parts + skew * rare) / (1.0 + 0.03 * skew)
    ends = [skewed_interval(each, 0.95) for each in estimates]
    covered = np.mean([low < 1.0 < high for low, high in ends])
    assert covered > 0.935
