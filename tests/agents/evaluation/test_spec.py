"""What an evaluation is asked for: as data, with objects, and how it is run."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.evaluate import run_evaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.registry import make_problem
from safe_envs.wrappers import CBF, HOCBF, SCBF, spec_of

SHORT = {"episodes": 5, "bounds": False}
SPEC = EvaluationSpec(
    "Scalar-v0",
    "zero",
    ("none", CBF(alpha="2*s")),
    options={"horizon": 0.2, "noise": None},
    learned=(Path("model.npz"),),
    episodes=7,
    seed=3,
    confidence=0.9,
)


def test_a_spec_is_json_and_back():
    data = json.loads(json.dumps(SPEC.as_dict()))
    again = EvaluationSpec.from_dict(data)
    assert again.as_dict() == SPEC.as_dict()
    assert again.filters == ("none", spec_of(SPEC.filters[1]))
    assert (again.options, again.learned) == ({"horizon": 0.2}, ("model.npz",))
    assert set(data) == {field.name for field in fields(EvaluationSpec)} - {"trust"}


def test_data_cannot_grant_itself_the_right_to_run_code():
    assert not EvaluationSpec.from_dict(replace(SPEC, trust=True).as_dict()).trust
    assert EvaluationSpec.from_dict(SPEC.as_dict(), trust=True).trust
    with pytest.raises(ConfigurationError, match="has no 'trust'"):
        EvaluationSpec.from_dict({**SPEC.as_dict(), "trust": True})


def test_objects_without_text_are_no_json():
    problem = make_problem("Scalar-v0")
    for change in ({"problem": problem}, {"policy": NominalController(problem)}):
        with pytest.raises(ConfigurationError, match=f"{next(iter(change))} of the evaluation"):
            replace(SPEC, **change).as_dict()


def test_numbers_of_numpy_and_paths_are_those_of_python():
    given = {"episodes": np.int64(3), "seed": np.int32(4), "confidence": np.float64(0.9)}
    options = {"noise": np.float64(0.1), "start": np.array([0.5]), "box": (-1, 1)}
    spec = EvaluationSpec("Scalar-v0", Path("run"), options=options, learned="m.npz", **given)
    assert (spec.policy, spec.learned) == ("run", ("m.npz",))
    data = json.loads(json.dumps(spec.as_dict()))
    assert data["options"] == {"noise": 0.1, "start": [0.5], "box": [-1, 1]}
    assert EvaluationSpec.from_dict(data).as_dict() == spec.as_dict() == data
    evaluate("Scalar-v0", "zero", "none", episodes=np.int64(3), bounds=False)


@pytest.mark.parametrize("given", [None, CBF, 3])
def test_filters_that_are_neither_text_nor_condition_are_refused(given):
    with pytest.raises(ConfigurationError, match="filters hold"):
        evaluate("Scalar-v0", filters=[given], **SHORT)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "needs problem"),
        ({"problem": "Scalar-v0", "episode": 3}, "did you mean 'episodes'"),
        ({"problem": "Scalar-v0", "episodes": 0}, "episodes = 0"),
        ({"problem": "Scalar-v0", "monitoring": "never"}, "monitoring = 'never'"),
        ({"problem": "Scalar-v0", "bounds": "false"}, "bounds = 'false'; give True or False"),
        ({"problem": "Scalar-v0", "filters": 3}, "filters = 3"),
        ({"problem": "Scalar-v0", "filters": []}, "no filter"),
        ({"problem": "Scalar-v0", "options": [1]}, "give a dictionary"),
    ],
)
def test_data_that_is_no_spec_is_refused(data, message):
    with pytest.raises(ConfigurationError, match=message):
        EvaluationSpec.from_dict(data)


def test_a_spec_runs_like_its_arguments_however_it_is_run():
    spec = replace(SPEC, learned=(), filters=("none", "scbf"), bounds=False)
    found = run_evaluation(spec, RunSettings(num_envs=2))
    again = run_evaluation(EvaluationSpec.from_dict(spec.as_dict()))
    assert found.rows == again.rows
    assert found.spec == spec


def test_filters_may_be_conditions():
    problem = make_problem("StochasticDubins-v0", horizon=0.5, noise=0.4)
    two = HOCBF(p=(1.0, 2.0))
    found = evaluate(problem, filters=["none", two, (SCBF.for_gains((1.0, 1.0)),)], **SHORT)
    texts = evaluate(problem, filters=["none", spec_of(two), "scbf"], **SHORT)
    strip = [{**row.as_dict(), "filter": ""} for row in found.rows]
    assert [row.filter for row in found.rows][:2] == ["none", spec_of(two)]
    assert strip[:2] == [{**row.as_dict(), "filter": ""} for row in texts.rows][:2]
    (one,) = evaluate(problem, filters=two, **SHORT).rows
    assert one == found.rows[1]


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ([3], "int"),
        ([()], "an empty tuple"),
        ([("scbf",)], "filters hold str"),
        ([(HOCBF(p=(1.0, 1.0)),) * 3], "holds 3 conditions"),
    ],
)
def test_what_is_no_filter_is_refused(filters, message):
    with pytest.raises((ConfigurationError, TypeError), match=message):
        evaluate("StochasticDubins-v0", filters=filters, **SHORT)


def test_trajectories_are_kept_in_one_process():
    with pytest.raises(ConfigurationError, match="trajectories for pictures"):
        RunSettings(jobs=2, record=True)
