"""The `safe-envs` command: what it names, usage errors, and processes that run it."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

import safe_envs
from tests.scripts.conftest import strictly

ROOT = Path(__file__).parents[2]
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")


def without_speed(text):
    """A printed table without its last column."""
    return [line.rpartition("  ")[0].rstrip() for line in text.splitlines() if line and "─" not in line]


def test_list_shows_every_id(safe_envs_command):
    status, out, err = safe_envs_command("list")
    assert (status, err) == (0, "")
    for env_id in safe_envs.ENV_IDS:
        assert env_id in out


def test_help_names_the_commands(safe_envs_command):
    status, out, _ = safe_envs_command("--help")
    assert status == 0
    for command in ("list", "evaluate", "verify", "demo", "benchmark"):
        assert command in out
    for command in ("evaluate", "verify", "demo", "benchmark"):
        assert safe_envs_command(command, "--help")[0] == 0


@pytest.mark.parametrize(
    "arguments", [["evalute"], ["evaluate"], ["evaluate", DUBINS, "--episodes", "many"], ["evaluate", DUBINS, "--nois", "1"]]
)
def test_usage_errors_end_with_status_2_too(safe_envs_command, arguments):
    status, out, err = safe_envs_command(*arguments)
    assert status == 2
    assert out == ""
    assert "Error" in err
    assert "Traceback" not in err


@pytest.mark.parametrize("command", ["benchmark", "demo"])
def test_other_commands_check_their_paths_before_they_begin(safe_envs_command, command):
    Path("file").touch()
    arguments = {"benchmark": ["--json", "nowhere/out.json"], "demo": ["--folder", "file"]}[command]
    status, _, err = safe_envs_command(command, *arguments)
    assert status == 2
    assert err.startswith("Error:")
    assert arguments[1] in err


def run_process(*command, cwd=ROOT):
    return subprocess.run([*map(str, command)], capture_output=True, text=True, cwd=cwd, timeout=120)


def test_the_installed_command_and_the_script_give_the_same(tmp_path):
    arguments = ["Scalar-v0", "--filter", "none", "--filter", "cbf", *QUICK]
    commands = {
        "installed": [Path(sys.executable).with_name("safe-envs"), "evaluate"],
        "script": [sys.executable, ROOT / "scripts" / "evaluate.py"],
    }
    tables, documents = [], []
    for name, command in commands.items():
        done = run_process(*command, *arguments, "--json", tmp_path / f"{name}.json")
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        tables.append(without_speed(done.stdout))
        documents.append(strictly(tmp_path / f"{name}.json"))
        del documents[-1]["timing"]
    assert tables[0] == tables[1]
    assert len(tables[0]) > 4
    assert documents[0] == documents[1]


def test_errors_of_the_script_end_with_status_2():
    done = run_process(sys.executable, "-m", "scripts.evaluate", DUBINS, "--filter", "hocb")
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'hocbf'" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_terminal_gets_a_progress_bar():
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "scripts.evaluate", "Scalar-v0", "--filter", "none", *QUICK]
    environment = {**os.environ, "TERM": "xterm"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, cwd=ROOT, env=environment)
    os.close(slave)
    shown = b""
    while True:
        try:
            part = os.read(master, 4096)
        except OSError:
            break
        if not part:
            break
        shown += part
    out = process.communicate(timeout=60)[0]
    os.close(master)
    assert process.returncode == 0
    assert b"Evaluating" in shown
    assert b"%" in shown
    assert b"Evaluating" not in out
    assert b"none" in out


def test_the_command_starts_light():
    code = (
        "import sys, agents, scripts.cli; "
        "print([m for m in ('torch', 'stable_baselines3', 'matplotlib', 'proxsuite', 'qpsolvers') if m in sys.modules])"
    )
    assert run_process(sys.executable, "-c", code).stdout == "[]\n"
