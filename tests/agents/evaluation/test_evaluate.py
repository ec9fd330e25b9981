"""Evaluation: what is counted."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.problem.starts import Start
from tests.agents.evaluation.evaluated import Constant, Schedule, replay, safe_so_far

pytestmark = pytest.mark.slow

NEAR = {"noise": 0.05, "start": [1.5, 1.2, 0.3, 0.5, 1.0], "horizon": 3.0}
MANY = {"noise": 0.3, "horizon": 0.7, "barrier": {"half_width": 0.7}}
COUNTS = ("episodes", "safe", "violations")
MEASURES = ("safety_rate", "ci_low", "ci_high", "min_h_median", "min_h_p05", "effort_mean")
RATES = ("return_mean", "intervention_rate", "infeasible_rate")


@pytest.mark.parametrize(
    ("env_id", "spec", "policy", "knowledge", "options"),
    [
        ("Scalar-v0", "scbf", "random", "model", {"noise": 0.3, "input_bounds": [-0.2, 3.0]}),
        ("StochasticDubins-v0", "hocbf:alpha=1,1", "random", "model", {}),
        ("DubinsObstacle-v0", "hocbf", "nominal", "model", NEAR),
        ("QuadrotorAltitude-v0", "hocbf", "nominal", "plant", {"start": [5.0, 2.0]}),
        pytest.param("Quadrotor-v0", "none", "nominal", "model", MANY, marks=pytest.mark.oracle),
    ],
)
def test_episodes_replayed_by_hand(env_id, spec, policy, knowledge, options):
    episodes, seed, options = 5, 11, {"horizon": 1.0, **options}
    given = {"options": options, "episodes": episodes, "seed": seed, "knowledge": knowledge}
    answer = evaluate(env_id, policy, [spec], num_envs=3, record=True, bounds=False, **given)
    (found,), env_id = answer.rows, f"safe_envs/{env_id}"
    row, trajectories = replay(env_id, options, spec, policy, episodes, seed, knowledge)
    assert (found.filter, found.policy) == (spec, policy)
    for key in COUNTS:
        assert getattr(found, key) == row[key], key
    for key in MEASURES + RATES:
        assert getattr(found, key) == pytest.approx(row[key], rel=1e-7, abs=1e-9), key
    recorded = answer.trajectories[spec].barrier
    for i, h in enumerate(trajectories):
        np.testing.assert_allclose(recorded[: len(h), i], h, rtol=1e-6, atol=1e-7)
        assert np.isnan(recorded[len(h) :, i]).all()
    curve = found.curve
    assert curve.safe == safe_so_far(trajectories, curve.time, make_problem(env_id, **options).dt)
    assert curve.rate == [count / episodes for count in curve.safe]
    assert (curve.rate[-1], curve.ci_low[-1], curve.ci_high[-1]) == tuple(
        getattr(found, key) for key in ("safety_rate", "ci_low", "ci_high")
    )
    timing = answer.timing.rows[0]
    assert timing.steps == sum(len(h) - 1 for h in trajectories)
    assert timing.steps_per_second == pytest.approx(timing.steps / timing.seconds)


def test_rows_are_what_the_results_of_single_episodes_say(monkeypatch):
    # Quantiles are of the first episodes, which are many.
    monkeypatch.setattr("safe_envs.agents.evaluation.episodes._QUANTILES_OF", 30)
    w = sp.Symbol("w")
    problem = make_problem("Scalar-v0", noise=0.8, input_bounds=[-0.5, 3.0], dt=0.02, horizon=0.5)
    problem = replace(problem, start="wide", starts={"wide": Start((1.7 * w - 0.5,), (w,))})
    given = {"episodes": 40, "num_envs": 7, "bounds": False, "record": True, "confidence": 0.9}
    answer = evaluate(problem, "random", ["none", "cbf:alpha=2"], **given)
    columns = answer.episode_columns()
    for row in answer.rows:
        each = {name: values[columns["filter"] == row.filter] for name, values in columns.items()}
        assert each["episode"].tolist() == list(range(40))
        np.testing.assert_array_equal(answer.safe[row.filter][0].array, each["safe"])
        h, safe = answer.trajectories[row.filter].barrier, each["safe"]
        first = (h <= 0).argmax(axis=0)
        counted = np.where(safe, each["length"], first)
        # Some start outside, and have no step that counts.
        assert 0 < (counted == 0).sum() < row.violations < 40
        np.testing.assert_array_equal(each["length"], np.isfinite(h).sum(axis=0) - 1)
        np.testing.assert_allclose(each["min_h"], np.nanmin(h, axis=0))
        np.testing.assert_allclose(
            each["first_violation"], np.where(safe, np.nan, first * problem.dt)
        )
        assert row.safe == safe.sum() == 40 - row.violations
        assert (row.ci_low, row.ci_high) == rate_interval(row.safe, 40, 0.9)
        assert row.return_mean == pytest.approx(math.fsum(each["return"]) / 40)
        assert row.effort_mean == pytest.approx(np.nanmean(each["effort"]))
        assert row.min_h_median == np.median(each["min_h"][:30])
        assert row.min_h_p05 == np.quantile(each["min_h"][:30], 0.05)
        assert row.intervention_rate == each["interventions"].sum() / counted.sum()
        assert row.infeasible_rate == each["infeasible"].sum() / counted.sum()
    assert row.intervention_rate > row.infeasible_rate > 0.0


def test_counting_ends_with_the_first_violation_and_simulation_goes_on():
    # dx = (x + u) dt under constant u: x' = e^dt x + (e^dt - 1) u. Over the edge with the fourth
    # input, back, and over again.
    problem = make_problem("Scalar-v0", noise=0.0, start=[0.9], dt=0.05, horizon=0.5)
    inputs = [-0.5, -1.0, -0.9, 4.0, -9.0, -9.0, 0.0, 0.0, 9.0, 9.0]
    x, grown = [0.9], math.exp(0.05)
    for u in inputs:
        x.append(grown * x[-1] + (grown - 1) * u)
    h = 1 - np.array(x)
    assert ((h > 0) == [True] * 4 + [False] + [True] * 5 + [False]).all()
    policy = Schedule(problem, inputs)
    (row,) = evaluate(problem, policy, ["none"], episodes=3, num_envs=2, bounds=False).rows
    assert (row.safe, row.violations, row.policy) == (0, 3, "Schedule")
    assert row.min_h_median == pytest.approx(h.min(), rel=1e-6)
    assert row.effort_mean == pytest.approx(np.mean(np.square(inputs[:4])))
    assert row.return_mean == pytest.approx(np.exp(-((2 * h[1:]) ** 2)).sum(), rel=1e-6)
    assert row.curve.time == [k * 0.05 for k in range(11)]
    assert row.curve.safe == [3] * 4 + [0] * 7
    # Two batches of ten steps; a hidden state is None, and an episode starts, at the first of them
    # alone.
    assert policy.starts == 2 * [(True, True, True), *(9 * [(False, False, True)])]


@pytest.mark.parametrize("steps", [1, 200, 201, 401, 701])
def test_the_curve_of_a_long_episode_is_thinned_out_evenly_and_has_both_ends(steps):
    # The inputs let x grow by dt in each step: x' = e^dt x + (e^dt - 1) u.
    dt, last = 1e-3, steps // 2 + 1
    options = {"noise": 0.0, "start": [0.0], "dt": dt, "horizon": steps * dt}
    options["input_bounds"] = [-2.0, 2.0]
    x = np.cumsum([0.0] + [dt] * steps)
    inputs = (x[1:] - math.exp(dt) * x[:-1]) / (math.exp(dt) - 1)
    limit = {"limit": float(x[last - 1] + x[last]) / 2}
    problem = make_problem("Scalar-v0", **options, barrier=limit)
    (row,) = evaluate(problem, Schedule(problem, inputs), ["none"], episodes=2, bounds=False).rows
    instants = np.rint(np.array(row.curve.time) / dt).astype(int)
    assert (instants[0], instants[-1]) == (0, steps)
    assert min(steps + 1, 101) <= len(instants) <= 201
    gaps = np.diff(instants)
    assert len(set(gaps[:-1].tolist())) <= 1
    assert 0 < gaps[-1] <= gaps[0]
    assert row.curve.safe == [2 if k < last else 0 for k in instants]


def test_interventions_after_a_violation_do_not_count():
    # With u = 0 at first, x grows over the edge in step 3; a box with no negative input makes each
    # later step infeasible.
    problem = make_problem(
        "Scalar-v0", noise=0.0, start=[0.95], dt=0.02, input_bounds=[-0.5, 1.0], horizon=0.2
    )
    (row,) = evaluate(problem, Constant(1.0), ["cbf:alpha=1"], episodes=1, bounds=False).rows
    # The condition 1 - x - (x + u) >= 0 asks for u <= 1 - 2 x < -.5 from the start: the
    # least-violating action is -.5.
    steps = 0
    x = 0.95
    while x < 1.0:
        x = math.exp(0.02) * x - 0.5 * (math.exp(0.02) - 1)
        steps += 1
    assert 1 < steps < 10
    assert (row.intervention_rate, row.infeasible_rate, row.safe) == (1.0, 1.0, 0)
    assert row.effort_mean == pytest.approx(0.25)
    policy = Schedule(problem, [-0.5] * steps + [1.0] * (10 - steps))
    (mixed,) = evaluate(problem, policy, ["cbf:alpha=1"], episodes=1, bounds=False).rows
    assert mixed.intervention_rate == 0.0


def test_an_episode_that_starts_on_the_edge_is_unsafe_and_counts_no_step():
    options = {"noise": 0.0, "start": [1.0], "horizon": 0.1}
    answer = evaluate(
        "Scalar-v0", Constant(-0.5), ["none", "scbf"], options=options, episodes=2, bounds=False
    )
    for row in answer.rows:
        assert (row.safe, row.violations, row.touching, row.safety_rate) == (0, 2, 2, 0.0)
        assert (row.intervention_rate, row.infeasible_rate, row.effort_mean) == (None, None, None)
        assert row.min_h_median == row.min_h_p05 == 0.0
        assert row.return_mean > 0
    json.dumps(answer.document(), allow_nan=False)


def test_touching_the_edge_is_unsafe():
    options = {"noise": 0.0, "start": [0.5], "horizon": 0.05}
    up_and_down = [3.0, -3.0, -3.0, -3.0, -3.0]
    problem = make_problem("Scalar-v0", **options)
    given = {"filters": ["none"], "episodes": 1, "record": True}
    found = evaluate(problem, Schedule(problem, up_and_down), **given)
    reached = found.trajectories["none"].states[:, 0, 0]
    assert reached[1] == reached.max()
    for limit, safe in ((reached[1], 0), (np.nextafter(reached[1], 1.0), 1)):
        problem = make_problem("Scalar-v0", **{**options, "barrier": {"limit": float(limit)}})
        answer = evaluate(problem, Schedule(problem, up_and_down), **given)
        assert answer.trajectories["none"].barrier[1, 0] == limit - reached[1]
        assert answer.rows[0].safe == safe


def test_smallest_h_counts_the_start_and_the_last_instant():
    options = {"noise": 0.0, "start": [0.5], "horizon": 0.1}
    falling, rising = (
        evaluate("Scalar-v0", Constant(a), ["none"], options=options, episodes=1).rows[0]
        for a in (-1.0, 1.0)
    )
    assert falling.min_h_median == 0.5
    assert rising.min_h_median == pytest.approx(
        1 - (math.exp(0.1) * 0.5 + (math.exp(0.1) - 1) * 10), rel=1e-6
    )
