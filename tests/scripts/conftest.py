from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest

from safe_envs.scripts import cli
from tests.proofs.verified import hurry


def words_of(*arguments):
    """The words of a command line, of which an argument may have several, as in a shell."""
    return [word for argument in arguments for word in shlex.split(str(argument))]


@pytest.fixture
def safe_envs_command(monkeypatch, capsys, tmp_path):
    """Runs the command in this process, in an empty folder; returns its exit status and what it
    printed."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["safe-envs", *words_of(*arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return ended.value.code or 0, printed.out, printed.err

    return run


def strictly(path):
    """A file's strict JSON: no NaN, no infinity, and keys that can be typed."""

    def refuse(name):
        raise ValueError(f"{name} is not JSON")

    def typed(pairs):
        wrong = [key for key, _ in pairs if not key.isprintable() or set(key) & set("\u00a0\u00ad")]
        assert not wrong, wrong
        return dict(pairs)

    return json.loads(Path(path).read_text(), parse_constant=refuse, object_pairs_hook=typed)


@pytest.fixture
def coarse_bounds(monkeypatch):
    """Estimate bounds by a shorter search, where a test does not depend on their size."""
    hurry(monkeypatch)
