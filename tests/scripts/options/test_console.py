"""How errors end a command, how much is printed; every way to start a command is the same."""

from __future__ import annotations

import json
import os
import runpy
import signal
import sys
from pathlib import Path

import pytest
import typer
from gymnasium.error import DependencyNotInstalled
from rich.text import Text

from safe_envs.errors import ConfigurationError
from safe_envs.scripts import cli
from safe_envs.scripts.options import console
from safe_envs.scripts.options.console import run
from tests.proofs.verified import verify_once

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
SCRIPTS = {"list": "listing.py"}
QUICK = "evaluate Scalar-v0 --no-bounds --filter none --filter scbf --episodes 8 --horizon 0.2"


def failing(error):
    def command():
        raise error

    return command


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 7.28 TiB for an array with shape [1000000000000]"),
        ValueError("Maximum allowed dimension exceeded"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
    ],
)
def test_sizes_beyond_the_memory_end_with_status_2(capsys, error):
    with pytest.raises(SystemExit) as ended:
        run(failing(error))
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert printed.startswith("Error: not enough memory")
    assert (str(error) or "MemoryError") in printed
    assert "choose smaller settings" in printed


@pytest.mark.parametrize(
    "error", [ValueError("a fault of the program"), RuntimeError("another"), KeyError("x")]
)
def test_faults_of_the_program_are_not_hidden(error):
    with pytest.raises(type(error)):
        run(failing(error))


def test_control_characters_in_an_error_are_written_out_in_one_line(capsys):
    with pytest.raises(SystemExit):
        run(failing(ConfigurationError("a\x1b[31mb\nc\u202ed.json cannot be read\n")))
    assert capsys.readouterr().err == "Error: a\\x1b[31mb\\nc\\u202ed.json cannot be read\n"


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("kind", [str, Text])
def test_control_characters_in_what_is_said_are_written_out(capsys, kind, wrap):
    console.say(console.stdout(), kind("of a\x1b[31mb\u202ec\nand more"), wrap)
    assert capsys.readouterr().out == "of a\\x1b[31mb\\u202ec\nand more\n"


def test_a_request_to_terminate_is_like_ctrl_c():
    with pytest.raises(KeyboardInterrupt):
        run(lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_command_whose_output_is_closed_ends_well(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert run(lambda: sys.stdout.write("nowhere")) == len("nowhere")


def test_errors_of_gymnasium_are_of_the_users_making(capsys):
    with pytest.raises(SystemExit) as ended:
        run(failing(DependencyNotInstalled("install it")))
    assert ended.value.code == 2
    assert capsys.readouterr().err == "Error: install it\n"


def test_quiet_prints_the_table_only(safe_envs_command):
    whole = safe_envs_command(QUICK, "--json whole.json")[1].splitlines()
    status, out, err = safe_envs_command("--quiet", QUICK, "--json quiet.json")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert [line.split()[0] for line in lines[-2:]] == ["none", "scbf"]
    assert any(line.startswith("noise") for line in whole)
    assert not any(line.startswith(("noise", "Note", "safe_envs")) for line in lines)
    assert set(lines) <= set(whole)
    documents = [json.loads(Path(name).read_text()) for name in ("whole.json", "quiet.json")]
    assert documents[0]["rows"] == documents[1]["rows"]
    # The next command is not quiet any more.
    assert len(safe_envs_command(QUICK)[1].splitlines()) == len(whole)


def test_quiet_has_no_progress_bar(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with console.quietly(True), console.progress_bar("x") as tell:
        assert tell is None
    with console.progress_bar("x") as tell:
        assert tell is not None


def test_errors_are_not_quiet(safe_envs_command):
    status, out, err = safe_envs_command("evaluate Nothing-v0 --quiet")
    assert (status, out) == (2, "")
    assert "unknown env 'Nothing-v0'" in err


@pytest.mark.parametrize("arguments", [QUICK, "list", "verify Scalar-v0 --no-simulate"])
def test_json_goes_to_stdout_by_itself(safe_envs_command, monkeypatch, arguments):
    monkeypatch.setattr("safe_envs.agents.evaluation.safety_chain.STARTS", 512)
    monkeypatch.setattr("safe_envs.proofs.feasibility.verify", verify_once)
    status, out, err = safe_envs_command(arguments, "--json -")
    assert (status, err) == (0, "")
    given = json.loads(out)
    assert safe_envs_command(arguments, "--json file.json")[0] == 0
    written = json.loads(Path("file.json").read_text())
    for document in (given, written):
        document.pop("timing", None)
    assert given == written
    assert not Path("-").exists()


def test_every_command_has_both_options(safe_envs_command):
    commands = typer.main.get_command(cli.app).commands  # pyright: ignore[reportAttributeAccessIssue]
    for name, command in commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert "--quiet" in options, name
        assert "--json" in options, name


@pytest.mark.parametrize("command", ["evaluate", "list", "sweep-report"])
def test_a_script_is_its_command(safe_envs_command, monkeypatch, capsys, command):
    expected = safe_envs_command(command, "--help")[1]
    path = ROOT / "scripts" / SCRIPTS.get(command, f"{command.replace('-', '_')}.py")
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out == expected
    assert f"Usage: safe-envs {command}" in expected


@pytest.mark.filterwarnings("ignore:'safe_envs.__main__' found in sys.modules")
def test_the_package_is_the_command(safe_envs_command, monkeypatch, capsys):
    expected = safe_envs_command(QUICK, "-q")[1]
    monkeypatch.setattr(sys, "argv", ["-m", *QUICK.split(), "-q"])
    with pytest.raises(SystemExit):
        runpy.run_module("safe_envs", run_name="__main__")
    without_speed = [
        line.rpartition("  ")[0].rstrip()
        for line in capsys.readouterr().out.splitlines()
        if "─" not in line
    ]
    assert without_speed == [
        line.rpartition("  ")[0].rstrip() for line in expected.splitlines() if "─" not in line
    ]
