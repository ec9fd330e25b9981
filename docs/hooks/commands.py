"""The page of the command line, generated from the commands."""

from __future__ import annotations

import inspect
from typing import Any

import typer

from safe_envs.scripts.cli import COMMANDS, app
from safe_envs.scripts.options.app import EXAMPLES, default_of, sections_of, written

_INTRODUCTION = """# Command line

Every command exits with status 0, or with status 2 and one message for an error that the user can
correct. `--help` after a command prints its section of this page. These options precede a command:
"""


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
    known = commands()
    return "\n".join(
        [
            _INTRODUCTION,
            *_table(typer.main.get_command(app).params, grouped=False),
            "",
            *(
                f"- {panel}: {', '.join(f'[{name}](#{name})' for name in names)}"
                for panel, names in _panels().items()
            ),
            "",
            *(_section(name, command) for name, command in known.items()),
        ]
    )


def _panels() -> dict[str, list[str]]:
    """Return the names of the commands of each group."""
    found: dict[str, list[str]] = {}
    for entry in COMMANDS:
        found.setdefault(entry.panel, []).append(entry.name)
    return found


def _section(name: str, command: Any) -> str:
    arguments = [written(p) for p in command.params if p.param_type_name == "argument"]
    usage = " ".join(["safe-envs", name, "[OPTIONS]", *arguments])
    return "\n".join(
        [
            f"## {name}",
            "",
            f"```text\n{usage}\n```",
            "",
            inspect.cleandoc(command.help or ""),
            "",
            *_table(command.params),
            "",
            "Examples:",
            "",
            "```text",
            *EXAMPLES[name],
            "```",
            "",
        ]
    )


def _table(params: list[Any], grouped: bool = True) -> list[str]:
    """Return the arguments and options as a table, with the title of each group."""
    by_name = {written(p): p for p in params}
    rows = []
    for title, entries in sections_of(params).items():
        rows += [f"| **{title}** | | |"] * grouped
        for name, _ in entries:
            found = by_name[name]
            rows.append(f"| `{name}` | {_cell(found.help)} | {_default(found)} |")
    return ["| | meaning | default |", "|---|---|---|", *rows] if rows else []


def _default(param: Any) -> str:
    if param.required:
        return "required"
    default = default_of(param) if param.param_type_name == "option" else ""
    return default and f"`{default}`"


def _cell(text: str | None) -> str:
    found = (text or "").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
    # Entries of a table have one line.
    return found.replace("\n\n", "<br>").replace("\n", " ")
