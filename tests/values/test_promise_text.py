"""The text of the promise filter, and where it is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs import ConfigurationError
from safe_envs.filters.conditions.names import PROMISE, condition_names
from safe_envs.filters.conditions.syntax import (
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

REACH = "always safe & eventually goal"


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("promise:p=0.99", PromiseSettings(0.99)),
        ("promise:p=0.5:table=a,b.npz", PromiseSettings(0.5, table="a,b.npz")),
        (
            "promise:p=0.9:robust=v:0.8..2.4;w:-1.0..-0.5:leaving=safe:table=/a/b+c.npz",
            PromiseSettings(0.9, (("v", 0.8, 2.4), ("w", -1.0, -0.5)), "safe", table="/a/b+c.npz"),
        ),
        (f"promise:p=0.9:spec={REACH}", PromiseSettings(0.9, specification=REACH)),
        (
            "promise:p=0.5:leaving=safe:spec=!(A | B) until C then D:table=/a/b,c.npz",
            PromiseSettings(0.5, (), "safe", "/a/b,c.npz", "!(A | B) until C then D"),
        ),
        (
            "promise:p=0.9:robust=v:1.0..2.0:spec=not A and (B or eventually[1,2] C)",
            PromiseSettings(
                0.9, (("v", 1.0, 2.0),), specification="not A and (B or eventually[1,2] C)"
            ),
        ),
    ],
)
def test_the_text_of_settings_makes_them_again(text, settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert PromiseSettings.of_text(text) == settings
    assert settings.text == text
    assert split_filters(f"none,{text},scbf") == ["none", text, "scbf"]
    # A sweep reads the table, wherever it runs.
    files = [Path(settings.table)] if settings.table else []
    assert list(files_of(text)) == files
    assert list(files_of(with_absolute_paths(text))) == [tmp_path / file for file in files]
    assert learned_parts(text) == []


def test_spaces_do_not_count():
    settings = PromiseSettings.of_text(" promise:leaving=safe:robust= v :1..3:p=.25 ")
    assert settings == PromiseSettings(0.25, (("v", 1.0, 3.0),), "safe")
    assert settings.intervals == {"v": (1.0, 3.0)}
    settings = PromiseSettings.of_text("promise:spec= always  safe&eventually goal :p=.9")
    assert settings.text == "promise:p=0.9:spec=always safe&eventually goal"


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("promise", "probability"),
        ("promise:p", "p no value"),
        ("promise:q=3:p=.9", "'q'.*robust"),
        ("promise:robst=v:1..2:p=.9", "'robust'"),
        ("promise:spc=always safe:p=.9", "'spec'"),
        ("promise:0.99", "'0.99'"),
        ("promise:p=0", "p = 0 "),
        ("promise:p=1", "p = 1 "),
        ("promise:p=-.1", "p = -0.1"),
        ("promise:p=nan", "not finite"),
        ("promise:p=high", "'high'"),
        ("promise:p=.9:p=.8", "'p' twice"),
        ("promise:p=.9:leaving=later", "'later'.*violation, safe"),
        ("promise:p=.9:robust=v", "'v'"),
        ("promise:p=.9:robust=v:2..1", "v:2..1"),
        ("promise:p=.9:robust=v:1..inf", "finite"),
        ("promise:p=.9:robust=v:1..2;v:3..4", "v twice"),
        ("promise:p=.9:table=", "table"),
        ("promise:p=.9:spec=", "spec has no"),
        ("promise:p=.9:spec= ", "spec has no"),
        ("promise:p=.9:spec=always safe:spec=always safe", "'spec' twice"),
        ("promise:p=.9+scbf", "alone"),
        ("promise+promise:p=.9", "alone"),
    ],
)
def test_what_cannot_be_read_is_refused(text, fragment):
    with pytest.raises(ConfigurationError, match=f"(?s){fragment}"):
        PromiseSettings.of_text(text)


def test_settings_that_are_none_are_refused():
    with pytest.raises(ConfigurationError, match="specification = 3"):
        PromiseSettings(0.9, specification=3)  # pyright: ignore[reportArgumentType]
    problem = problem_of("safe_envs/Scalar-v0")
    with pytest.raises(ConfigurationError, match="'speed'"):
        PromiseSettings(0.9, (("speed", 0.8, 2.4),)).require_fit(problem)


def test_the_name_is_known_where_filters_are_listed_and_is_no_condition():
    require_known("promise:p=0.99", "none")
    with pytest.raises(ConfigurationError, match="'promise'"):
        require_known("promis:p=0.99", "none")
    assert PROMISE not in condition_names()
    assert completion.filters("prom") == [PROMISE]
    problem = problem_of("safe_envs/Scalar-v0")
    for make in (parse_conditions, lambda text, given: SafetyFilter.for_problem(given, text)):
        for text in ("promise:p=0.9", "scbf+promise:p=0.9"):
            with pytest.raises(ConfigurationError, match="promise"):
                make(text, problem)
