"""The terminal: where output goes, how errors end a command, and the progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gymnasium.error import Error as GymnasiumError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from safe_envs.errors import SafeEnvsError

_LEAST_WIDTH = 104
_PIPE_WIDTH = 240


def stdout() -> Console:
    """Console for results: wide enough for a table, and on a pipe for whatever is in it."""
    if sys.stdout.isatty():
        return Console(width=max(Console().width, _LEAST_WIDTH))
    return Console(width=_PIPE_WIDTH)


def run(command: Callable[[], object]) -> None:
    """Run a command; an error of the user's making ends it with a message and the exit status 2."""
    try:
        command()
    except (SafeEnvsError, GymnasiumError) as error:
        Console(stderr=True).print(f"[bold red]Error:[/] [red]{escape(str(error))}[/]", soft_wrap=True, highlight=False)
        sys.exit(2)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], None] | None]:
    """A progress bar on stderr, if that is a terminal: yields the function to tell which part is done, or None."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda done: bar.update(task, completed=done)
