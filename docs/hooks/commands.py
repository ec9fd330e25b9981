"""The page of the command line, generated from the commands."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import typer

from safe_envs.scripts.cli import app

_INTRODUCTION = """# Command line

Every command exits with status 0, or with status 2 and one message for an error that the user can
correct. `--help` after a command prints its section of this page. These options precede a command:
"""

_LETTERS = {int: "N", Path: "PATH"}
"""Placeholders for the values of options without a metavar, by the type of the default."""


def commands() -> dict[str, Any]:
    """Return all commands by name, as typer has them."""
    return dict(typer.main.get_command(app).commands)  # pyright: ignore[reportAttributeAccessIssue]


def options_of(command: Any) -> set[str]:
    """Return the options of a command: `--episodes` and the like."""
    return {
        "--help",
        *(
            text
            for p in command.params
            for text in (*p.opts, *p.secondary_opts)
            if text.startswith("-")
        ),
    }


def command_line_page() -> str:
    """Return Markdown with a section for each command."""
    common = _table(typer.main.get_command(app))
    return "\n".join(
        [
            _INTRODUCTION,
            *common,
            "",
            *(_section(name, command) for name, command in commands().items()),
        ]
    )


def _section(name: str, command: Any) -> str:
    arguments = [
        p.metavar or p.name.upper() for p in command.params if p.param_type_name == "argument"
    ]
    usage = " ".join(["safe-envs", name, *arguments, "[OPTIONS]"])
    return "\n".join(
        [
            f"## {name}",
            "",
            f"```text\n{usage}\n```",
            "",
            inspect.cleandoc(command.help or ""),
            "",
            *_table(command),
            "",
        ]
    )


def _table(command: Any) -> list[str]:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option"]
    rows = [f"| `{p.metavar or p.name.upper()}` | {_cell(p.help)} | |" for p in arguments]
    rows += [f"| `{_written(p)}` | {_cell(p.help)} | {_default(p)} |" for p in options]
    return ["| | meaning | default |", "|---|---|---|", *rows] if rows else []


def _written(option: Any) -> str:
    names = ", ".join((*option.opts, *option.secondary_opts))
    return (
        names
        if option.is_flag
        else f"{names} {option.metavar or _LETTERS.get(type(option.default), 'X')}"
    )


def _default(option: Any) -> str:
    return (
        ""
        if option.default is None or option.is_flag or callable(option.default)
        else f"`{option.default}`"
    )


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
