"""Evaluations at the true state, at the estimate and with its belief."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safe_envs import SafeVectorEnv
from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.resolve import why_belief_not_proved
from safe_envs.filters.estimation import make_estimator
from safe_envs.registry import make_problem
from safe_envs.wrappers import SCBF, SafetyFilterVectorWrapper, StateEstimatorVectorWrapper

ENV = "safe_envs/Pendulum-v0"
OPTIONS = {"measurement": "default", "horizon": 0.3}
PLAIN = {"episodes": 20, "bounds": False}
SHORT = {"options": OPTIONS, "estimator": "ekf", **PLAIN}


def test_each_filter_has_a_row_for_each_view_and_those_at_the_state_know_no_sensor():
    found = evaluate(ENV, filters=["none", "scbf"], **SHORT)
    names = [row.filter for row in found.rows]
    assert names == ["none@state", "none", "scbf@state", "scbf", "scbf:belief=0.05"]
    for row in found.rows:
        assert (row.estimation is None) == row.filter.endswith("@state")
        assert (getattr(row.estimation, "outside_rate", None) is None) != ("belief" in row.filter)
    plain = evaluate(ENV, filters=["scbf"], options={"horizon": 0.3}, **PLAIN)
    one, other = found.row("scbf@state"), plain.row("scbf")
    for name in ("safe", "return_mean", "effort_mean", "min_h_median"):
        assert getattr(one, name) == getattr(other, name)
    assert evaluate(ENV, filters=["none", "scbf"], num_envs=7, **SHORT).rows == found.rows
    # The document and the tables tell of the sensor.
    document = json.loads(json.dumps(found.document()))
    assert document["config"]["estimator"] == "ekf"
    channels = [c["name"] for c in document["config"]["measurement"]["channels"]]
    assert channels == ["theta", "thetadot"]
    rows = {row["filter"]: row for row in document["rows"]}
    assert "estimation" not in rows["scbf@state"]
    assert rows["scbf"]["estimation"]["nees"]["expected"] == 2.0
    for text in (str(found), found.to_markdown(), found.to_latex()):
        assert "ekf" in text


DISK = {"problem": "DubinsDisk-v0", "knowledge": "plant"}
ERROR = "scbf:measurement_error=0.01"


@pytest.mark.parametrize(
    ("filters", "more", "names"),
    [
        ([SCBF()], {"belief": 0.2}, ["scbf@state", "scbf", "scbf:belief=0.2"]),
        # A bound of the error takes the place of the belief.
        ([ERROR], {}, [f"{ERROR}@state", ERROR]),
        ([SCBF(measurement_error=0.01)], {}, [f"{ERROR}@state", ERROR]),
        # Named views are the only ones.
        (["scbf@state", "szcbf"], {}, ["scbf@state", "szcbf"]),
        # A filter by itself has no belief.
        (["backup"], DISK, ["backup@state", "backup"]),
    ],
)
def test_views_of_a_filter(filters, more, names):
    given = {"problem": ENV, **SHORT, "episodes": 2, "filters": filters, **more}
    assert [row.filter for row in evaluate(**given).rows] == names


def test_estimates_are_counted_as_the_envs_report_them():
    (row,) = evaluate(ENV, filters=["scbf:belief=0.1"], **SHORT).rows
    problem = make_problem(ENV, **OPTIONS)
    env = StateEstimatorVectorWrapper(SafeVectorEnv(problem, 20))
    env = SafetyFilterVectorWrapper(env, "scbf:belief=0.1")
    policy = NominalController(problem.unmeasured)
    seen, info = env.reset(seed=[episode_seed(0, i) for i in range(20)])
    sums = {key: info[key].sum() for key in ("nees", "nees_dof", "nis", "nis_dof")}
    outside, count, alive = info["belief_barrier"][:, 0] < 0, 20, np.ones(20, dtype=bool)
    for _ in range(problem.steps):
        seen, _, ended, cut, info = env.step(policy.predict(seen)[0])
        for key in sums:
            sums[key] += info[key][alive].sum()
        outside |= alive & (info["belief_barrier"][:, 0] < 0)
        count += alive.sum()
        alive &= ~(ended | cut)
    found = row.estimation
    assert found.nees.mean == pytest.approx(sums["nees"] / count)
    assert found.nees.expected == pytest.approx(sums["nees_dof"] / count)
    assert found.nis.mean == pytest.approx(sums["nis"] / count)
    assert found.outside_rate == pytest.approx(outside.mean())
    assert found.delta == 0.1
    assert found.unsafe_at_most == pytest.approx(found.outside_high + 0.1)


def test_bounds_of_true_states_are_not_those_of_estimates():
    options = {"measurement": "default", "horizon": 0.5, "start": [0.0]}
    given = {**SHORT, "bounds": True, "options": options}
    found = evaluate("Scalar-v0", filters=["scbf"], **given)
    assert found.row("scbf@state").continuous_bound == pytest.approx(0.25)
    for name in ("scbf", "scbf:belief=0.05"):
        assert found.row(name).continuous_bound is found.row(name).held_bound is None


@pytest.mark.parametrize(
    ("env_id", "changes", "estimator", "monitoring", "fragment"),
    [
        ("Pendulum-v0", {}, "ekf", "discrete", "not affine"),
        ("Pendulum-v0", {"measurement": ["default:bias=0.1"]}, "ekf", "discrete", "not affine"),
        ("Scalar-v0", {}, "kf", "discrete", None),
        ("Scalar-v0", {}, "ekf", "discrete", None),
        ("Scalar-v0", {"start": "spread"}, "kf", "discrete", "start"),
        ("Scalar-v0", {"measurement": ["default:bias=.1"]}, "kf", "discrete", "biased"),
        ("Scalar-v0", {"model": {"sigma": 0.1}}, "kf", "discrete", "model"),
        ("Scalar-v0", {}, "kf:process_noise=0.1", "discrete", "noise"),
        ("Scalar-v0", {}, "ukf", "discrete", "ukf"),
        ("Scalar-v0", {}, "kf", "continuous", "between"),
    ],
)
def test_a_bound_of_beliefs_is_proved_of_a_known_linear_system_alone(
    env_id, changes, estimator, monitoring, fragment
):
    start = {"start": "origin"} if env_id == "Scalar-v0" else {}
    problem = make_problem(env_id, **{"measurement": "default", **start, **changes})
    reason = why_belief_not_proved(problem, make_estimator(estimator, problem), monitoring)
    assert (reason is None) if fragment is None else (fragment in reason)


@pytest.mark.parametrize(
    ("monitoring", "word"), [("discrete", "proved"), ("continuous", "designed")]
)
def test_rows_say_what_the_bound_of_their_belief_is(monitoring, word):
    options = {"measurement": "default", "horizon": 0.1, "start": "origin"}
    given = {**SHORT, "options": options, "monitoring": monitoring}
    (row,) = evaluate("Scalar-v0", filters=["scbf:belief=0.1"], **given).rows
    assert row.estimation.bound_word == word
