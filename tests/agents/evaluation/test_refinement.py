"""Refinement of the control period: three evaluations, and what they say together."""

from __future__ import annotations

import json
import math

import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.comparison import pair_counts
from safe_envs.agents.evaluation.refinement import TOLERANCE, refine, verdict
from safe_envs.agents.evaluation.statistics import paired_difference_interval
from tests.oracles.laws import survival

pytestmark = pytest.mark.slow

SCALAR = {"start": [0.5], "noise": 0.8, "box": [-100.0, 100.0]}


@pytest.mark.slow
def test_rates_are_those_of_evaluations_with_smaller_periods():
    options = {"horizon": 1.0, "noise": 0.4, "dt": 0.1}
    answer = refine(
        "StochasticDubins-v0",
        filters=["none", "scbf"],
        options=options,
        episodes=24,
        seed=2,
        confidence=0.8,
        num_envs=16,
    )
    assert answer.periods == [0.1, 0.05, 0.025]
    assert [e.problem.steps for e in answer.evaluations] == [10, 20, 40]
    for i, dt in enumerate(answer.periods):
        arguments = {"options": {**options, "dt": dt}, "episodes": 24, "seed": 2, "confidence": 0.8}
        wanted = evaluate(
            "StochasticDubins-v0", filters=["none", "scbf"], bounds=i == 0, **arguments
        )
        assert wanted.rows == answer.evaluations[i].rows
        for row, refined in zip(wanted.rows, answer.rows, strict=True):
            assert refined.filter == row.filter
            for key in ("safe", "safety_rate", "ci_low", "ci_high"):
                assert getattr(refined, key)[i] == getattr(row, key)
    for row in answer.rows:
        assert row.change == pytest.approx((row.safe[2] - row.safe[1]) / 24)
        fine, coarse = (e.safe[row.filter][0] for e in answer.evaluations[:0:-1])
        table = pair_counts(fine, coarse)
        assert table[0] + table[1] == row.safe[2]
        assert table[0] + table[2] == row.safe[1]
        assert (row.change_low, row.change_high) == paired_difference_interval(*table, 0.8)


@pytest.mark.parametrize(("episodes", "verdict"), [(200, "converged"), (100, "not resolved")])
def test_rates_that_do_not_change_have_converged_if_there_are_episodes_enough(episodes, verdict):
    (row,) = refine("ACC-v0", filters=["scbf"], options={"horizon": 0.2}, episodes=episodes).rows
    assert row.safety_rate == [1.0, 1.0, 1.0]
    assert row.change_low == pytest.approx(-row.change_high)
    assert (row.change_high <= TOLERANCE) == (verdict == "converged")
    assert row.verdict == verdict


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


@pytest.mark.slow
def test_a_rate_that_still_changes_is_said_to():
    # dh = -h dt + sigma dW: the less often one looks, the fewer of its violations are seen.
    options = {**SCALAR, "dt": 0.4, "horizon": 1.6}
    answer = refine("Scalar-v0", filters=["none"], options=options, episodes=4000)
    (row,) = answer.rows
    for dt, low, high in zip(answer.periods, row.ci_low, row.ci_high, strict=True):
        exact = survival(0.5, round(1.6 / dt), 1 - dt, 0.8 * math.sqrt(dt))
        assert low - 0.01 < exact < high + 0.01
    assert row.change_low < row.change < row.change_high < 0
    assert row.verdict == "still changing"


def test_horizons_that_are_no_multiple_of_the_period_stay_as_simulated():
    answer = refine("Scalar-v0", filters=["none"], options={"dt": 0.03, "horizon": 0.1}, episodes=4)
    assert [e.problem.steps for e in answer.evaluations] == [3, 6, 12]
    ends = [e.rows[0].curve.time[-1] for e in answer.evaluations]
    assert ends == [pytest.approx(0.09)] * 3
    assert answer.evaluations[0].config["problem"]["horizon"] == 0.1


def test_document_is_that_of_the_given_period_and_the_refinement():
    problem = make_problem("Scalar-v0", horizon=0.1)
    answer = refine(problem, episodes=6, record=True)
    document = json.loads(json.dumps(answer.document(), allow_nan=False))
    plain = evaluate(problem, episodes=6)
    assert document["rows"] == [row.as_dict() for row in plain.rows]
    assert document["config"] == json.loads(json.dumps(plain.config))
    assert document["refinement"]["dt"] == [0.01, 0.005, 0.0025]
    assert document["refinement"]["rows"] == [vars(row) for row in answer.rows]
    assert [len(e.trajectories) for e in answer.evaluations] == [2, 0, 0]


def test_progress_goes_over_all_three():
    told = []
    refine(
        "Scalar-v0",
        filters=["none", "scbf"],
        episodes=3,
        options={"horizon": 0.05},
        progress=told.append,
    )
    assert told == sorted(told)
    assert 0.0 < told[0] < 0.05
    assert told[-1] == 1.0
    for share in (1 / 14, 1 / 7, 2 / 7, 3 / 7, 5 / 7):
        assert any(abs(t - share) < 1e-12 for t in told)


def test_errors_are_those_of_an_evaluation():
    for arguments in (
        {"episodes": 0},
        {"confidence": 2},
        {"filters": ["scb"]},
        {"options": {"dt": 5e-324, "horizon": 5e-324}},
    ):
        with pytest.raises(ConfigurationError):
            refine("Scalar-v0", **arguments)


def test_the_file_of_episodes_is_of_the_first_evaluation(tmp_path):
    path = tmp_path / "out.parquet"
    answer = refine(
        "Scalar-v0",
        "random",
        episodes_out=path,
        filters=["none"],
        options={"horizon": 0.4, "noise": 0.8},
        episodes=12,
    )
    table = pq.read_table(path)
    first = answer.evaluations[0]
    assert table["return"].to_pylist() == first.episode_columns()["return"].tolist()
    assert max(table["length"].to_pylist()) == first.problem.steps
