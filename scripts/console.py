"""The terminal: where output goes, how errors end a command, and the progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from gymnasium.error import Error as GymnasiumError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from safe_envs.errors import SafeEnvsError

_LEAST_WIDTH = 104
_PIPE_WIDTH = 240
_TOO_LARGE = ("can't allocate memory", "Maximum allowed dimension exceeded", "Maximum allowed size exceeded", "array is too big")
"""What PyTorch and NumPy say of sizes beyond the memory, where it is no MemoryError."""


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
        _fail(str(error))
    except (MemoryError, RuntimeError, ValueError) as error:
        if not isinstance(error, MemoryError) and not any(text in str(error) for text in _TOO_LARGE):
            raise
        reason = str(error) or type(error).__name__
        _fail(f"not enough memory for what was asked ({reason}); choose smaller settings, or fewer episodes")


def _fail(message: str) -> NoReturn:
    Console(stderr=True).print(f"[bold red]Error:[/] [red]{escape(message)}[/]", soft_wrap=True, highlight=False)
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
