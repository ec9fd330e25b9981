"""The app that runs commands: all of them as `safe-envs`, or one as a script of its own."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.package_version import package_version
from safe_envs.scripts.options.console import Quiet, quietly, run, with_quiet
from safe_envs.scripts.options.help_text import (
    GroupedCommand,
    heading,
    sections_of,
    write_sections,
)

_NAME = "safe-envs"


@dataclass(frozen=True)
class CommandEntry:
    """A command as the help lists it; its module is imported when it is used.

    Attributes:
        name: of the command.
        panel: group of the help that it is in.
        place: MODULE:NAME of its function, whose parameters are the options.
        about: first sentence of its help.
    """

    name: str
    panel: str
    place: str
    about: str


class _Commands(MutableMapping[str, Any]):
    """Commands by name, each made when it is first asked for."""

    def __init__(self, entries: Sequence[CommandEntry]) -> None:
        self.entries = {entry.name: entry for entry in entries}
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            module, _, function = self.entries[name].place.partition(":")
            self._made[name] = _made(name, getattr(import_module(module), function))
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self.entries, **self._made})

    def __len__(self) -> int:
        return len({**self.entries, **self._made})


class _Group(TyperGroup):
    """A group whose help lists the commands in groups, without importing them."""

    moved: Mapping[str, str] = {}

    def list_commands(self, ctx: Any) -> list[str]:
        """See `typer.core.TyperGroup.list_commands`."""
        return list(self.commands)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """See `typer.core.TyperGroup.resolve_command`; the error of a command that there is not."""
        if args[0] in self.moved and not ctx.resilient_parsing:
            raise ConfigurationError(
                f"the command {shown(args[0])} has moved; run {self.moved[args[0]]}"
            )
        known = args[0].startswith("-") or args[0] in self.commands
        # Completion, which is resilient, prints no error into the line that is being written.
        if not known and not ctx.resilient_parsing:
            raise ConfigurationError(
                f"unknown command {shown(args[0])};"
                f" {nearest(args[0], self.commands, f'`{_NAME} --help` lists all')}"
            )
        return super().resolve_command(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperGroup.format_options`: the commands, and then the options."""
        found: dict[str, list[tuple[str, str]]] = {}
        entries = getattr(self.commands, "entries", {}).values()
        for entry in entries:
            found.setdefault(entry.panel, []).append((entry.name, entry.about))
        write_sections(formatter, found)
        options = [row for rows in sections_of(self.get_params(ctx)).values() for row in rows]
        write_sections(formatter, {"Options": options})

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperGroup.format_epilog`."""
        with formatter.section(heading("More")):
            formatter.write_text("`safe-envs COMMAND --help` lists the options of a command.")


def make_app(
    entries: Sequence[CommandEntry], moved: Mapping[str, str] | None = None
) -> typer.Typer:
    """Return the app of commands, which imports a command when it is used.

    Args:
        entries: in the order of the help.
        moved: what to run in place of commands that there were, by their names.
    """

    class OfEntries(_Group):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands, self.moved = _Commands(entries), moved or {}

    app = _bare_app(OfEntries)

    @app.callback()
    def options_of_all(
        context: typer.Context,
        quiet: Quiet = False,
        version: Annotated[
            bool,
            typer.Option(
                "--version", help="Print the version.", is_eager=True, callback=_print_version
            ),
        ] = False,
    ) -> None:
        """Safety-critical systems as Gymnasium envs, and safety filters over any policy."""
        context.with_resource(quietly(quiet))

    return app


def _bare_app(group: type[TyperGroup]) -> typer.Typer:
    return typer.Typer(
        name=_NAME,
        cls=group,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )


def _made(name: str, function: Callable[..., None]) -> Any:
    """Return the command of a function with its options as parameters."""
    app = _bare_app(TyperGroup)
    text = _unwrapped(inspect.getdoc(function))
    app.command(name, help=text, cls=GroupedCommand)(with_quiet(function))
    # With a callback Typer makes a group of any number of commands.
    app.callback()(lambda: None)
    found: Any = typer.main.get_command(app)
    return found.commands[name]


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"{_NAME} {package_version()}")
        raise typer.Exit


def run_app(app: typer.Typer, *words: str) -> None:
    """Run a command line; an error of the user ends it with the exit status 2.

    Args:
        app: with the commands.
        *words: before those of the command line.
    """
    arguments = [*words, *sys.argv[1:]]
    status = run(lambda: _command(app).main(arguments, prog_name=_NAME, standalone_mode=False))
    sys.exit(status if isinstance(status, int) else 0)


def run_alone(name: str, command: Callable[..., None]) -> None:
    """Run one command as a script, with the arguments of the script.

    Args:
        name: of the command.
        command: the function with its options as parameters.
    """
    place = f"{command.__module__}:{command.__name__}"
    app = make_app([CommandEntry(name, "Commands", place, "")])
    _command(app).commands[name] = _made(name, command)
    run_app(app, name)


def _unwrapped(text: str | None) -> str:
    """Return paragraphs as one line each, which are wrapped to the width of the terminal."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text or "")


@cache
def _command(app: typer.Typer) -> Any:
    """Build the command once: Typer does so at every call, which takes longer than a command."""
    return typer.main.get_command(app)
