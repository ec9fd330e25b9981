"""The text of the backup filter."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError
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
    ("call", "fragment"),
    [
        *(
            (lambda text=text: settings_of(text), fragment)
            for text, fragment in (
                ("backup:horizont=2", "'horizont'"),
                ("backup:horizon", "horizon no value"),
                ("backup:horizon=2:horizon=3", "twice"),
                ("backup:horizon=-1", "-1"),
                ("backup:horizon=nan", "horizon"),
                ("backup:horizon=x", "horizon"),
                ("backup:margin=-1", "margin = -1"),
                ("backup+scbf", "alone"),
                ("backup:horizon=2+hocbf:alpha=2,8", "alone"),
            )
        ),
        (lambda: parse_conditions("backup", cart_problem()), "backup"),
        (
            lambda: parse_conditions("hocbf+backup", cart_problem(barriers=_two_barriers())),
            "backup",
        ),
        (
            lambda: BackupSettings().require_fit(problem_of("safe_envs/Scalar-v0")),
            "Scalar.*BackupLaw",
        ),
        (lambda: BackupSettings().require_fit(cart_problem(), "clf"), "nearest"),
        (lambda: BackupSettings(horizon=1001.0).require_fit(cart_problem()), "10000 control"),
    ],
)
def test_what_is_no_backup_filter_of_the_problem_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


def _two_barriers():
    return cart_problem().barriers * 2
