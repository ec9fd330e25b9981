"""The `safe-envs` command: what it names, usage errors, and processes that run it."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import safe_envs
from safe_envs.scripts import cli
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")


def without_speed(text):
    """A printed table without its last column."""
    return [
        line.rpartition("  ")[0].rstrip() for line in text.splitlines() if line and "─" not in line
    ]


def test_list_shows_every_id(safe_envs_command):
    status, out, err = safe_envs_command("list")
    assert (status, err) == (0, "")
    for env_id in safe_envs.ENV_IDS:
        assert env_id in out


@pytest.mark.parametrize("command", cli.MOVED)
@pytest.mark.parametrize("more", [(), ("--help",), ("all", "--quick")])
def test_a_command_that_has_moved_says_where_to(safe_envs_command, command, more):
    status, out, err = safe_envs_command(command, *more)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert cli.MOVED[command] in err
    assert f"\n  {command} " not in safe_envs_command("--help")[1]


def run_at_a_terminal(*command):
    """Run a process whose standard error is a terminal; return its status, its output and what the
    terminal shows."""
    master, slave = pty.openpty()
    environment = {**os.environ, "TERM": "xterm"}
    process = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=slave, text=True, env=environment
    )
    os.close(slave)
    shown = b""
    with suppress(OSError):  # the terminal ends with the process
        while part := os.read(master, 4096):
            shown += part
    out = process.communicate(timeout=60)[0]
    os.close(master)
    return process.returncode, out, shown.decode()


@pytest.mark.slow
def test_the_script_gives_the_same_as_the_command_and_a_terminal_gets_a_progress_bar(
    safe_envs_command, tmp_path
):
    arguments = ["Scalar-v0", "--filter", "none", "--filter", "cbf", *QUICK, "--json"]
    status, out, shown = run_at_a_terminal(
        sys.executable, ROOT / "scripts" / "evaluate.py", *arguments, tmp_path / "script.json"
    )
    assert status == 0, shown
    assert "Evaluating" in shown
    assert "%" in shown
    assert "Evaluating" not in out
    table = without_speed(out)
    assert len(table) > 4
    status, out, err = safe_envs_command("evaluate", *arguments, tmp_path / "command.json")
    assert (status, err) == (0, "")
    assert without_speed(out) == table
    documents = [strictly(tmp_path / f"{name}.json") for name in ("script", "command")]
    for document in documents:
        del document["timing"]
    assert documents[0] == documents[1]


def test_the_installed_command_is_this_one():
    (installed,) = entry_points(group="console_scripts", name="safe-envs")
    assert installed.load() is cli.main
    assert Path(sys.executable).with_name("safe-envs").exists()


INTERRUPTED = """
import builtins, os, runpy, signal, sys
imported = builtins.__import__
# Jobs in the background of a shell ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)

def interrupted(name, *others, **named):
    if name == {name!r}:
        os.kill(os.getpid(), signal.SIGINT)
    return imported(name, *others, **named)

builtins.__import__ = interrupted
sys.argv = ["safe-envs", "list"]
runpy.run_module("safe_envs", run_name="__main__")
"""


def test_ctrl_c_during_the_imports_ends_quietly():
    code = INTERRUPTED.format(name="typer.core")
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_ctrl_c_before_a_command_begins_ends_quietly(monkeypatch, capsys):
    def interrupted(app):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "run_app", interrupted)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert (ended.value.code, capsys.readouterr()) == (130, ("", ""))
