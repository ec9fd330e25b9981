"""Certified bounds of controllers in evaluations: of what, when, and why there is none."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.bounds import (
    FilteredPolicy,
    closed_loop_bound,
    compute_closed_loop,
)
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.values import closed_loop
from safe_envs.values.promise_filter import PromiseSettings
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of

SHORT = {"horizon": 0.1, "noise": 1.0}
GIVEN = {"options": SHORT, "episodes": 200, "best": False}


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", str(tmp_path))
    monkeypatch.setattr(closed_loop, "CELLS", {1: 400, 2: 400})


def of(text="scbf", policy="nominal", env="Scalar", **given):
    problem = problem_of(f"safe_envs/{env}-v0", **SHORT)
    parts = parse_conditions(text, problem) if text else ()
    return FilteredPolicy(problem, parts, "model", policy, **{"closed_loop": True, **given})


def test_rows_have_it_where_it_is_asked_for():
    none, scbf = evaluate("Scalar-v0", filters=["none", "scbf"], **GIVEN).rows
    assert (none.held_bound, scbf.held_bound) == (None, None)
    done = []
    asked = {**GIVEN, "closed_loop": True, "progress": done.append}
    found = evaluate("Scalar-v0", filters=["none", "scbf"], **asked)
    assert done[-1] == pytest.approx(1.0)
    assert done == sorted(done)
    for row in found.rows:
        assert row.held_word == "certified"
        assert 0.3 < row.held_bound <= row.ci_high
        assert row.held_note == "by a table of this policy, 401 cells"
    # A table that is kept changes nothing for those who do not ask for it.
    assert evaluate("Scalar-v0", filters=["none", "scbf"], **GIVEN).rows == [none, scbf]


def test_the_bound_is_at_the_starts_that_are_given():
    held = compute_closed_loop(of())
    bound = closed_loop_bound(of())
    starts = np.array([[0.5], [0.9], [9.0]])
    assert (bound.at(starts) == held.start_bounds((starts[:, 0],))).all()
    assert bound.at(starts)[0] > bound.at(starts)[2] == 0.0
    assert (bound.at(np.repeat(starts[:1], 5, axis=0)) == bound.at(starts)[0]).all()
    assert bound.at(np.zeros((0, 1))).shape == (0,)


def test_policies_without_a_formula_have_that_of_every_policy():
    tables = [compute_closed_loop(of(policy=name)) for name in ("random", "")]
    assert tables[0] is tables[1]
    bound = closed_loop_bound(of(policy="random"))
    assert "of every policy under the filter" in bound.note
    own = compute_closed_loop(of())
    starts = np.linspace(-0.9, 0.9, 9)[:, None]
    assert (bound.at(starts) <= own.start_bounds((starts[:, 0],)) + 1e-6).all()


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"text": "", "policy": "random"}, "'random' is no formula of the state"),
        ({"text": "", "policy": ""}, "the policy is no formula of the state"),
        ({"objective": "clf"}, "take the nearest input"),
        ({"text": "srcbf"}, "the constraint of srcbf is not of the form"),
        ({"env": "StochasticDubins", "text": ""}, "3 states"),
    ],
)
def test_why_there_is_none_is_said_where_it_was_asked_for(given, why):
    compute_closed_loop(of())
    asked = of(**given)
    assert compute_closed_loop(asked) is None
    assert why in closed_loop_bound(asked).why_none
    assert closed_loop_bound(of(closed_loop=False, **given)) is None


def test_a_promise_filter_has_a_table_of_its_own():
    asked = FilteredPolicy(of().problem, PromiseSettings(0.9), "model", "nominal", "nearest", True)
    assert compute_closed_loop(asked) is None
    assert closed_loop_bound(asked) is None


@pytest.mark.parametrize(
    "given", [{"monitoring": "continuous"}, {"bounds": False}, {"closed_loop": "yes"}]
)
def test_what_does_not_go_with_it_is_refused(given):
    with pytest.raises(ConfigurationError, match="closed_loop = "):
        EvaluationSpec("safe_envs/Scalar-v0", **{"closed_loop": True, **given})
    with pytest.raises(ConfigurationError, match="4 inputs"):
        evaluate("Quadrotor-v0", closed_loop=True, episodes=1)
