"""Policies from outside the project: functions, classes, objects, files and entry points."""

from __future__ import annotations

import threading
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs import plugins as safe_envs_plugins
from safe_envs.agents import ZeroController, evaluate, make_policy
from safe_envs.registry import make_problem
from tests.conftest import problem_of

SHORT = {"episodes": 6, "bounds": False, "options": {"horizon": 0.2}}
FILE = """
import numpy as np

class Gain:
    def __init__(self, problem):
        self.m = len(problem.inputs)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.tanh(-observation[:, :self.m].astype(np.float64)), state

class Plain:
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.tanh(-observation[:, :1].astype(np.float64)), state

class Weighted(Plain):
    def __init__(self, gain=1.0, **settings):
        self.gain = float(gain)

class Named(Plain):
    def __init__(self, gain=1.0, *, problem):
        assert problem.name == "Scalar" and gain == 1.0

class Called:
    def __call__(self, observation):
        return np.tanh(-observation[:, :1])

def function(observation):
    return np.tanh(-observation[:, :1])

def factory(problem):
    return Gain(problem)

def maker():
    return Plain()

number = 3

class Needy:
    def __init__(self, problem, more):
        pass

class Wordless(Gain):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return -observation[:, :self.m]

class Deaf(Gain):
    def predict(self, observation):
        return -observation[:, :self.m], None
"""


def function(observation):
    return np.tanh(-observation[:, :1])


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(FILE)
    return tmp_path / "mine.py"


def rows(policy, **changes):
    found = evaluate("Scalar-v0", policy, **{**SHORT, **changes})
    return [{**row.as_dict(), "policy": ""} for row in found.rows]


def test_a_policy_may_be_a_function_a_class_or_an_object(file):
    wanted = rows(function)
    assert wanted != rows("zero")
    names = ("Gain", "Plain", "Weighted", "Named", "Called", "function", "factory", "maker")
    places = [f"mine.py:{name}" for name in names]
    for policy in (lambda x: np.tanh(-x[:, 0]), *places, make_policy(places[0], problem())):
        assert rows(policy) == wanted
    assert rows(ZeroController) == rows("zero")


def problem():
    return make_problem("Scalar-v0", **SHORT["options"])


def test_the_configuration_names_the_policy_and_its_file(file):
    def named(policy):
        return evaluate("Scalar-v0", policy, **SHORT).config["policy"]

    assert named(function) == {"name": "function"}
    assert named(lambda x: x[:, :1]) == {"name": "lambda"}
    found = named("mine.py:Gain")
    assert found["name"] == "mine.py:Gain"
    assert len(found["sha256"]) == 64


@pytest.mark.slow
def test_functions_go_to_other_processes(file):
    wanted = rows(function)
    for policy in (function, lambda x: np.tanh(-x[:, :1]), "mine.py:Gain"):
        assert rows(policy, jobs=2) == wanted
    lock = threading.Lock()
    with pytest.raises(ConfigurationError, match="cannot be sent to another process"):
        rows(lambda x: x[:, :1] if lock else x, jobs=2)


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (3, ConfigurationError, "int"),
        (lambda x: x, InvalidInputError, r"shape \(6, 4\)"),
        (lambda x: x[:, :1] * np.nan, InvalidInputError, "not finite"),
        ("mine.py:Wordless", InvalidInputError, "Wordless .*ValueError"),
        ("mine.py:Deaf", InvalidInputError, "Deaf .*TypeError"),
        (lambda x: x[:, 9], InvalidInputError, r"shape \(6, 4\)"),
        (dict, ConfigurationError, "dict"),
        ("mine.py:number", ConfigurationError, "int"),
        ("mine.py:Needy", ConfigurationError, "Needy"),
        ("mine.py:Gian", ConfigurationError, "'Gian'"),
        ("other.py:Gain", ConfigurationError, r"other\.py"),
        ("nomnal", ConfigurationError, "'nominal'"),
    ],
)
def test_what_is_no_policy_is_refused(policy, error, message, file):
    with pytest.raises(error, match=message):
        evaluate("StochasticDubins-v0", policy, filters=["none"], **SHORT)


def test_installed_packages_declare_policies(monkeypatch):
    point = EntryPoint("careful", f"{__name__}:function", safe_envs_plugins.POLICIES)
    found = EntryPoints([point])
    monkeypatch.setattr(safe_envs_plugins, "declared", lambda group: found.select(group=group))
    assert rows("careful") == rows(function)
    with pytest.raises(ConfigurationError, match="did you mean 'careful'"):
        make_policy("carefull", problem())


PENDULUM, ACC = "safe_envs/Pendulum-v0", "safe_envs/ACC-v0"


@pytest.mark.parametrize(
    ("env_id", "name"), [(PENDULUM, "nominal"), (ACC, "clf"), ("safe_envs/Scalar-v0", "best")]
)
def test_policies_of_the_full_state_refuse_a_measurement(env_id, name):
    # The number of channels is that of the features: nobody would notice.
    problem = problem_of(env_id, measurement="default")
    assert len(problem.measurement.channels) == len(problem.features)
    with pytest.raises(ConfigurationError, match="measured"):
        make_policy(name, problem)
    make_policy(name, problem.unmeasured)


def test_other_policies_take_any_sensor_and_functions_see_what_it_shows():
    problem = problem_of(PENDULUM, measurement=["default", "x=theta:noise=1"])
    for name in ("zero", "random"):
        policy = make_policy(name, problem)
        policy.begin(range(2), 0)
        assert policy.predict(np.zeros((2, 3)))[0].shape == (2, 1)
    problem = problem_of(PENDULUM, measurement=["theta:noise=1"])
    policy = make_policy(lambda observation: -observation, problem)
    assert policy.predict(np.array([0.5]))[0].tolist() == [-0.5]
