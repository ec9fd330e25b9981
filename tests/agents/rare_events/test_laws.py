"""Probabilities of rare violations against exact laws and plain episodes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.statistics import log_normal_interval
from safe_envs.agents.rare_events.estimate import estimate_rare
from tests.oracles.carts import cart_problem
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

PLANE = sp.symbols("x y", real=True)
SCALAR: dict[str, Any] = {"noise": 0.3, "horizon": 1.0, "dt": 0.05, "input_bounds": [-1.0, 1.0]}
"""Random starts, and a box that is too small for some of them."""


def row_of(problem, filter_name="none", **arguments):
    (row,) = estimate_rare(problem, filters=[filter_name], **arguments).rows
    return row


def assert_near(row, exact, within):
    """The interval holds the exact probability, and is narrow enough for that to mean something."""
    assert row.status == "estimated"
    assert row.ci_low < exact < row.ci_high
    assert row.ci_high / row.ci_low < within


def plane(barriers, diffusion, dt):
    """Noise alone moves a point in a plane."""
    system = ControlAffineSDE(PLANE, sp.symbols("u v", real=True), [0, 0], sp.eye(2), diffusion)
    given = {"start": [0.0, 0.0], "dt": dt, "horizon": 1.0, "nominal": [0, 0]}
    return define_problem(system, barriers, input_bounds=(-1.0, 1.0), **given)


def two_channels():
    """h is a walk, as its gradient and the diffusion are constant."""
    x, y = PLANE
    return replace(plane(1.5 - x - y, [[0.15, 0.1], [0.0, 0.2]], 0.1), substeps=2)


def two_ways():
    """Two ways to fail, in different units."""
    x, y = PLANE
    return plane([1 - x, 3 - y], [[0.2, 0], [0, 3 / 5.15]], 0.05)


def martingale():
    """Under the SCBF, h = 1 - x^2 is a martingale of dx = u dt + x dW."""
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [1], [x])
    return define_problem(
        system, 1 - x**2, input_bounds=(-50.0, 50.0), start=[1e-4], dt=0.1, horizon=14.0
    )


# At 10 m/s the desired speed is far off, so that the filter acts all the time and A h = 0: h is a
# walk.
CRUISE = {"start": [10.0, 10.0, 50.0], "horizon": 10.0, "dt": 0.2}
WALLS = [1 - X, 1 + X]
LAWS = {
    # id: (problem, exact probability, ratio of the ends at most, arguments)
    "several channels": (
        two_channels(),
        walk_passage(1.5, 10, 0.0, math.hypot(0.15, 0.3) * math.sqrt(0.1)),
        2.0,
        {},
    ),
    # So far apart that a path does not meet both: the probabilities add.
    "several walls, between instants": (
        replace(brownian(0.1, 1.0, 0.0, 0.3, WALLS), substeps=2),
        2 * first_passage(1.0, 0.0, 0.3, 1.0),
        2.0,
        {"monitoring": "continuous"},
    ),
    "mean reversion": (
        mean_reverting(1.0, 0.34),
        mean_reverting_passage(1.0, 0.34),
        3.0,
        {"seed": 1},
    ),
    "without noise but that of h": (
        brownian(0.1, 1.0, 0.0, 0.25),
        walk_passage(1.0, 10, 0.0, 0.25 * math.sqrt(0.1)),
        2.0,
        {},
    ),
}
LONG_LAWS = {
    "first passage of 1e-8": (
        brownian(0.1, 2.0, -0.1, 0.15),
        first_passage(1.0, -0.1, 0.15, 2.0),
        2.0,
        {"monitoring": "continuous", "seed": 1},
    ),
    "geometric martingale of 1e-8": (
        martingale(),
        martingale_passage(1e-4, 140, 0.1),
        3.0,
        {"filter_name": "scbf", "seed": 1},
    ),
    "cruise control of 1e-8": (
        "safe_envs/ACC-v0",
        walk_passage(32.0, 50, 0.0, 1.8 * math.sqrt(0.2)),
        3.0,
        {"filter_name": "scbf", "options": CRUISE},
    ),
    "mean reversion that was too low": (
        mean_reverting(1.0, 0.26),
        mean_reverting_passage(1.0, 0.26),
        2.0,
        {"seed": 1150},
    ),
    "ways to fail in different units": (
        two_ways(),
        walk_passage(1.0, 20, 0.0, 0.2 * math.sqrt(0.05))
        + walk_passage(3.0, 20, 0.0, 3 / 5.15 * math.sqrt(0.05)),
        3.0,
        {"particles": 400},
    ),
}


@pytest.mark.parametrize(("problem", "exact", "within", "arguments"), LAWS.values(), ids=LAWS)
def test_intervals_hold_the_exact_probability(problem, exact, within, arguments):
    row = row_of(problem, engine="numpy", **arguments)
    assert_near(row, exact, within)
    assert row.doubt is None


@pytest.mark.oracle
@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize(
    ("problem", "exact", "within", "arguments"), LONG_LAWS.values(), ids=LONG_LAWS
)
def test_intervals_hold_the_exact_probability_of_very_rare_events(
    problem, exact, within, arguments, engine
):
    assert exact < 1e-5
    assert_near(row_of(problem, engine=engine, **arguments), exact, within)


def test_a_walk_of_probability_1e_8_tells_what_plain_episodes_would_need():
    exact = walk_passage(1.0, 40, -0.005, 0.15 * math.sqrt(0.05))
    assert 1e-8 < exact < 2e-8
    row = row_of(brownian(0.05, 2.0, -0.1, 0.15), engine="numpy")
    assert_near(row, exact, 2.0)
    assert row.doubt is None
    assert row.method.startswith("drift of ")
    # The check is the pilot's, and coarser.
    assert row.check.method == "splitting on h/sqrt(T - t)"
    assert row.ci_high / row.ci_low < row.check.ci_high / row.check.ci_low < 3.0
    assert row.plain.violations == 0
    needed = 1 / (row.probability * row.relative_error**2)
    assert row.plain_episodes_needed == pytest.approx(needed, rel=1e-6)
    assert row.plain_steps_needed == pytest.approx(40 * row.plain_episodes_needed)
    assert row.probability == pytest.approx(np.mean(row.estimates))


def test_splitting_is_unbiased_and_its_interval_covers():
    sigma, dt, horizon = 0.42, 0.1, 1.0
    problem = mean_reverting(1.0, sigma, dt, horizon)
    exact = mean_reverting_passage(1.0, sigma, dt, horizon)
    row = row_of(problem, engine="numpy", particles=60, repetitions=200)
    assert row.method.startswith("splitting")
    estimates = np.array(row.estimates)
    assert estimates.mean() == pytest.approx(exact, abs=3 * estimates.std() / math.sqrt(200))
    intervals = [log_normal_interval(part) for part in np.split(estimates, 20)]
    # 15 of 20 or less has a probability of .003 if 95 % are held.
    assert sum(low < exact < high for low, high in intervals) >= 16


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


def test_the_law_of_mean_reversion_is_known():
    exact = mean_reverting_passage(1.0, 0.26)
    assert exact == pytest.approx(4.829323e-7, rel=1e-6)
    assert mean_reverting_passage(1.0, 0.26, nodes=900) == pytest.approx(exact, rel=1e-9)
    # Without reversion it is a walk between two walls, which hardly any path reaches both.
    one = walk_passage(1.0, 40, 0.0, 0.2 * math.sqrt(0.05))
    assert mean_reverting_passage(0.0, 0.2) == pytest.approx(2 * one, rel=1e-3)


WALK_OF_A_POLICY = {"horizon": 3.0, "start": [0.0, 0.0, 0.0], "barrier": {"radius": 2.35}}


@pytest.mark.parametrize(
    ("env_id", "name", "options", "policy", "monitoring", "episodes"),
    [
        ("Scalar-v0", "szcbf", SCALAR, "nominal", "discrete", 5000),
        ("Scalar-v0", "szcbf", SCALAR, "random", "continuous", 5000),
        # Without noise chance may come from the policy.
        ("DubinsDisk-v0", "none", WALK_OF_A_POLICY, "random", "discrete", 1500),
        *(
            pytest.param("Scalar-v0", "szcbf", SCALAR, p, m, 100_000, marks=pytest.mark.oracle)
            for p, m in (("nominal", "continuous"), ("random", "discrete"))
        ),
    ],
)
def test_agrees_with_plain_episodes_where_these_do(
    env_id, name, options, policy, monitoring, episodes
):
    given = {"filters": [name], "options": options, "monitoring": monitoring}
    how = {"episodes": episodes, "confidence": 0.99, "bounds": False}
    (plain,) = evaluate(env_id, policy, **given, **how).rows
    (rare,) = estimate_rare(env_id, policy, seed=3, particles=60, engine="numpy", **given).rows
    assert rare.status == "estimated"
    assert rare.ci_low < 1 - plain.ci_low
    assert rare.ci_high > 1 - plain.ci_high
    assert rare.levels > 0


def test_failures_behind_a_backup_filter_can_be_estimated():
    problem = cart_problem(noise=0.1, start=[-0.5, 0.0], horizon=2.0)
    given = {"particles": 30, "repetitions": 10, "engine": "numpy", "policy": "nominal"}
    assert 0.0 < row_of(problem, "backup", **given).probability < 1.0


def test_what_is_sure_needs_no_level():
    row = row_of(brownian(0.1, 1.0, 9.0, 0.1), particles=100, repetitions=10)
    assert (row.probability, row.levels, row.plain_episodes_needed) == (1.0, 0.0, None)
    assert row.ci_low > 0.99
    assert row.ci_high == 1.0
