"""Evaluations at the true state, at the estimate and with its belief."""

import json

import numpy as np
import pytest

from safe_envs import SafeVectorEnv
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.notes import computed_notes
from safe_envs.agents.evaluation.resolve import why_belief_not_proved
from safe_envs.errors import ConfigurationError
from safe_envs.filters.estimation import make_estimator
from safe_envs.registry import make_problem
from safe_envs.wrappers import SCBF, SafetyFilterVectorWrapper, StateEstimatorVectorWrapper

ENV = "safe_envs/Pendulum-v0"
OPTIONS = {"measurement": "default", "horizon": 0.3}
SHORT = {"options": OPTIONS, "estimator": "ekf", "episodes": 60, "bounds": False, "best": False}


def rates(found):
    return {row.filter: row.safe for row in found.rows}


def test_each_filter_has_a_row_for_each_view():
    found = evaluate(ENV, filters=["none", "scbf"], **SHORT)
    assert [row.filter for row in found.rows] == [
        *("none@state", "none", "scbf@state", "scbf", "scbf:belief=0.05")
    ]
    for row in found.rows:
        at_state = row.filter.endswith("@state")
        assert (row.estimation is None) == at_state
        assert (getattr(row.estimation, "outside_rate", None) is None) != ("belief" in row.filter)


def test_rows_at_the_true_state_are_those_without_a_sensor():
    found = evaluate(ENV, filters=["scbf"], **SHORT)
    plain = evaluate(
        ENV, filters=["scbf"], options={"horizon": 0.3}, episodes=60, bounds=False, best=False
    )
    one, other = found.row("scbf@state"), plain.row("scbf")
    for name in ("safe", "return_mean", "effort_mean", "min_h_median"):
        assert getattr(one, name) == getattr(other, name)


def test_results_do_not_depend_on_the_batch_or_on_processes():
    one = evaluate(ENV, filters=["scbf"], num_envs=7, **SHORT)
    two = evaluate(ENV, filters=["scbf"], jobs=2, **SHORT)
    for a, b in zip(one.rows, two.rows, strict=True):
        assert a == b


def test_estimates_are_counted_as_the_envs_report_them():
    found = evaluate(ENV, filters=["scbf:belief=0.1"], **SHORT, num_envs=60)
    (row,) = found.rows
    problem = make_problem(ENV, **OPTIONS)
    env = SafetyFilterVectorWrapper(
        StateEstimatorVectorWrapper(SafeVectorEnv(problem, 60)), "scbf:belief=0.1"
    )
    from safe_envs.agents.evaluation.episodes import episode_seed
    from safe_envs.agents.policies.nominal import NominalController

    policy = NominalController(problem.unmeasured)
    seen, info = env.reset(seed=[episode_seed(0, i) for i in range(60)])
    sums = {key: info[key].sum() for key in ("nees", "nees_dof", "nis", "nis_dof")}
    outside, count, alive = info["belief_barrier"][:, 0] < 0, 60, np.ones(60, dtype=bool)
    for _ in range(problem.steps):
        seen, _, ended, cut, info = env.step(policy.predict(seen)[0])
        for key in sums:
            sums[key] += info[key][alive].sum()
        outside |= alive & (info["belief_barrier"][:, 0] < 0)
        count += alive.sum()
        alive &= ~(ended | cut)
    assert row.estimation.nees.mean == pytest.approx(sums["nees"] / count)
    assert row.estimation.nees.expected == pytest.approx(sums["nees_dof"] / count)
    assert row.estimation.nis.mean == pytest.approx(sums["nis"] / count)
    assert row.estimation.outside_rate == pytest.approx(outside.mean())
    assert row.estimation.delta == 0.1
    assert row.estimation.unsafe_at_most == pytest.approx(row.estimation.outside_high + 0.1)


def test_bounds_of_true_states_are_not_those_of_estimates():
    given = {**SHORT, "bounds": True, "options": {"measurement": "default"}}
    found = evaluate(ENV, filters=["scbf"], **given)
    assert found.row("scbf@state").continuous_bound > 0.3
    for name in ("scbf", "scbf:belief=0.05"):
        assert found.row(name).continuous_bound is None
        assert found.row(name).held_bound is None


def test_policies_may_see_the_measurement():
    seen = []

    def policy(observation):
        seen.append(observation.shape[1])
        return np.zeros((len(observation), 1))

    given = SHORT | {"options": {"measurement": "default", "horizon": 0.2}}
    evaluate("safe_envs/StochasticDubins-v0", policy, ["none"], **given)
    assert set(seen) == {4}
    seen.clear()
    evaluate("safe_envs/StochasticDubins-v0", policy, ["none"], observe="measurement", **given)
    assert set(seen) == {3}


def test_conditions_as_objects_have_views_too():
    found = evaluate(ENV, filters=[SCBF()], belief=0.2, **SHORT)
    assert [row.filter for row in found.rows] == ["scbf@state", "scbf", "scbf:belief=0.2"]


def test_a_bound_of_the_error_takes_the_place_of_the_belief():
    found = evaluate(ENV, filters=["scbf:measurement_error=0.01"], **SHORT)
    name = "scbf:measurement_error=0.01"
    assert [row.filter for row in found.rows] == [f"{name}@state", name]
    found = evaluate(ENV, filters=[SCBF(measurement_error=0.01)], **SHORT)
    assert len(found.rows) == 2


def test_named_views_are_the_only_ones():
    found = evaluate(ENV, filters=["scbf@state", "szcbf"], **SHORT)
    assert [row.filter for row in found.rows] == ["scbf@state", "szcbf"]


def test_a_filter_by_itself_has_no_belief():
    found = evaluate(
        "safe_envs/DubinsDisk-v0",
        filters=["backup"],
        **SHORT | {"options": {"measurement": "default", "horizon": 0.5}, "knowledge": "plant"},
    )
    assert [row.filter for row in found.rows] == ["backup@state", "backup"]


def test_bounds_of_promise_filters_are_noted_at_the_true_state():
    (note,) = computed_notes(["scbf@state", "promise:p=0.9@state"])
    assert "the bound of promise:p=0.9@state is computed" in note


def test_documents_and_tables_tell_of_sensors():
    found = evaluate(ENV, filters=["scbf"], **SHORT)
    document = json.loads(json.dumps(found.document()))
    assert document["config"]["estimator"] == "ekf"
    assert [c["name"] for c in document["config"]["measurement"]["channels"]] == [
        *("theta", "thetadot")
    ]
    rows = {row["filter"]: row for row in document["rows"]}
    assert "estimation" not in rows["scbf@state"]
    assert rows["scbf"]["estimation"]["nees"]["expected"] == 2.0
    for text in (str(found), found.to_markdown(), found.to_latex()):
        assert "ekf" in text


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"filters": ["scbf@state"], "estimator": None}, "without an estimator"),
        ({"estimator": "ekff"}, "did you mean 'ekf'"),
        ({"belief": 0.0}, "belief"),
        ({"observe": "all"}, "observe"),
        ({"observe": "measurement", "estimator": None}, "goes with an estimator"),
        ({"options": {}}, "nothing to estimate"),
        ({"estimator": None, "filters": ["scbf"]}, "estimator"),
    ],
)
def test_what_cannot_be_is_refused(given, words):
    with pytest.raises(ConfigurationError, match=words):
        evaluate(ENV, **SHORT | given)


@pytest.mark.parametrize(
    ("options", "start", "words"),
    [
        ({}, None, "not affine"),
        ({"measurement": ["default:bias=0.1"]}, None, "not affine"),
    ],
)
def test_why_a_bound_is_not_proved(options, start, words):
    problem = make_problem(ENV, **{"measurement": "default", **options})
    assert words in why_belief_not_proved(problem, make_estimator("ekf", problem))


def test_a_bound_is_proved_of_a_known_linear_system_alone():
    problem = make_problem("Scalar-v0", measurement="default", start="origin")
    assert why_belief_not_proved(problem, make_estimator("kf", problem)) is None
    assert why_belief_not_proved(problem, make_estimator("ekf", problem)) is None
    for changed, words in (
        ({"start": "spread"}, "start"),
        ({"measurement": ["default:bias=.1"]}, "biased"),
        ({"model": {"sigma": 0.1}}, "model is not the plant"),
    ):
        other = problem.configured(**changed)
        assert words in why_belief_not_proved(other, make_estimator("kf", other))
    assert "noise" in why_belief_not_proved(
        problem, make_estimator("kf:process_noise=0.1", problem)
    )
    assert "ukf" in why_belief_not_proved(problem, make_estimator("ukf", problem))
    assert "between" in why_belief_not_proved(problem, make_estimator("kf", problem), "continuous")
    given = {"options": {"measurement": "default", "horizon": 0.3, "start": "origin"}}
    for monitoring, word in (("discrete", "proved"), ("continuous", "designed")):
        found = evaluate(
            "Scalar-v0",
            filters=["scbf:belief=0.1"],
            **SHORT | given,
            monitoring=monitoring,
        )
        assert found.rows[0].estimation.bound_word == word
