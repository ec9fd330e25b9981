"""Filters in an evaluation: on the same episodes, each with intervals, and compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    rate_interval,
)

pytestmark = pytest.mark.slow


def test_comparisons_are_of_the_same_episodes():
    filters = ["none", "hocbf:p=1,2", "scbf"]
    arguments = {
        "options": {"horizon": 4.0, "noise": 0.4},
        "episodes": 150,
        "seed": 4,
        "bounds": False,
    }
    answer = evaluate(
        "StochasticDubins-v0",
        filters=filters,
        num_envs=64,
        record=True,
        confidence=0.9,
        **arguments,
    )
    safe = {name: (answer.trajectories[name].barrier > 0).all(axis=0) for name in filters}
    assert [(c.first, c.second) for c in answer.comparisons] == [
        ("hocbf:p=1,2", "none"),
        ("scbf", "none"),
        ("scbf", "hocbf:p=1,2"),
    ]
    for c in answer.comparisons:
        a, b = safe[c.first], safe[c.second]
        table = [int(flags.sum()) for flags in (a & b, a & ~b, ~a & b, ~a & ~b)]
        assert [c.both, c.only_first, c.only_second, c.neither] == table
        assert c.difference == pytest.approx(a.mean() - b.mean())
        assert (c.ci_low, c.ci_high) == paired_difference_interval(*table, 0.9)
        assert c.mcnemar_p == mcnemar_p(*table[1:3])
    last = answer.comparisons[2]
    assert min(last.both, last.only_first, last.neither) > 0
    assert answer.document()["comparisons"] == [vars(c) for c in answer.comparisons]
    assert evaluate("StochasticDubins-v0", filters=["scbf"], **arguments).comparisons == []


def test_confidence_is_that_of_every_interval():
    options = {"horizon": 1.0, "noise": 0.5}
    narrow, wide = (
        evaluate("Scalar-v0", filters=["none", "scbf"], options=options, episodes=200, confidence=c)
        for c in (0.5, 0.999)
    )
    assert (narrow.config["confidence"], wide.config["confidence"]) == (0.5, 0.999)
    for a, b in zip(narrow.rows, wide.rows, strict=True):
        assert (a.ci_low, a.ci_high) == rate_interval(a.safe, 200, 0.5)
        assert b.ci_low < a.ci_low < a.safety_rate < a.ci_high < b.ci_high
        assert b.curve.ci_low[-1] < a.curve.ci_low[-1]
        assert a.curve.rate == b.curve.rate
    assert wide.comparisons[0].ci_low < narrow.comparisons[0].ci_low


def test_episodes_that_are_all_safe_have_the_exact_interval():
    (row,) = evaluate("ACC-v0", filters=["scbf"], options={"horizon": 0.2}, episodes=1000).rows
    assert (row.safe, row.ci_low, row.ci_high) == (1000, pytest.approx(0.025 ** (1 / 1000)), 1.0)


def test_a_filter_that_never_acts_leaves_everything_as_it_is():
    options = {"horizon": 3.0, "noise": 1.5}
    answer = evaluate(
        "ACC-v0",
        "random",
        ["none", "cbf:alpha=50"],
        options=options,
        episodes=40,
        num_envs=16,
        record=True,
    )
    bare, filtered = answer.rows
    assert (bare.intervention_rate, filtered.intervention_rate) == (0.0, 0.0)
    alike = {
        "filter": "",
        "kind": "filter",
        "continuous_note": "",
        "held_note": "",
        "outside_rate": None,
    }
    assert replace(bare, **alike) == replace(filtered, **alike)
    np.testing.assert_array_equal(
        answer.trajectories["none"].states, answer.trajectories["cbf:alpha=50"].states
    )


def test_filters_see_the_same_episodes_until_they_act():
    answer = evaluate(
        "StochasticDubins-v0",
        "random",
        ["none", "hocbf"],
        episodes=30,
        options={"horizon": 2.0},
        record=True,
        bounds=False,
    )
    bare, filtered = (answer.trajectories[name].states for name in ("none", "hocbf"))
    np.testing.assert_array_equal(bare[0], filtered[0])
    parted = (bare != filtered).any(axis=2)
    assert parted.any()
    # Together at first, and never together again.
    assert (np.diff(parted.astype(int), axis=0) >= 0).all()


def test_a_filter_may_have_a_condition_for_each_barrier():
    problem = make_problem("StochasticDubins-v0", horizon=1.0, noise=0.4)
    disk = problem.barriers[0]
    wall = replace(disk, name="wall", expression=1 - problem.plant.states[0])
    problem = replace(problem, barriers=(disk, wall))
    filters = [
        "hocbf:p=1.0,1.0+hocbf:p=2.0,8.0",
        "hocbf:p=2.0,8.0+hocbf:p=1.0,1.0",
        "hocbf:p=2.0,8.0",
    ]
    answer = evaluate(problem, filters=filters, episodes=30)
    assert [f["spec"] for f in answer.config["filters"]] == filters
    assert len({row.effort_mean for row in answer.rows}) == 3
    with pytest.raises(ConfigurationError, match="has 3 conditions"):
        evaluate(problem, filters=["hocbf+hocbf+hocbf"])
