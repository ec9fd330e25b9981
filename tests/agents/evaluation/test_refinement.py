"""Refinement of the control period: evaluations on the same noise, and what they say together."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.evaluate import TOLERANCE, refine, verdict
from safe_envs.agents.evaluation.statistics import pair_counts, paired_difference_interval
from tests.oracles.laws import mean_reverting

pytestmark = pytest.mark.slow


def test_rates_are_those_of_evaluations_on_the_same_noise():
    options = {"horizon": 0.4, "noise": 0.4, "dt": 0.1, "substeps": 2}
    given = {"filters": ["none", "scbf"], "episodes": 24, "seed": 2, "confidence": 0.8}
    given["bounds"] = False
    answer = refine("StochasticDubins-v0", options=options, num_envs=16, **given)
    assert answer.periods == [0.1, 0.05, 0.025]
    assert [e.problem.steps for e in answer.evaluations] == [4, 8, 16]
    assert [e.problem.substeps for e in answer.evaluations] == [8, 4, 2]
    for i, (dt, steps) in enumerate(zip(answer.periods, (8, 4, 2), strict=True)):
        other = {**options, "dt": dt, "substeps": steps}
        wanted = evaluate("StochasticDubins-v0", options=other, **given)
        assert wanted.rows == answer.evaluations[i].rows
        for row, refined in zip(wanted.rows, answer.rows, strict=True):
            assert refined.filter == row.filter
            for key in ("safe", "safety_rate", "ci_low", "ci_high"):
                assert getattr(refined, key)[i] == getattr(row, key)
    own = evaluate("StochasticDubins-v0", options=options, **given)
    assert [row.safe for row in own.rows] == [row.safe for row in answer.given.rows]
    for row in answer.rows:
        assert row.change == pytest.approx((row.safe[2] - row.safe[1]) / 24)
        fine, coarse = (e.safe[row.filter][0] for e in answer.evaluations[:0:-1])
        assert (row.change_low, row.change_high) == paired_difference_interval(
            *pair_counts(fine, coarse), 0.8
        )


def walled(dt=0.025):
    """Brownian motion, to stay in (-1, 1) up to 1 s: a rate of 37.08 % in continuous time."""
    return replace(mean_reverting(0.0, 1.0), dt=dt, horizon=1.0)


CONTINUOUS = sum(
    4 / math.pi * (-1) ** k / (2 * k + 1) * math.exp(-(((2 * k + 1) * math.pi) ** 2) / 8)
    for k in range(9)
)


def test_rates_of_a_diffusion_are_extrapolated_in_the_square_root_of_the_period():
    answer = refine(walled(), filters=["none"], episodes=2000, bounds=False)
    (row,) = answer.rows
    assert answer.order == 0.5
    # The same paths are seen more often: what is safe with the small period is with the large one.
    flags = [evaluation.safe["none"][0].array for evaluation in answer.evaluations]
    assert (flags[2] <= flags[1]).all()
    assert (flags[1] <= flags[0]).all()
    assert row.limit_low < CONTINUOUS < row.limit_high < row.limit_low + 0.09
    assert row.error_low < row.safety_rate[0] - row.limit < row.error_high
    # It changes by less than 3 points from dt/2 to dt/4, and is not called converged.
    assert abs(row.change) < TOLERANCE
    assert row.verdict == "still changing"


def test_other_rates_are_extrapolated_in_the_period():
    few = {"filters": ["none"], "episodes": 4, "bounds": False}
    assert refine(walled(), monitoring="continuous", **few).order == 1.0
    assert refine("DubinsDisk-v0", options={"horizon": 0.2}, **few).order == 1.0


@pytest.mark.parametrize(("episodes", "verdict"), [(1000, "converged"), (100, "not resolved")])
def test_rates_that_do_not_change_have_converged_if_there_are_episodes_enough(episodes, verdict):
    (row,) = refine(
        "ACC-v0", filters=["scbf"], options={"horizon": 0.1}, episodes=episodes, bounds=False
    ).rows
    assert row.safety_rate == [1.0, 1.0, 1.0]
    assert (row.limit, row.limit_high, row.error) == (1.0, 1.0, 0.0)
    # What is unsafe with dt/4 alone would show up with a weight of 3.4 in the limit.
    assert row.limit_low == pytest.approx(1.0 - row.error_high)
    assert row.error_high == pytest.approx(2**0.5 / (2**0.5 - 1) * (1.0 - row.ci_low[0]))
    assert (row.error_high <= TOLERANCE) == (verdict == "converged")
    assert row.verdict == verdict


def test_filters_with_tables_have_noise_of_their_own():
    options = {"dt": 0.1, "horizon": 0.2, "noise": 1.0, "start": [0.5]}
    answer = refine("Scalar-v0", filters=["promise:p=0.9"], options=options, episodes=20)
    assert answer.coupled is False
    assert answer.evaluations[0].rows == answer.given.rows
    assert [e.problem.substeps for e in answer.evaluations] == [1, 1, 1]
    assert (
        refine("Scalar-v0", filters=["scbf"], options=options, episodes=2, bounds=False).coupled
        is True
    )


def test_a_rate_that_the_integration_step_changes_is_said_to():
    # Euler's step of this decay is unstable with dt, and stable with dt/4.
    options = {"dt": 0.25, "horizon": 2.0}
    problem = replace(mean_reverting(10.0, 0.8), **options)
    (row,) = refine(problem, filters=["none"], episodes=300, bounds=False).rows
    assert row.verdict == "integration"


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [
        (-0.03, 0.03, "converged"),
        (0.0, 0.02, "converged"),
        (-0.031, 0.01, "not resolved"),
        (-0.01, 0.031, "not resolved"),
        (0.001, 0.002, "converged"),
        (0.001, 0.031, "still changing"),
        (-0.5, -0.4, "still changing"),
    ],
)
def test_verdicts(low, high, wanted):
    assert TOLERANCE == 0.03
    assert verdict(low, high) == wanted


def test_horizons_that_are_no_multiple_of_the_period_stay_as_simulated():
    answer = refine("Scalar-v0", filters=["none"], options={"dt": 0.03, "horizon": 0.1}, episodes=4)
    assert [e.problem.steps for e in answer.evaluations] == [3, 6, 12]
    ends = [e.rows[0].curve.time[-1] for e in answer.evaluations]
    assert ends == [pytest.approx(0.09)] * 3
    assert answer.given.config["problem"]["horizon"] == 0.1
