"""The text of the promise filter, and where it is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs import ConfigurationError
from safe_envs.filters.conditions.names import PROMISE, condition_names
from safe_envs.filters.conditions.text import (
    files_of,
    learned_parts,
    require_known,
    with_absolute_paths,
)
from safe_envs.scripts.options import completion
from safe_envs.scripts.render import split_filters
from safe_envs.values.promise_filter import PromiseSettings
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.conftest import problem_of

WHOLE = "promise:p=0.9:robust=v:0.8..2.4;w:-1.0..-0.5:leaving=safe:table=/a/b+c.npz"


@pytest.mark.parametrize("text", ["promise:p=0.99", WHOLE, "promise:p=0.5:table=a,b.npz"])
def test_the_text_of_settings_makes_them_again(text):
    settings = PromiseSettings.of_text(text)
    assert settings.text == text
    assert PromiseSettings.of_text(settings.text) == settings


def test_settings_hold_what_was_written():
    settings = PromiseSettings.of_text(" promise:leaving=safe:robust= v :1..3:p=.25 ")
    assert settings == PromiseSettings(0.25, (("v", 1.0, 3.0),), "safe")
    assert settings.intervals == {"v": (1.0, 3.0)}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("promise", "names no probability; give one, like promise:p=0.99"),
        ("promise:p", "gives p no value; settings are key=value, as in promise:p=0.99"),
        ("promise:q=3:p=.9", "no setting 'q'; allowed: p, robust, leaving, spec, table"),
        ("promise:robst=v:1..2:p=.9", "did you mean 'robust'"),
        ("promise:0.99", "no setting '0.99'"),
        ("promise:p=0", "p = 0 of the promise filter; give a probability.*between 0 and 1"),
        ("promise:p=1", "p = 1 of the promise filter"),
        ("promise:p=-.1", "p = -0.1"),
        ("promise:p=nan", "not finite"),
        ("promise:p=high", "'high' is not a number"),
        ("promise:p=.9:p=.8", "names 'p' twice"),
        ("promise:p=.9:leaving=later", "leaving = 'later'.*allowed: violation, safe"),
        ("promise:p=.9:robust=v", "give a parameter and two numbers, like v:0.8..2.4"),
        ("promise:p=.9:robust=v:2..1", "v:2..1.*the lower one first"),
        ("promise:p=.9:robust=v:1..inf", "two finite numbers"),
        ("promise:p=.9:robust=v:1..2;v:3..4", "names v twice"),
        ("promise:p=.9:table=", "table names no file"),
        ("promise:p=.9+scbf", r'alone.*without "\+"'),
        ("promise+promise:p=.9", r'alone.*without "\+"'),
    ],
)
def test_what_cannot_be_read_is_explained(text, says):
    with pytest.raises(ConfigurationError, match=f"(?s){says}"):
        PromiseSettings.of_text(text)


def test_a_parameter_that_the_model_does_not_have_is_refused():
    problem = problem_of("safe_envs/DubinsDisk-v0")
    PromiseSettings(0.9, (("v", 0.8, 2.4),)).require_fit(problem)
    with pytest.raises(ConfigurationError, match=r"DubinsDisk has no parameter 'speed'"):
        PromiseSettings(0.9, (("speed", 0.8, 2.4),)).require_fit(problem)


def test_the_name_is_known_where_filters_are_listed_and_is_no_condition():
    require_known("promise:p=0.99", "none")
    with pytest.raises(ConfigurationError, match="did you mean 'promise'"):
        require_known("promis:p=0.99", "none")
    assert PROMISE not in condition_names()
    assert completion.filters("prom") == [PROMISE]
    assert split_filters("none,promise:p=0.9,scbf") == ["none", "promise:p=0.9", "scbf"]
    problem = problem_of("safe_envs/Scalar-v0")
    for make in (parse_conditions, lambda text, given: SafetyFilter.for_problem(given, text)):
        with pytest.raises(ConfigurationError, match="promise is no condition but a filter by"):
            make("promise:p=0.9", problem)
    with pytest.raises(ConfigurationError, match="promise is no condition"):
        parse_conditions("scbf+promise:p=0.9+scbf", problem_of("safe_envs/QuadrotorLimits-v0"))


def test_its_table_is_a_file_that_a_sweep_reads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert files_of(WHOLE) == (Path("/a/b+c.npz"),)
    assert files_of("promise:p=0.9") == ()
    text = "promise:p=0.9:robust=v:1.0..2.0:table=gap.npz"
    there = with_absolute_paths(text)
    assert there == f"promise:p=0.9:robust=v:1.0..2.0:table={(tmp_path / 'gap.npz').resolve()}"
    assert learned_parts(text) == []
