"""What a shell offers, and that it does so quickly."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout

import pytest

from safe_envs.agents.policies import registry
from safe_envs.agents.policies.names import POLICIES
from safe_envs.filters.conditions import LEARNED, Certified, names
from safe_envs.scripts import cli
from safe_envs.wrappers import CONDITIONS

pytestmark = pytest.mark.slow


def test_the_names_that_are_known_early_are_those_of_the_classes():
    assert tuple(CONDITIONS) == names.OF_MODEL
    assert tuple(LEARNED) == names.OF_DATA
    assert Certified.name == names.CERTIFIED
    assert tuple(registry._NAMED) == POLICIES


def offered(monkeypatch, *words):
    monkeypatch.setenv("_SAFE_ENVS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join(words))
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    monkeypatch.setattr(sys, "argv", ["safe-envs"])
    with redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    return printed.getvalue().split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("safe-envs", "ver"), ["verify"]),
        (("safe-envs", "nosuch", "--se"), []),
        (("safe-envs", "evaluate", "Pen"), ["Pendulum-v0"]),
        (("safe-envs", "evaluate", "safe_envs/Quadrotor-"), ["safe_envs/Quadrotor-v0"]),
        (("safe-envs", "verify", "--filter", "sz"), ["szcbf"]),
        (("safe-envs", "train", "--filter", "sr"), ["srcbf"]),
        (("safe-envs", "evaluate", "--policy", "z"), ["zero"]),
        (("safe-envs", "train", "--algo", "t"), ["td3"]),
        (("safe-envs", "leaderboard", "ACC-"), ["ACC-v0"]),
        (("safe-envs", "identify", "--method", "b"), ["bayesian"]),
        (("safe-envs", "doctor", "--q"), ["--quiet"]),
    ],
)
def test_what_may_follow_is_offered(monkeypatch, words, expected):
    assert offered(monkeypatch, *words) == expected
