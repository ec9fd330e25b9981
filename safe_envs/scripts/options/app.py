"""The app that runs commands: all of them as `safe-envs`, or one as a script of its own."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import typer

from safe_envs.scripts.options.console import Quiet, quietly, run, with_quiet

_NAME = "safe-envs"


def make_app(commands: Mapping[str, Callable[..., None]]) -> typer.Typer:
    """Return the app of some commands.

    Args:
        commands: functions with the options as parameters, by the name of the command.
    """
    app = typer.Typer(name=_NAME, no_args_is_help=True, pretty_exceptions_enable=False)

    @app.callback()
    def options_of_all(context: typer.Context, quiet: Quiet = False) -> None:
        """Safety-critical systems as Gymnasium envs, and safety filters over any policy."""
        context.with_resource(quietly(quiet))

    for name, command in commands.items():
        app.command(name, help=_unwrapped(inspect.getdoc(command)))(with_quiet(command))
    return app


def run_app(app: typer.Typer, *words: str) -> None:
    """Run a command line; an error of the user ends it with the exit status 2.

    Args:
        app: with the commands.
        *words: before those of the command line.
    """
    run(lambda: _command(app)([*words, *sys.argv[1:]], prog_name=_NAME))


def run_alone(name: str, command: Callable[..., None]) -> None:
    """Run one command as a script, with the arguments of the script.

    Args:
        name: of the command.
        command: the function with its options as parameters.
    """
    run_app(make_app({name: command}), name)


def _unwrapped(text: str | None) -> str:
    """Return paragraphs as one line each, which Typer wraps to the width of the terminal."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text or "")


@cache
def _command(app: typer.Typer) -> Any:
    """Build the command once: Typer does so at every call, which takes longer than a command."""
    return typer.main.get_command(app)
