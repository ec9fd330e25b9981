"""Policies from outside the project: functions, classes, objects, files and entry points."""

from __future__ import annotations

import threading
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs import plugins as safe_envs_plugins
from safe_envs.agents import ZeroController, evaluate, make_policy
from safe_envs.agents.policies.names import absolute_policy, policy_file
from safe_envs.registry import make_problem

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
    assert policy_file("mine.py:Gain") == file.relative_to(file.parent)
    assert policy_file("package.module:Gain") is None
    assert absolute_policy("mine.py:Gain") == f"{file}:Gain"
    assert absolute_policy("nominal") == "nominal"


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
        (3, ConfigurationError, "a int is no policy; give an object with predict"),
        (lambda x: x, InvalidInputError, r"returned actions of shape \(6, 4\) for 6"),
        (lambda x: x[:, :1] * np.nan, InvalidInputError, "not finite"),
        ("mine.py:Wordless", InvalidInputError, r"Wordless failed .* \(ValueError: .* returns the"),
        ("mine.py:Deaf", InvalidInputError, r"Deaf failed .* \(TypeError: .* returns the actions"),
        (lambda x: x[:, 9], InvalidInputError, r"failed on observations of shape \(6, 4\)"),
        (dict, ConfigurationError, "dict cannot be made with the problem"),
        ("mine.py:number", ConfigurationError, "a int is no policy"),
        ("mine.py:Needy", ConfigurationError, "Needy cannot be made with the problem"),
        ("mine.py:Gian", ConfigurationError, "has no 'Gian'"),
        ("other.py:Gain", ConfigurationError, "there is no file other.py"),
        ("nomnal", ConfigurationError, "unknown policy 'nomnal'; did you mean 'nominal'"),
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
