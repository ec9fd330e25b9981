"""Mistakes that are often made: one line, and nothing heavy is imported to say it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from safe_envs.scripts.reports import command_times
from safe_envs.scripts.reports.command_times import MISTAKES

ALL_IN_ONE_PROCESS = f"""
import sys
from contextlib import suppress

from safe_envs.scripts import cli

HEAVY = ("sympy", "scipy", "torch", "safe_envs.problem.problem", "safe_envs.agents.evaluation")
for words in (("--help",), ("--version",), ("list",), *{MISTAKES!r}):
    sys.argv = ["safe-envs", *words]
    with suppress(SystemExit):
        cli.main()
    found = [name for name in HEAVY if name in sys.modules]
    assert not found, (words, found)
"""


@pytest.mark.parametrize("words", MISTAKES, ids=" ".join)
def test_a_mistake_ends_with_status_2_and_one_line(safe_envs_command, words):
    status, out, err = safe_envs_command(*words)
    assert (status, out) == (2, "")
    assert err.startswith("Error: ")
    assert err.count("\n") == 1
    assert len(err) < 400


def test_there_are_25_different_ones():
    assert len(set(MISTAKES)) == len(MISTAKES) == 25


def test_no_mistake_needs_symbolic_algebra(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", ALL_IN_ONE_PROCESS],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Error: ") == len(MISTAKES)


def test_processor_times_of_processes_are_measured(monkeypatch):
    monkeypatch.setattr(command_times, "_ROUNDS", 1)
    monkeypatch.setattr(command_times, "MISTAKES", MISTAKES[:1])
    monkeypatch.setattr(command_times, "_WITHOUT_MISTAKE", (("--version",),))
    found = command_times.measure()
    assert set(found) == {
        "python -c 'import typer, rich', s",
        "safe-envs --version, s",
        "safe-envs evalute, s",
    }
    assert all(0 < seconds < 60 for seconds in found.values())


def test_a_command_that_fails_otherwise_has_no_time(monkeypatch):
    # Where the package is not found, every command would seem to be quick.
    monkeypatch.setattr(command_times, "_ROUNDS", 1)
    monkeypatch.setattr(command_times, "_WITHOUT_MISTAKE", (("no-such-command",),))
    with pytest.raises(RuntimeError, match="ended with 2"):
        command_times.measure()
