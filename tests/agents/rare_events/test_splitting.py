"""Rare violations by splitting, against exact laws and plain episodes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.stats import t as student

from safe_envs import ConfigurationError, ControlAffineSDE, state_problem
from safe_envs.agents import NominalController, ZeroController, evaluate
from safe_envs.agents.evaluation.statistics import log_normal_interval
from safe_envs.agents.policies.base import BlockPolicy
from safe_envs.agents.rare_events import splitting
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.agents.rare_events.splitting import ImportanceSampling, Splitting
from safe_envs.problem.problem import Barrier
from tests.agents.rare_events.conftest import paths_of
from tests.oracles.laws import (
    X,
    brownian,
    first_passage,
    martingale_passage,
    mean_reverting,
    mean_reverting_passage,
    walk_passage,
)

pytestmark = pytest.mark.slow

SHORT: dict[str, Any] = {"particles": 100, "repetitions": 10}

both_engines = pytest.mark.parametrize(
    "engine", ["numpy", pytest.param("compiled", marks=pytest.mark.oracle)]
)

SCALAR: dict[str, Any] = {"noise": 0.3, "horizon": 1.0, "dt": 0.05, "box": [-1.0, 1.0]}
"""Random starts, and a box that is too small for some of them."""


def row_of(problem, filter_name="none", **arguments):
    (row,) = estimate_rare(problem, filters=[filter_name], **arguments).rows
    return row


def splitting_of(problem, continuous=False):
    return Splitting(paths_of(problem, NominalController(problem), continuous=continuous), 0)


def assert_holds(row, exact, within):
    """The interval holds the exact probability, and is narrow enough for that to mean something."""
    assert row.status == "estimated"
    assert row.doubt is None
    assert_near(row, exact, within)


def assert_near(row, exact, within):
    assert row.ci_low < exact < row.ci_high
    assert row.ci_high / row.ci_low < within


@pytest.mark.slow
@both_engines
def test_gaussian_walk_of_probability_1e_8(engine):
    exact = walk_passage(1.0, 40, -0.005, 0.15 * math.sqrt(0.05))
    assert 1e-8 < exact < 2e-8
    row = row_of(brownian(0.05, 2.0, -0.1, 0.15), engine=engine)
    assert_holds(row, exact, 2.0)
    assert row.method.startswith("drift of ")
    # The check is the pilot's, and coarser.
    assert row.check.method == "splitting on h/sqrt(T - t)"
    assert row.ci_high / row.ci_low < row.check.ci_high / row.check.ci_low < 3.0
    assert row.plain.violations == 0
    # What plain episodes need for the same relative error, and how many steps these are.
    assert row.plain_episodes_needed == pytest.approx(
        1 / (row.probability * row.relative_error**2), rel=1e-6
    )
    assert row.plain_steps_needed == pytest.approx(40 * row.plain_episodes_needed)
    assert row.probability == pytest.approx(np.mean(row.estimates))


@pytest.mark.slow
@both_engines
def test_first_passage_of_probability_1e_8_with_continuous_monitoring(engine):
    exact = first_passage(1.0, -0.1, 0.15, 2.0)
    row = row_of(brownian(0.1, 2.0, -0.1, 0.15), monitoring="continuous", seed=1, engine=engine)
    assert_holds(row, exact, 2.0)
    # Looks at control instants only would see about half of it.
    assert walk_passage(1.0, 20, -0.01, 0.15 * math.sqrt(0.1)) < row.ci_low


@pytest.mark.slow
@both_engines
def test_geometric_martingale_of_probability_1e_8(engine):
    # Under the SCBF, h = 1 - x^2 is a martingale of dx = u dt + x dW.
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [1], [x])
    problem = state_problem(system, 1 - x**2, box=(-50.0, 50.0), start=[1e-4], dt=0.1, horizon=14.0)
    exact = martingale_passage(1e-4, 140, 0.1)
    row = row_of(problem, "scbf", seed=1, engine=engine)
    assert_holds(row, exact, 3.0)


@pytest.mark.slow
@both_engines
def test_cruise_control_under_its_filter_has_the_gaussian_law(engine):
    # At 10 m/s the desired speed is far off, so that the filter acts all the time and A h = 0: h is
    # a walk.
    exact = walk_passage(32.0, 50, 0.0, 1.8 * math.sqrt(0.2))
    assert 1e-8 < exact < 2e-8
    options = {"start": [10.0, 10.0, 50.0], "horizon": 10.0, "dt": 0.2}
    row = row_of("safe_envs/ACC-v0", "scbf", options=options, engine=engine)
    assert_holds(row, exact, 3.0)


def test_the_law_of_mean_reversion_is_known():
    exact = mean_reverting_passage(1.0, 0.26)
    assert exact == pytest.approx(4.829323e-7, rel=1e-6)
    assert mean_reverting_passage(1.0, 0.26, nodes=900) == pytest.approx(exact, rel=1e-9)
    # Without reversion it is a walk between two walls, which hardly any path reaches both.
    one = walk_passage(1.0, 40, 0.0, 0.2 * math.sqrt(0.05))
    assert mean_reverting_passage(0.0, 0.2) == pytest.approx(2 * one, rel=1e-3)


@pytest.mark.parametrize(
    ("problem", "power"),
    [(mean_reverting(1.0, 0.26), 0.0), (brownian(0.05, 2.0, -0.1, 0.15), 0.5)],
    ids=["mean reversion", "walk"],
)
def test_a_pilot_chooses_the_score_that_loses_less(problem, power):
    # The second score has the smaller spread in some pilots of the first law, and misses most of
    # its probability.
    pilot = splitting_of(problem).pilot(100, 20)
    assert (pilot.power, len(pilot.estimates), pilot.often) == (power, 20, False)
    assert pilot.enough() > 2 * pilot.particles


def test_scores_are_compared_by_how_high_unbiased_estimates_lie():
    high, low = np.exp([-1.0, 0.0, 1.0] * 7), np.exp([-2.1, -2.0, -1.9] * 7)
    better = splitting._better
    assert (better(high, low), better(low, high), better(high, high)) == (0, 1, 0)
    # One that is given up at times loses more than any other.
    lost = np.where(np.arange(21) == 3, 0.0, 100.0)
    assert (better(low, lost), better(lost, low), better(lost, lost)) == (0, 1, 0)


@pytest.mark.oracle
def test_an_interval_holds_that_was_too_low():
    row = row_of(mean_reverting(1.0, 0.26), seed=1150, engine="compiled")
    assert_holds(row, mean_reverting_passage(1.0, 0.26), 2.0)
    assert row.particles > 750


@pytest.mark.oracle
@pytest.mark.parametrize("sigma", [0.34, 0.26])
def test_intervals_of_mean_reversion_cover_as_often_as_they_say(sigma):
    exact, problem = mean_reverting_passage(1.0, sigma), mean_reverting(1.0, sigma)
    rows = [row_of(problem, seed=seed, engine="compiled") for seed in range(200)]
    low = sum(row.ci_high < exact for row in rows)
    high = sum(row.ci_low > exact for row in rows)
    # If 95 % are held, 20 misses or more, or 13 on one side, have a probability of .003.
    assert low + high < 20
    assert max(low, high) < 13
    # What is doubted is left out by most readers: the rest has to cover too.
    sure = [row.ci_low < exact < row.ci_high for row in rows if row.doubt is None]
    assert len(sure) > 150
    assert np.mean(sure) > 0.9


@pytest.mark.slow
def test_splitting_is_unbiased_and_its_interval_covers():
    problem, exact = brownian(0.1, 1.0, 0.0, 0.3), walk_passage(1.0, 10, 0.0, 0.3 * math.sqrt(0.1))
    found = splitting_of(problem).estimate(0.5, 60, 400)
    assert found.estimates.mean() == pytest.approx(exact, abs=3 * found.estimates.std() / 20)
    intervals = [log_normal_interval(part) for part in np.split(found.estimates, 40)]
    # 33 of 40 or less has a probability of .003 if 95 % are held.
    assert sum(low < exact < high for low, high in intervals) >= 34
    assert math.fsum(found.violating()[1]) == pytest.approx(found.estimates.mean())


def test_splitting_looks_between_instants():
    problem = brownian(0.1, 1.0, 0.0, 0.3)
    found = splitting_of(problem, continuous=True).estimate(0.5, 100, 150)
    low, high = log_normal_interval(found.estimates, 0.99)
    assert low < first_passage(1.0, 0.0, 0.3, 1.0) < high
    assert walk_passage(1.0, 10, 0.0, 0.3 * math.sqrt(0.1)) < low


def test_pilots_and_estimates_have_noise_of_their_own():
    problem = brownian(0.1, 1.0, 0.0, 0.3)
    player = paths_of(problem, ZeroController(problem))
    keys, play = [], player.play

    def noting(paths, all_keys, *arguments):
        keys.append(all_keys[paths])
        return play(paths, all_keys, *arguments)

    player.play = noting
    Splitting(player, 0).pilot(50, 10)
    Splitting(player, 0).estimate(0.0, 50, 10)
    ImportanceSampling(player, 0).estimate(3.0, 50, 2)
    # Every generation of every path has noise of its own too.
    assert len(keys) > 10
    found = np.concatenate(keys)
    assert len(np.unique(found)) == len(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("episodes", "engine"),
    [
        (6_000, "numpy"),
        pytest.param(100_000, "numpy", marks=pytest.mark.oracle),
        pytest.param(100_000, "compiled", marks=pytest.mark.oracle),
    ],
)
@pytest.mark.parametrize(
    ("policy", "monitoring"),
    [("nominal", "discrete"), ("random", "discrete"), ("nominal", "continuous")],
)
def test_agrees_with_plain_episodes_where_these_do(policy, monitoring, episodes, engine):
    arguments = {"filters": ["szcbf"], "options": SCALAR, "monitoring": monitoring}
    (plain,) = evaluate(
        "Scalar-v0", policy, episodes=episodes, confidence=0.99, bounds=False, **arguments
    ).rows
    (rare,) = estimate_rare(
        "Scalar-v0", policy, seed=3, particles=100, engine=engine, **arguments
    ).rows
    assert rare.ci_low < 1 - plain.ci_low
    assert rare.ci_high > 1 - plain.ci_high
    assert 0 < rare.plain.violations < rare.plain.episodes
    assert rare.levels > 0


def test_what_is_sure_needs_no_level():
    row = row_of(brownian(0.1, 1.0, 9.0, 0.1), **SHORT)
    assert (row.probability, row.levels, row.plain_episodes_needed) == (1.0, 0.0, None)
    assert row.ci_low > 0.99
    assert row.ci_high == 1.0


def test_same_seed_is_the_same_answer_and_is_json():
    arguments = {"filters": ["none"], **SHORT}
    first, second, other = (
        estimate_rare(brownian(0.1, 1.0, 0.0, 0.3), seed=s, **arguments) for s in (1, 1, 2)
    )
    assert first.rows == second.rows
    assert first.rows != other.rows
    document = json.loads(json.dumps(first.document(), allow_nan=False))
    assert list(document) == ["config", "versions", "rows", "timing"]
    assert document["config"]["particles"] == 100


class ByRow(BlockPolicy):
    """Acts by the row of its block alone, on which the rounding of a network depends."""

    def act(self, block):
        return np.linspace(-1.0, 1.0, len(block))[:, None]


@pytest.mark.parametrize(
    ("problem", "filter_name", "arguments"),
    [
        (brownian(0.1, 1.0, 0.0, 0.3, [1 - X, 2 * (1 + X)]), "none", {"monitoring": "continuous"}),
        ("Scalar-v0", "szcbf", {"policy": "random", "options": SCALAR}),
        ("Scalar-v0", "szcbf", {"policy": ByRow(1), "options": SCALAR}),
    ],
    ids=["two barriers", "random policy", "network"],
)
def test_numbers_do_not_depend_on_the_envs_side_by_side(problem, filter_name, arguments):
    wanted, other = (
        row_of(problem, filter_name, engine="numpy", num_envs=n, **arguments, **SHORT)
        for n in (4096, 150)
    )
    assert wanted.levels > 0
    assert other == wanted


def test_where_h_jumps_it_says_so():
    step = Barrier(sp.Piecewise((1, X < 1), (-1, True)))
    row = row_of(replace(brownian(0.1, 1.0, 0.0, 0.3), barriers=(step,)), **SHORT)
    assert row.status == "none"
    assert row.probability is row.ci_low is row.plain_episodes_needed is None
    assert "stood at one level and none came below h = 1." in row.reason


def test_where_a_level_is_out_of_reach_it_says_so(monkeypatch):
    monkeypatch.setattr(splitting, "LEAST", 0.01)
    row = row_of(brownian(0.05, 1.0, 0.0, 0.25), **SHORT)
    assert row.status == "none"
    assert "in 10 of 10 repetitions the probability to come below h = 0." in row.reason
    assert "may never be reached" in row.reason


def test_without_noise_there_is_nothing_to_split():
    row = row_of("DubinsDisk-v0", "hocbf")
    assert row.status == "none"
    assert "nothing is random after the start" in row.reason


class Remembering(ZeroController):
    """A policy with a hidden state."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return super().predict(observation)[0], np.zeros(len(observation))


def test_what_cannot_be_taken_up_again_is_refused():
    problem = brownian(0.1, 1.0, 0.0, 0.3)
    with pytest.raises(ConfigurationError, match="has a memory"):
        estimate_rare(problem, Remembering(problem), filters=["none"])


@pytest.mark.parametrize(
    ("name", "value"), [("particles", 19), ("repetitions", 9), ("num_envs", 0), ("particles", 2.5)]
)
def test_numbers_out_of_range_are_refused(name, value):
    with pytest.raises(ConfigurationError, match=f"{name} = {value}"):
        estimate_rare("Scalar-v0", **{name: value})


def test_log_normal_interval_is_coxs_around_the_mean():
    values = [1e-8, 2e-8, 4e-8]
    s = math.log(2)
    half = student.ppf(0.975, 2) * math.sqrt(s**2 / 3 + s**4 / 4)
    mean = 7e-8 / 3
    assert log_normal_interval(values) == (
        pytest.approx(mean * math.exp(-half)),
        pytest.approx(mean * math.exp(half)),
    )
    assert log_normal_interval([3.0, 3.0]) == (3.0, 3.0)
    for wrong in ([1.0], [1.0, 0.0]):
        with pytest.raises(ConfigurationError, match="at least two, all above 0"):
            log_normal_interval(wrong)
