"""The text of the backup filter."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.backup_filter import BackupSettings
from safe_envs.values.promise_filter import PromiseSettings
from safe_envs.wrappers import parse_conditions
from safe_envs.wrappers.filter_layers import settings_of
from tests.conftest import problem_of
from tests.oracles.carts import cart_problem


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("backup", BackupSettings()),
        ("backup:horizon=2", BackupSettings(2.0)),
        ("backup:margin=0.1", BackupSettings(margin=0.1)),
        ("backup:horizon=2.5:margin=1e-3", BackupSettings(2.5, 0.001)),
    ],
)
def test_text_and_settings_are_the_same(text, settings):
    assert BackupSettings.of_text(text) == settings == settings_of(text)
    assert BackupSettings.of_text(settings.text) == settings


def test_the_text_says_which_filter_is_meant():
    assert isinstance(settings_of("promise:p=0.9"), PromiseSettings)
    assert settings_of("scbf") is None
    assert settings_of("backups") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("backup:horizont=2", "no setting 'horizont'.*horizon"),
        ("backup:horizon", "gives horizon no value"),
        ("backup:horizon=2:horizon=3", "twice"),
        ("backup:horizon=-1", "positive time"),
        ("backup:horizon=nan", "horizon"),
        ("backup:horizon=x", "horizon"),
        ("backup:margin=-1", "number >= 0"),
        ("backup+scbf", "acts alone"),
        ("backup:horizon=2+hocbf:p=2,8", "acts alone"),
    ],
)
def test_what_is_no_such_text_is_refused(text, words):
    with pytest.raises(ConfigurationError, match=words):
        settings_of(text)


def test_as_a_condition_it_is_refused():
    with pytest.raises(ConfigurationError, match="backup is no condition but a filter by itself"):
        parse_conditions("backup", cart_problem())
    with pytest.raises(ConfigurationError, match="backup is no condition"):
        parse_conditions("hocbf+backup", cart_problem(barriers=cart_problem().barriers * 2))


def test_a_problem_without_a_backup_is_told_how_to_state_one():
    problem: SafetyProblem = problem_of("safe_envs/Scalar-v0")
    with pytest.raises(ConfigurationError, match=r"Scalar states no backup.*BackupLaw"):
        BackupSettings().require_fit(problem)


def test_it_has_no_goal_of_its_own():
    with pytest.raises(ConfigurationError, match="the backup filter takes the input nearest"):
        BackupSettings().require_fit(cart_problem(), "clf")


def test_plans_of_too_many_periods_are_refused():
    with pytest.raises(ConfigurationError, match="10000 control periods"):
        BackupSettings(horizon=1001.0).require_fit(cart_problem())
