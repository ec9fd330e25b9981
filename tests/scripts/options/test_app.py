"""The help of a command, which the terminal wraps and not its docstring."""

from __future__ import annotations

import re
import shlex

import pytest
import typer

import safe_envs
from safe_envs.scripts import cli
from safe_envs.scripts.options.app import EXAMPLES, PANELS, panel_of


def commands_of(app):
    return typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]


def test_the_list_of_commands_says_what_they_say_themselves():
    found = commands_of(cli.app)
    for entry in cli.COMMANDS:
        assert found[entry.name].help.partition("\n\n")[0] == entry.about


@pytest.mark.parametrize("name", [entry.name for entry in cli.COMMANDS])
def test_every_option_is_in_a_group_and_the_help_fits_80_columns(monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "80")
    command = commands_of(cli.app)[name]
    options = [p for p in command.params if p.param_type_name == "option"]
    for option in options:
        assert panel_of(max(option.opts, key=len)), option.opts
    with command.make_context(f"safe-envs {name}", [], resilient_parsing=True) as context:
        text = re.sub(r"\x1b\[\d+m", "", command.get_help(context))
    assert max(map(len, text.splitlines())) <= 80
    assert not re.search("<(bool|str|int|float|path)>|…", text)
    for option in options:
        assert all(spelling in text for spelling in (*option.opts, *option.secondary_opts))
    titles = [line[:-1] for line in text.splitlines() if line.endswith(":") and line[0] != " "]
    assert [title for title in titles if title in PANELS] == sorted(
        (title for title in titles if title in PANELS), key=list(PANELS).index
    )
    assert titles[-1] == "Examples"


def test_no_option_is_in_two_groups_and_no_group_names_what_there_is_not():
    listed = [option for options in PANELS.values() for option in options.split()]
    assert len(listed) == len(set(listed))
    there = {
        spelling.lstrip("-")
        for command in (typer.main.get_command(cli.app), *commands_of(cli.app).values())
        for parameter in command.params
        for spelling in parameter.opts
    }
    assert set(listed) - {"help"} <= there


@pytest.mark.parametrize(
    ("name", "line"), [(name, line) for name, lines in EXAMPLES.items() for line in lines]
)
def test_the_examples_of_the_help_can_be_read(name, line):
    program, command, *words = shlex.split(line)
    assert (program, command) == ("safe-envs", name)
    parser = commands_of(cli.app)[name]
    known = {word for each in parser.params for word in (*each.opts, *each.secondary_opts)}
    assert {word for word in words if word.startswith("--")} <= known
    reads_files = ("check", "sweep", "sweep-report")
    if name in reads_files or "my_policy.py:Policy" in words:
        # The files of these examples are not there, so that their values are not read.
        assert parser.make_context(name, [*words], resilient_parsing=True).args == []
        return
    context = parser.make_context(name, [*words])
    assert context.args == []
    for parameter in parser.params:
        assert not parameter.required or context.params[parameter.name]


def test_the_version_is_printed(safe_envs_command):
    assert safe_envs_command("--version") == (0, f"safe-envs {safe_envs.__version__}\n", "")
