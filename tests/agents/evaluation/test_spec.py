"""What an evaluation is asked for: as data, with objects, how it is run, and what is refused."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from safe_envs import ConfigurationError, RelativeDegreeError
from safe_envs.agents import NominalController, evaluate
from safe_envs.agents.evaluation.evaluate import refine, run_evaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.registry import make_problem
from safe_envs.wrappers import CBF, HOCBF, FilterSpec, spec_of
from tests.oracles.carts import cart_problem

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
PENDULUM = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"


def test_a_spec_is_json_and_back():
    data = json.loads(json.dumps(SPEC.as_dict()))
    again = EvaluationSpec.from_dict(data)
    assert again.as_dict() == SPEC.as_dict()
    assert again.filters == ("none", spec_of(SPEC.filters[1]))
    assert (again.options, again.learned) == ({"horizon": 0.2}, ("model.npz",))
    assert set(data) == {field.name for field in fields(EvaluationSpec)} - {"trust"}
    names = ("none", "promise:p=0.9:robust=v:1.0..2.0:leaving=safe", "backup:horizon=3")
    promised = replace(SPEC, filters=names)
    assert EvaluationSpec.from_dict(json.loads(json.dumps(promised.as_dict()))).filters == names


def test_data_cannot_grant_itself_the_right_to_run_code():
    assert not EvaluationSpec.from_dict(replace(SPEC, trust=True).as_dict()).trust
    assert EvaluationSpec.from_dict(SPEC.as_dict(), trust=True).trust
    with pytest.raises(ConfigurationError, match="trust"):
        EvaluationSpec.from_dict({**SPEC.as_dict(), "trust": True})


def test_numbers_of_numpy_and_paths_are_those_of_python():
    given = {"episodes": np.int64(3), "seed": np.int32(4), "confidence": np.float64(0.9)}
    options = {"noise": np.float64(0.1), "start": np.array([0.5]), "input_bounds": (-1, 1)}
    spec = EvaluationSpec("Scalar-v0", Path("run"), options=options, learned="m.npz", **given)
    assert (spec.policy, spec.learned) == ("run", ("m.npz",))
    data = json.loads(json.dumps(spec.as_dict()))
    assert data["options"] == {"noise": 0.1, "start": [0.5], "input_bounds": [-1, 1]}
    assert EvaluationSpec.from_dict(data).as_dict() == spec.as_dict() == data


def test_a_spec_runs_like_its_arguments_however_it_is_run():
    spec = replace(SPEC, learned=(), filters=("none", "scbf"), bounds=False)
    found = run_evaluation(spec, RunSettings(num_envs=2))
    again = run_evaluation(EvaluationSpec.from_dict(spec.as_dict()))
    assert found.rows == again.rows
    assert found.spec == spec


DUBINS, TWO = "StochasticDubins-v0", HOCBF(alpha=(1.0, 1.0))
MEASURED = {"problem": "Pendulum-v0", "options": {"measurement": "default"}, "estimator": "ekf"}
EXTERNAL = {"problem": "Pendulum-v1", "filter_spec": PENDULUM}


@pytest.mark.parametrize(
    ("given", "fragment"),
    [
        ({"episodes": 0}, "episodes = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"knowledge": "plan"}, "'plant'"),
        ({"monitoring": "continous"}, "'continuous'"),
        ({"confidence": 1.0}, "confidence = 1.0"),
        ({"policy": "nominl"}, "'nominal'"),
        ({"options": {"nois": 1}}, "'noise'"),
        ({"keep_episodes": "no"}, "keep_episodes = 'no'"),
        ({"episodes_out": "nowhere/out.parquet"}, "nowhere"),
        ({"episodes_out": "out.csv"}, "out.csv"),
        ({"jobs": 2, "record": True}, "trajectories"),
        ({"bounds": "false"}, "bounds = 'false'"),
        ({"best": True, "monitoring": "continuous"}, "monitoring = 'continuous'"),
        ({"problem": "Quadrotor-v0", "best": True}, "12 coordinates"),
        ({"closed_loop": True, "bounds": False}, "closed_loop = "),
        ({"closed_loop": True, "monitoring": "continuous"}, "closed_loop = "),
        ({"problem": "Quadrotor-v0", "closed_loop": True}, "4 inputs"),
        ({"problem": make_problem("Scalar-v0"), "options": {"noise": 1.0}}, "options"),
        # Filters.
        ({"filters": ["scb"]}, "'scbf'"),
        ({"filters": []}, "no filter"),
        ({"filters": [CBF]}, "filters hold"),
        ({"filters": [(TWO,) * 3]}, "3 conditions"),
        ({"problem": "ACC-v0", "filters": ["promise:p=0.9"], "objective": "clf"}, "nearest"),
        ({"problem": cart_problem(), "filters": ["backup"], "objective": "clf"}, "nearest"),
        # Sensors.
        ({"filters": ["scbf@state"]}, "without an estimator"),
        ({**MEASURED, "estimator": "ekff"}, "'ekf'"),
        ({**MEASURED, "belief": 0.0}, "belief"),
        ({**MEASURED, "observe": "all"}, "observe"),
        ({**MEASURED, "options": {}}, "nothing to estimate"),
        ({**MEASURED, "estimator": None, "filters": ["scbf"]}, "estimator"),
        ({**MEASURED, "estimator": None, "observe": "measurement"}, "estimator"),
        # Envs of others.
        ({**EXTERNAL, "filters": ["bayesian-scbf"]}, "log"),
        ({**EXTERNAL, "policy": "clf"}, "Lyapunov"),
        ({**EXTERNAL, "engine": "compiled"}, "third-party"),
        ({**EXTERNAL, "knowledge": "plant"}, "the model"),
        ({**EXTERNAL, "options": {"noise": 0.1}}, "noise"),
        ({**EXTERNAL, "monitoring": "continuous"}, "unknown"),
        ({**EXTERNAL, "problem": "safe_envs/Pendulum-v0"}, "barriers of its own"),
        ({**EXTERNAL, "filter_spec": "nowhere.py:spec"}, "nowhere.py"),
        ({**EXTERNAL, "filter_spec": PENDULUM.replace(":spec", ":pendulum")}, "FilterSpec"),
    ],
)
def test_what_cannot_be_is_refused_and_named(given, fragment):
    given = {"problem": DUBINS, "episodes": 2, "bounds": given.get("closed_loop") is True, **given}
    with pytest.raises(ConfigurationError, match=fragment):
        evaluate(**given)


@pytest.mark.parametrize(
    ("data", "fragment"),
    [
        ({}, "problem"),
        ({"problem": "Scalar-v0", "episode": 3}, "'episodes'"),
        ({"problem": "Scalar-v0", "episodes": 0}, "episodes = 0"),
        ({"problem": "Scalar-v0", "filters": 3}, "filters = 3"),
        ({"problem": "Scalar-v0", "options": [1]}, "dictionary"),
    ],
)
def test_data_that_is_no_spec_is_refused(data, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        EvaluationSpec.from_dict(data)


def test_objects_without_text_are_no_json():
    problem = make_problem("Scalar-v0")
    for name, value in (("problem", problem), ("policy", NominalController(problem))):
        with pytest.raises(ConfigurationError, match=name):
            replace(SPEC, **{name: value}).as_dict()
    assert isinstance(FilterSpec.load(PENDULUM), FilterSpec)


def test_errors_come_before_any_episode():
    told = []
    with pytest.raises(RelativeDegreeError, match="hocbf"):
        evaluate(DUBINS, filters=["none", "cbf"], progress=told.append)
    assert told == []
    tiny = {"options": {"dt": 5e-324, "horizon": 5e-324}}
    for given in ({"episodes": 0}, {"confidence": 2}, {"filters": ["scb"]}, tiny):
        with pytest.raises(ConfigurationError):
            refine("Scalar-v0", **given)
