"""Evaluation: what is counted."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest

from safe_envs.agents import evaluate, make_problem
from tests.agents.evaluation.evaluated import Constant, Schedule, replay, safe_so_far

pytestmark = pytest.mark.slow

COUNTS = ("episodes", "safe", "violations")
MEASURES = (
    "safety_rate",
    "ci_low",
    "ci_high",
    "min_h_median",
    "min_h_p05",
    "effort_mean",
    "return_mean",
)
RATES = ("intervention_rate", "infeasible_rate")
KEYS = {
    "filter",
    "kind",
    "policy",
    *COUNTS,
    "touching",
    *MEASURES,
    *RATES,
    "curve",
    "held_bound",
    "held_word",
    "held_note",
    "held_error",
    "continuous_bound",
    "continuous_word",
    "continuous_note",
    "continuous_error",
    "posterior_bound",
    "withheld",
    "outside_rate",
    "learning",
}


@pytest.mark.parametrize(
    ("env_id", "spec", "policy", "options"),
    [
        ("safe_envs/Scalar-v0", "none", "random", {"noise": 0.8}),
        ("safe_envs/Scalar-v0", "cbf:alpha=2", "nominal", {"noise": 0.5, "horizon": 2.0}),
        (
            "safe_envs/Scalar-v0",
            "scbf",
            "random",
            {"noise": 0.3, "box": [-0.2, 3.0], "horizon": 1.0},
        ),
        ("safe_envs/StochasticDubins-v0", "scbf", "nominal", {"horizon": 3.0}),
        ("safe_envs/StochasticDubins-v0", "hocbf:p=1,1", "random", {"horizon": 3.0}),
        (
            "safe_envs/DubinsObstacle-v0",
            "hocbf",
            "nominal",
            {"noise": 0.05, "start": [1.5, 1.2, 0.3, 0.5, 1.0], "horizon": 3.0},
        ),
        ("safe_envs/QuadrotorAltitude-v0", "ecbf", "nominal", {"horizon": 4.0}),
        (
            "safe_envs/Quadrotor-v0",
            "hocbf",
            "nominal",
            {"noise": 0.3, "horizon": 1.5, "barrier": {"half_width": 0.7}},
        ),
    ],
)
def test_episodes_replayed_by_hand(env_id, spec, policy, options):
    episodes, seed = 7, 11
    answer = evaluate(
        env_id,
        policy,
        [spec],
        options=options,
        episodes=episodes,
        seed=seed,
        num_envs=5,
        record=True,
        bounds=False,
    )
    row, trajectories = replay(env_id, options, spec, policy, episodes, seed)
    assert set(answer.rows[0].as_dict()) == KEYS
    assert (answer.rows[0].filter, answer.rows[0].policy) == (spec, policy)
    for key in COUNTS:
        assert getattr(answer.rows[0], key) == row[key], key
    for key in MEASURES + RATES:
        assert getattr(answer.rows[0], key) == pytest.approx(row[key], rel=1e-7, abs=1e-9), key
    recorded = answer.trajectories[spec].barrier
    for i, h in enumerate(trajectories):
        np.testing.assert_allclose(recorded[: len(h), i], h, rtol=1e-6, atol=1e-7)
        assert np.isnan(recorded[len(h) :, i]).all()
    curve = answer.rows[0].curve
    assert curve.safe == safe_so_far(trajectories, curve.time, make_problem(env_id, **options).dt)
    assert curve.rate == [count / episodes for count in curve.safe]
    assert all(later <= earlier for earlier, later in itertools.pairwise(curve.safe))
    assert (curve.rate[-1], curve.ci_low[-1], curve.ci_high[-1]) == tuple(
        getattr(answer.rows[0], key) for key in ("safety_rate", "ci_low", "ci_high")
    )
    timing = answer.timing.rows[0]
    assert timing.steps == sum(len(h) - 1 for h in trajectories)
    assert timing.seconds > 0
    assert timing.steps_per_second == pytest.approx(timing.steps / timing.seconds)


def test_filters_that_know_the_plant_are_replayed_too():
    env_id, options = "safe_envs/QuadrotorAltitude-v0", {"horizon": 3.0, "start": [5.0, 2.0]}
    for knowledge in ("model", "plant"):
        answer = evaluate(
            env_id, filters=["hocbf"], options=options, episodes=1, knowledge=knowledge
        )
        row, _ = replay(env_id, options, "hocbf", "nominal", 1, 0, knowledge)
        assert answer.rows[0].min_h_median == pytest.approx(row["min_h_median"], rel=1e-9)
        assert answer.rows[0].effort_mean == pytest.approx(row["effort_mean"], rel=1e-9)


def test_counting_ends_with_the_first_violation_and_simulation_goes_on():
    # dx = (x + u) dt under constant u: x' = e^dt x + (e^dt - 1) u. Over the edge with the fourth
    # input, back, and over again.
    problem = make_problem("Scalar-v0", noise=0.0, start=[0.9], dt=0.05, horizon=0.5)
    inputs = [-0.5, -1.0, -0.9, 4.0, -9.0, -9.0, 0.0, 0.0, 9.0, 9.0]
    x, grown = [0.9], math.exp(0.05)
    for u in inputs:
        x.append(grown * x[-1] + (grown - 1) * u)
    h = 1 - np.array(x)
    assert (h[:4] > 0).all()
    assert h[4] < 0
    assert (h[5:9] > 0).all()
    assert h[10] == h.min() < 0
    policy = Schedule(problem, inputs)
    (row,) = evaluate(problem, policy, ["none"], episodes=3, num_envs=2).rows
    assert (row.safe, row.violations, row.policy) == (0, 3, "Schedule")
    assert row.min_h_median == pytest.approx(h.min(), rel=1e-6)
    assert row.effort_mean == pytest.approx(np.mean(np.square(inputs[:4])))
    assert row.return_mean == pytest.approx(np.exp(-((2 * h[1:]) ** 2)).sum(), rel=1e-6)
    # Two waves of ten steps; a hidden state is None, and an episode starts, at the first of them
    # alone.
    assert policy.starts == 2 * [(True, True, True), *(9 * [(False, False, True)])]


def test_curve_of_one_episode_falls_at_its_first_violation_for_good():
    problem = make_problem("Scalar-v0", noise=0.0, start=[0.9], dt=0.05, horizon=0.5)
    inputs = [-0.5, -1.0, -0.9, 4.0, -9.0, -9.0, 0.0, 0.0, 9.0, 9.0]
    (row,) = evaluate(problem, Schedule(problem, inputs), ["none"], episodes=3, num_envs=2).rows
    assert row.curve.time == [k * 0.05 for k in range(11)]
    assert row.curve.safe == [3] * 4 + [0] * 7


def test_curve_of_a_long_episode_is_thinned_out():
    # The inputs let x grow by dt in each of 701 steps: x' = e^dt x + (e^dt - 1) u.
    options = {"noise": 0.0, "start": [0.0], "dt": 1e-3, "horizon": 0.701, "box": [-2.0, 2.0]}
    x = np.cumsum([0.0] + [1e-3] * 701)
    inputs = (x[1:] - math.exp(1e-3) * x[:-1]) / (math.exp(1e-3) - 1)
    for last in (301, 303, 700, 701):
        problem = make_problem(
            "Scalar-v0", **{**options, "barrier": {"limit": float(x[last - 1] + x[last]) / 2}}
        )
        (row,) = evaluate(problem, Schedule(problem, inputs), ["none"], episodes=2).rows
        assert len(row.curve.time) == 177
        assert row.curve.time[-1] == pytest.approx(0.701)
        assert row.curve.safe == [2 if round(t / 1e-3) < last else 0 for t in row.curve.time]


def test_interventions_after_a_violation_do_not_count():
    # With u = 0 at first, x grows over the edge in step 3; a box with no negative input makes each
    # later step infeasible.
    problem = make_problem(
        "Scalar-v0", noise=0.0, start=[0.95], dt=0.02, box=[-0.5, 1.0], horizon=0.2
    )
    (row,) = evaluate(problem, Constant(1.0), ["cbf:alpha=1"], episodes=1).rows
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
    (mixed,) = evaluate(
        problem,
        Schedule(problem, [-0.5] * steps + [1.0] * (10 - steps)),
        ["cbf:alpha=1"],
        episodes=1,
    ).rows
    assert mixed.intervention_rate == 0.0


def test_an_episode_that_starts_on_the_edge_is_unsafe_and_counts_no_step():
    options = {"noise": 0.0, "start": [1.0], "horizon": 0.1}
    answer = evaluate("Scalar-v0", Constant(-0.5), ["none", "scbf"], options=options, episodes=2)
    for row in answer.rows:
        assert (row.safe, row.violations, row.safety_rate) == (0, 2, 0.0)
        assert (row.intervention_rate, row.infeasible_rate, row.effort_mean) == (None, None, None)
        assert row.min_h_median == row.min_h_p05 == 0.0
        assert row.return_mean > 0
    json.dumps(answer.document(), allow_nan=False)


def test_touching_the_edge_is_unsafe():
    options = {"noise": 0.0, "start": [0.5], "horizon": 0.05}
    up_and_down = [3.0, -3.0, -3.0, -3.0, -3.0]
    problem = make_problem("Scalar-v0", **options)
    reached = (
        evaluate(problem, Schedule(problem, up_and_down), ["none"], episodes=1, record=True)
        .trajectories["none"]
        .states[:, 0, 0]
    )
    assert reached[1] == reached.max()
    for limit, safe in ((reached[1], 0), (np.nextafter(reached[1], 1.0), 1)):
        problem = make_problem("Scalar-v0", **{**options, "barrier": {"limit": float(limit)}})
        answer = evaluate(
            problem, Schedule(problem, up_and_down), ["none"], episodes=1, record=True
        )
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
