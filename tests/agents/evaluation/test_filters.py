"""Filters in an evaluation: on the same episodes, each with intervals, and compared."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import NominalController, evaluate, make_problem
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    rate_interval,
)
from safe_envs.wrappers import HOCBF, SCBF, SafetyFilterWrapper, spec_of

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"


def test_filters_see_the_same_episodes_and_are_compared_on_them():
    filters = ["none", "hocbf:alpha=1,2", "scbf"]
    given = {"options": {"horizon": 3.0, "noise": 0.4}, "episodes": 100, "seed": 4}
    given |= {"confidence": 0.9, "bounds": False}
    answer = evaluate(DUBINS, filters=filters, num_envs=64, record=True, **given)
    safe = {name: (answer.trajectories[name].barrier > 0).all(axis=0) for name in filters}
    pairs = [(c.first, c.second) for c in answer.comparisons]
    assert pairs == [(filters[1], filters[0]), (filters[2], filters[0]), (filters[2], filters[1])]
    for c in answer.comparisons:
        a, b = safe[c.first], safe[c.second]
        table = [int(flags.sum()) for flags in (a & b, a & ~b, ~a & b, ~a & ~b)]
        assert [c.both, c.only_first, c.only_second, c.neither] == table
        assert c.difference == pytest.approx(a.mean() - b.mean())
        assert (c.ci_low, c.ci_high) == paired_difference_interval(*table, 0.9)
        assert c.mcnemar_p == mcnemar_p(*table[1:3])
    assert answer.document()["comparisons"] == [vars(c) for c in answer.comparisons]
    # Together at first, and never together again.
    bare, filtered = (answer.trajectories[name].states for name in filters[:2])
    np.testing.assert_array_equal(bare[0], filtered[0])
    parted = (bare != filtered).any(axis=2)
    assert parted.any()
    assert (np.diff(parted.astype(int), axis=0) >= 0).all()
    # Alone a filter has the same row.
    (row,) = evaluate(DUBINS, filters=filters[2], **given).rows
    assert row == answer.rows[2]


def test_confidence_is_that_of_every_interval():
    given = {"options": {"horizon": 0.5, "noise": 0.8}, "episodes": 100, "bounds": False}
    narrow, wide = (
        evaluate("Scalar-v0", filters=["none", "scbf"], confidence=c, **given) for c in (0.5, 0.999)
    )
    assert (narrow.config["confidence"], wide.config["confidence"]) == (0.5, 0.999)
    for a, b in zip(narrow.rows, wide.rows, strict=True):
        assert (a.ci_low, a.ci_high) == rate_interval(a.safe, 100, 0.5)
        assert b.ci_low < a.ci_low < a.safety_rate < a.ci_high < b.ci_high
        assert b.curve.ci_low[-1] < a.curve.ci_low[-1]
        assert a.curve.rate == b.curve.rate
    assert wide.comparisons[0].ci_low < narrow.comparisons[0].ci_low


def test_a_filter_that_never_acts_leaves_everything_as_it_is():
    given = {"options": {"horizon": 1.0, "noise": 1.5}, "episodes": 20, "bounds": False}
    answer = evaluate("ACC-v0", "random", ["none", "cbf:alpha=50"], record=True, **given)
    bare, filtered = answer.rows
    assert (bare.intervention_rate, filtered.intervention_rate) == (0.0, 0.0)
    for name in ("safe", "return_mean", "effort_mean", "min_h_median", "curve"):
        assert getattr(bare, name) == getattr(filtered, name)
    states = [answer.trajectories[row.filter].states for row in answer.rows]
    np.testing.assert_array_equal(*states)


def test_a_filter_may_have_a_condition_for_each_barrier_and_be_objects():
    problem = make_problem(DUBINS, horizon=1.0, noise=0.4)
    disk = problem.barriers[0]
    wall = replace(disk, name="wall", expression=1 - problem.plant.states[0])
    problem = replace(problem, barriers=(disk, wall))
    filters = ["hocbf:alpha=1.0,1.0+hocbf:alpha=2.0,8.0", "hocbf:alpha=2.0,8.0+hocbf:alpha=1.0,1.0"]
    objects = [HOCBF(alpha=(2.0, 8.0)), (SCBF.for_gains((1.0, 1.0)),) * 2]
    answer = evaluate(problem, filters=[*filters, *objects], episodes=20, bounds=False)
    names = [*filters, "hocbf:alpha=2.0,8.0"]
    assert [f["spec"] for f in answer.config["filters"]][:3] == names
    assert len({row.effort_mean for row in answer.rows}) == 4
    (text,) = evaluate(problem, filters=spec_of(objects[0]), episodes=20, bounds=False).rows
    assert text == answer.rows[2]
    for call, fragment in (("hocbf+hocbf+hocbf", "3"), ((HOCBF(alpha=(1.0, 1.0)),) * 3, "3")):
        with pytest.raises(ConfigurationError, match=f"{fragment} conditions"):
            evaluate(problem, filters=[call])


def test_the_log_of_the_first_episode_has_its_decisions():
    found = evaluate(DUBINS, filters=["none", "hocbf"], episodes=3, record=True, bounds=False)
    log = found.trajectories["hocbf"].log
    env = SafetyFilterWrapper(gym.make(DUBINS), "hocbf")
    problem, policy = found.problem, NominalController(found.problem)
    observation, info = env.reset(seed=episode_seed(0, 0))
    sections = map(log.section, ("h", "nominal", "action", "slack"))
    for k, row in enumerate(zip(*sections, strict=True)):
        barrier = info["barrier"]
        state = log.section("state")[k]
        np.testing.assert_allclose(env.unwrapped.components, state, rtol=1e-9, atol=1e-12)
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        expected = (barrier, info["nominal_action"], info["safe_action"], info["slacks"])
        for values, there in zip(row, expected, strict=True):
            np.testing.assert_allclose(values, there, rtol=1e-6, atol=1e-9)
        assert log.t[k] == pytest.approx(k * problem.dt)
        assert (log.intervention[k], log.feasible[k]) == (info["intervention"], info["feasible"])
    assert terminated or truncated
    assert log.interventions == info["episode_interventions"] > 0
    assert log.columns.units["omega"] == "rad/s"
    np.testing.assert_array_equal(log.section("high")[:, 0], problem.input_bounds[0][1])
    # Without a filter what is proposed is executed.
    bare = found.trajectories["none"].log
    np.testing.assert_array_equal(bare.section("nominal"), bare.section("action"))
    assert np.ptp(bare.section("action")) > 0.0
    assert (bare.interventions, bare.infeasible) == (0, 0)
