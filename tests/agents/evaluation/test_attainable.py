"""How safe any policy can be, from the starts of an env, and how rows are measured by it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import attainable
from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    SimulatedRate,
    TimesUnavoidable,
    attainable_safety,
    best_for,
    held_against,
    simulate,
    times_unavoidable,
)
from safe_envs.files import VARIABLE, entries
from safe_envs.registry import make_problem
from tests.agents.policies.coarse import COARSE, SHORT, coarse

NEAR_THE_EDGE = {**SHORT, "start": [0.8], "noise": 1.5}


@pytest.fixture
def empty_cache(monkeypatch, tmp_path):
    """What is computed is kept in an empty folder."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))


def made_up(lower, upper) -> AttainableSafety:
    return AttainableSafety(
        lower, upper, None, "", "plant", "violation", "", ("x",), (3,), 2, 10, 1.0, 80
    )


@pytest.fixture(scope="module")
def greedy():
    """What is attainable near the edge, and the greedy policy of its table."""
    problem = make_problem("Scalar-v0", **NEAR_THE_EDGE)
    return attainable_safety(problem, coarse(leaving="safe"), episodes=300, num_envs=128)


def test_the_greedy_policy_has_a_rate_between_the_ends_and_is_simulated_as_evaluate_does(greedy):
    found, policy = greedy
    s = found.simulated
    assert 0.5 < found.lower < found.upper < 1.0
    assert found.lower <= s.high
    assert s.low <= found.upper
    assert found.contradiction == ""
    problem = make_problem("Scalar-v0", **NEAR_THE_EDGE)
    row = evaluate(problem, policy, "none", episodes=300, bounds=False).rows[0]
    assert (s.safe, s.low, s.high) == (row.safe, row.ci_low, row.ci_high)
    assert s.safe < 300


def test_leaving_is_counted_as_it_was_asked_for():
    # Below x = -3 the workspace ends, in the safe set.
    problem = make_problem("Scalar-v0", **{**SHORT, "start": [-2.9], "noise": 2.0})
    _, policy = attainable_safety(problem, COARSE, episodes=0)
    staying = simulate(policy, 400, 0, 0.95, 400)
    policy.settings = coarse(leaving="safe")
    as_counted = simulate(policy, 400, 0, 0.95, 400)
    assert staying.leave_rate == as_counted.leave_rate > 0.05
    assert as_counted.rate == pytest.approx(staying.rate + staying.leave_rate)
    row = evaluate(problem, policy, "none", episodes=400, bounds=False).rows[0]
    assert as_counted.safe == row.safe


def test_the_worlds_of_plant_and_model_differ():
    # The plant has noise near the edge, the model has little.
    problem = make_problem("Scalar-v0", **NEAR_THE_EDGE, model={"sigma": 0.3})
    settings = coarse(knowledge="plant")
    found = [
        attainable_safety(each, replace(settings, knowledge=knowledge), episodes=50)[0]
        for each, knowledge in (
            (problem, "plant"),
            (problem, "model"),
            (replace(problem, plant=problem.model), "plant"),
        )
    ]
    ends = [(each.lower, each.upper) for each in found]
    assert ends[0] != ends[1] == ends[2]
    assert found[0].simulated != found[1].simulated == found[2].simulated


@pytest.mark.parametrize(
    ("lower", "upper", "where"),
    [(0.7, 0.9, ""), (0.7, 0.75, "above the upper"), (0.85, 0.9, "below the lower")],
)
def test_bounds_that_the_greedy_policy_contradicts_are_withheld(greedy, lower, upper, where):
    rate = replace(greedy[0].simulated, rate=0.8, safe=8000, episodes=10_000)
    judged = attainable.judged(replace(made_up(lower, upper), simulated=rate))
    assert where in judged.contradiction
    assert (judged.lower is None) == (judged.upper is None) == bool(where)
    assert bool(judged.contradiction) == bool(where)


@pytest.mark.parametrize(("safe", "lower", "kept"), [(999, 0.99999, True), (990, 0.99999, False)])
def test_a_single_violation_contradicts_no_lower_bound(safe, lower, kept):
    interval = {"low": 0.0, "high": 1.0, "confidence": 0.95, "leave_rate": 0.0, "seed": 0}
    rate = SimulatedRate(safe=safe, episodes=1000, rate=safe / 1000, **interval)
    judged = attainable.judged(replace(made_up(lower, 1.0), simulated=rate))
    assert (judged.lower == lower) == kept


def test_bounds_that_a_row_exceeds_are_withheld():
    given = {"options": {"horizon": 0.2, "start": [0.0]}, "episodes": 60, "bounds": False}
    rows = evaluate("Scalar-v0", "zero", "cbf", **given).rows
    assert rows[0].safe == 60
    assert held_against(made_up(0.5, 1.0), rows).upper == 1.0
    judged = held_against(made_up(0.5, 0.7), rows)
    assert judged.upper is None
    assert "cbf is safe in" in judged.contradiction
    # The interval of these few episodes does not contradict it.
    assert held_against(made_up(0.5, 0.95), rows).upper == 0.95


@pytest.mark.parametrize(
    ("best", "interval", "times"),
    [
        ((0.9, 0.98), (0.8, 0.85), (1.5, 10.0)),
        ((0.9, 1.0), (0.8, 0.85), (1.5, None)),
        ((0.9, 0.95), (0.92, 0.99), (1.0, 1.6)),
        ((0.9, 0.91), (0.95, 0.99), (1.0, 1.0)),
    ],
)
def test_times_unavoidable_is_an_interval(best, interval, times):
    found = times_unavoidable(made_up(*best), *interval)
    assert found is not None
    assert (found.low, found.high) == pytest.approx(times)


def test_times_unavoidable_means_nothing_where_none_is():
    assert times_unavoidable(None, 0.8, 0.9) is None
    assert times_unavoidable(made_up(None, None), 0.8, 0.9) is None
    assert times_unavoidable(made_up(1.0, 1.0), 0.8, 0.9) is None


def test_the_interval_holds_the_true_ratio():
    rng = np.random.default_rng(0)
    for _ in range(200):
        avoidable, measured = np.sort(rng.uniform(0.001, 0.5, 2))
        lower, upper = 1 - avoidable - rng.random() * 0.1, 1 - avoidable * rng.random()
        ends = 1 - measured - rng.random() * 0.1, 1 - measured * rng.random()
        found = times_unavoidable(made_up(lower, upper), *ends)
        assert isinstance(found, TimesUnavoidable)
        assert found.low <= measured / avoidable <= (found.high or np.inf) * (1 + 1e-12)


def test_an_evaluation_shows_what_it_computes_or_finds(monkeypatch, empty_cache):
    monkeypatch.setattr(attainable, "evaluation_settings", lambda problem: COARSE)
    given = {"options": NEAR_THE_EDGE, "filters": ["none"], "episodes": 50, "bounds": False}
    assert evaluate("Scalar-v0", **given).document()["best"] is None
    computed = evaluate("Scalar-v0", best=True, **given)
    best = computed.best
    assert best is not None
    assert best.lower is not None
    shown = computed.document()["best"]
    assert (shown["lower"], shown["upper"]) == (best.lower, best.upper)
    times = times_unavoidable(best, computed.rows[0].ci_low, computed.rows[0].ci_high)
    assert times is not None
    assert shown["times_unavoidable"] == {"none": {"low": times.low, "high": times.high}}
    # It is in the cache now, and shown only where it is asked for.
    assert evaluate("Scalar-v0", **given).best is None


def test_what_is_attainable_from_the_starts_is_computed_once(monkeypatch, empty_cache):
    monkeypatch.setattr(attainable, "evaluation_settings", lambda problem: COARSE)
    problem = make_problem("Scalar-v0", **NEAR_THE_EDGE)
    found = best_for(problem)
    (kept,) = entries("attainable")
    with monkeypatch.context() as patch:
        patch.setattr(attainable, "attainable_safety", lambda *_, **__: pytest.fail("again"))
        assert best_for(problem) == found
        # From other starts something else is attainable.
        with pytest.raises(pytest.fail.Exception):
            best_for(make_problem("Scalar-v0", **{**NEAR_THE_EDGE, "start": [0.5]}))
    for damaged in ("", "[]", "{}", json.dumps({**vars(found), "lower": 2.0})):
        kept.place.write_text(damaged)
        assert best_for(problem) == found
