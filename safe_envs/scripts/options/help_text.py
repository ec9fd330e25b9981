"""The help of commands: options in groups, examples at the end, at most 80 columns.

Typer's own help draws boxes by rich, which cuts what is wide, and takes longer to import than all
the rest of a command that only prints its help.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from safe_envs.scripts.options.console import UsageError
from safe_envs.scripts.options.panels import EXAMPLES, PANELS, panel_of

_LETTERS = {int: "INTEGER", float: "FLOAT", Path: "PATH"}
"""Placeholders for the values of options without a metavar, by the type of the default."""

_ARGUMENTS = "What"

_WIDEST = 26
"""Characters of the column of options, at most."""

Entry = tuple[str, str]
"""An argument or an option as it is written, and what it means."""


class GroupedCommand(TyperCommand):
    """A command whose help has its options in groups and examples at the end."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """See `typer.core.TyperCommand.parse_args`; errors know whose options are wrong."""
        try:
            return super().parse_args(ctx, args)
        except UsageError as error:
            error.ctx = error.ctx or ctx
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """See `typer.core.TyperCommand.collect_usage_pieces`."""
        arguments = [p for p in self.get_params(ctx) if p.param_type_name == "argument"]
        return ["[OPTIONS]", *map(written, arguments)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperCommand.format_options`."""
        write_sections(formatter, sections_of(self.get_params(ctx)))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperCommand.format_epilog`: examples."""
        examples = EXAMPLES.get(self.name or "", ())
        if examples:
            with formatter.section(heading("Examples")):
                formatter.write("".join(f"  {line}\n" for line in examples))


def sections_of(params: Iterable[Any]) -> dict[str, list[Entry]]:
    """Return the arguments and options of a command by the title of their group.

    Args:
        params: of the command, as Typer has them.
    """
    found: dict[str, list[Entry]] = {panel: [] for panel in PANELS}
    arguments = []
    for param in params:
        if param.param_type_name == "argument":
            arguments.append((written(param), param.help or ""))
        elif not param.hidden:
            panel = panel_of(max(param.opts, key=len)) or param.rich_help_panel or "Other"
            found[panel].append((written(param), with_default(param)))
    found[_ARGUMENTS][:0] = arguments
    return {panel: entries for panel, entries in found.items() if entries}


def _argument(param: Any) -> str:
    """Return an argument as usage lines write it: in brackets if it may be left out."""
    name = (param.metavar or param.name.upper()).strip("[].")
    return f"{name if param.required else f'[{name}]'}{'...' if param.nargs != 1 else ''}"


def written(param: Any) -> str:
    """Return an argument or an option as it is written, with a placeholder for its value."""
    if param.param_type_name == "argument":
        return _argument(param)
    names = ", ".join(sorted(param.opts, key=len))
    if param.is_flag:
        return " / ".join([names, *param.secondary_opts])
    return f"{names} {param.metavar or _LETTERS.get(type(param.default), 'TEXT')}"


def default_of(param: Any) -> str:
    """Return the default of an option that takes a value, as text; "" if it has none to show."""
    if isinstance(param.show_default, str):
        return param.show_default
    if param.is_flag or param.default is None or callable(param.default) or not param.show_default:
        return ""
    return str(param.default)


def with_default(param: Any) -> str:
    """Return what an option means, and its default in brackets."""
    default = default_of(param)
    note = "  [required]" if param.required else f"  [default: {default}]" * bool(default)
    return f"{param.help or ''}{note}"


def write_sections(formatter: Any, sections: dict[str, list[Entry]]) -> None:
    """Write groups of entries with their titles.

    Args:
        formatter: of the help.
        sections: by title.
    """
    names = [len(name) for entries in sections.values() for name, _ in entries]
    # All groups have the same columns; a longer name has a line of its own.
    column = max(length for length in names if length <= _WIDEST) + 4
    for title, entries in sections.items():
        with formatter.section(heading(title)):
            for name, text in entries:
                formatter.write(_entry(name, text, column, formatter.width))


def _entry(name: str, text: str, column: int, width: int) -> str:
    """Return the lines of an entry.

    Words are not divided at hyphens, as Click does: `--closed-loop` is to be found and copied.
    """
    lines = [
        line
        for paragraph in text.split("\n\n")
        for line in textwrap.wrap(
            paragraph, width - column, break_on_hyphens=False, break_long_words=False
        )
    ]
    first = f"  {name}"
    if len(first) > column - 2:
        lines.insert(0, "")
    rows = [f"{first:<{column}}{lines[0] if lines else ''}"]
    return "".join(f"{row.rstrip()}\n" for row in (*rows, *(" " * column + s for s in lines[1:])))


def heading(title: str) -> str:
    """Return a title in bold, which only a terminal shows."""
    return typer.style(title, bold=True)
