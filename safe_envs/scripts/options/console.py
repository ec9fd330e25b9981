"""The terminal: where output goes, how errors end a command, and the progress bar."""

from __future__ import annotations

import copy
import errno
import functools
import inspect
import io
import json
import os
import signal
import sys
import threading
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from safe_envs.errors import SafeEnvsError, nearest, shortened, shown
from safe_envs.files import require_writable, write_atomically, write_json
from safe_envs.text import visible, whole_or_real

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.job import Job, JobOutcome


def strict(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return the parameter of a command, with the project's reader if it is a number.

    Typer itself accepts all that Python does: digits of other scripts, and 1_000.
    """
    if typing.get_origin(parameter.annotation) is not Annotated:
        return parameter
    hint, option, *_ = typing.get_args(parameter.annotation)
    kind = next((kind for kind in (int, float) if kind in (hint, *typing.get_args(hint))), None)
    if kind is None:
        return parameter
    found = copy.copy(option)
    found.parser = _reader(kind, option.min)
    found.metavar = option.metavar or ("INTEGER" if kind is int else "FLOAT")
    return parameter.replace(annotation=Annotated[hint, found])


def _reader(kind: type[int] | type[float], least: float | None) -> Callable[[Any], int | float]:
    what = "a whole number" if kind is int else "a number"

    def read(text: Any) -> int | float:
        try:
            # A default is a number already.
            number = whole_or_real(text) if isinstance(text, str) else text
        except ValueError:
            number = None
        if number is None or (kind is int and not isinstance(number, int)):
            raise typer.BadParameter(f"= {shown(text)}; give {what}")
        if least is not None and number < least:
            raise typer.BadParameter(f"= {shown(number)}; give {what} from {least}")
        return kind(number)

    return read


UsageError: Any = typer.BadParameter.__mro__[1]
"""The error of a command line that Typer cannot read, whichever Click it builds on."""

_LONGEST = 2000
"""Characters of an error, at most: messages of third-party code or files have any length."""

_TOO_LARGE = (
    "can't allocate memory",
    "Maximum allowed dimension exceeded",
    "Maximum allowed size exceeded",
    "array is too big",
)
"""Errors of PyTorch and NumPy about sizes beyond the memory that are no MemoryError."""

_UNWRITABLE = {errno.ENOSPC, errno.EFBIG, errno.EROFS, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Errors of the operating system about a full or read-only disk."""

STDOUT = Path("-")
"""The file of --json that means standard output, where nothing else is printed then."""

_TO_STDOUT = ("json", "json_file", "latex")
"""Parameters of commands whose file may be standard output."""

Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", help="Print the tables only: no progress bar, no headings, no notes."
    ),
]
Json = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Write all that was found; - for stdout, and nothing else there.",
    ),
]


class _Terminal:
    """How much is printed at present."""

    quiet = False
    silent = False


@contextmanager
def quietly(quiet: bool, silent: bool = False) -> Iterator[None]:
    """Print less within this context.

    Args:
        quiet: no progress bar, and of what is printed only the tables.
        silent: nothing on stdout, which is for `write_result`.

    Returns:
        The context.
    """
    before = (_Terminal.quiet, _Terminal.silent)
    _Terminal.quiet, _Terminal.silent = before[0] or quiet, before[1] or silent
    try:
        yield
    finally:
        _Terminal.quiet, _Terminal.silent = before


def with_quiet(command: Callable[..., None]) -> Callable[..., None]:
    """Return the function of a command with the option --quiet and strict numbers.

    Where its --json goes to stdout, it prints nothing else.
    """

    @functools.wraps(command)
    def wrapped(*, quiet: bool = False, **arguments: Any) -> None:
        with quietly(quiet, silent=STDOUT in map(arguments.get, _TO_STDOUT)):
            command(**arguments)

    option = inspect.Parameter(
        "quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Quiet
    )
    return with_signature(
        wrapped,
        [*map(strict, inspect.signature(command, eval_str=True).parameters.values()), option],
    )


def with_signature(
    function: Callable[..., None], parameters: Sequence[inspect.Parameter]
) -> Callable[..., None]:
    """Give a function the parameters that Typer sees.

    Args:
        function: to change.
        parameters: for its signature and its annotations.

    Returns:
        The function.
    """
    function.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return function


def stdout() -> Console:
    """Return the console for results, as wide as the terminal; without one, 80 characters."""
    from safe_envs.scripts.options.terminal import result_console

    return result_console(_Terminal.quiet, _Terminal.silent)


def say(console: Console, text: str | Text, wrap: bool = True) -> None:
    """Print a text: on a terminal in lines of its width, elsewhere in lines as they are.

    Args:
        console: to print on.
        text: to print; markup in a str is not interpreted.
        wrap: whether the lines may be wrapped; a command that is to be copied may not.
    """
    from safe_envs.scripts.options.terminal import visible_text, wrapped_for

    text = visible_text(text)
    if wrap:
        text = wrapped_for(console, text)
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def print_markdown(text: str) -> None:
    """Print tables in Markdown, with --quiet too, unless --json goes to stdout."""
    if not _Terminal.silent:
        print(text)


def require_result(path: Path | None) -> None:
    """Raise ConfigurationError if the file of --json cannot be written, before a long run."""
    if path is not None and path != STDOUT:
        require_writable(path)


def write_result(path: Path | None, document: Callable[[], Any]) -> None:
    """Write the result of a command where --json is given.

    Args:
        path: of --json.
        document: makes the result.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    if path == STDOUT:
        print(json.dumps(document(), indent=2, allow_nan=False))
    elif path is not None:
        write_json(path, document())


def run(command: Callable[[], object]) -> object:
    """Run a command, and return what it returns.

    An error of the user ends the process with a message and the exit status 2.
    """
    if sys.stdout is None:  # Whoever started the command has closed it.
        sys.stdout = io.StringIO()
    try:
        with _terminable():
            try:
                return command()
            finally:
                sys.stdout.flush()
    except SafeEnvsError as error:
        _fail(str(error))
    except UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()
            sys.exit(2)
        _fail(_usage_text(error))
    except typer.Abort:
        sys.exit(130)
    except BrokenPipeError:
        # The reader of the output has closed it.
        _drop_output()
        sys.exit(1)
    except OSError as error:
        if error.errno not in _UNWRITABLE:
            raise
        _drop_output()
        _fail(
            f"cannot write {error.filename or 'the output'}: {error.strerror}; make room, or choose"
            " another place"
        )
    except (MemoryError, RuntimeError, ValueError) as error:
        if not isinstance(error, MemoryError) and not any(
            text in str(error) for text in _TOO_LARGE
        ):
            raise
        reason = str(error) or type(error).__name__
        _fail(
            f"not enough memory for what was asked ({reason}); choose smaller settings, or fewer"
            " episodes"
        )
    except Exception as error:
        # Not imported before it is needed: completion has to be quick.
        from gymnasium.error import Error

        if not isinstance(error, Error):
            raise
        _fail(str(error))


def _drop_output() -> None:
    """Discard what could not be written to stdout, which Python would retry when it ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _terminable() -> Iterator[None]:
    """Handle a request to terminate, as job managers send it, like Ctrl-C: child processes end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _usage_text(error: Any) -> str:
    """Return what is wrong with a command line, in one line, and how to see what it takes."""
    kind, parameter = type(error).__name__, getattr(error, "param", None)
    text = error.message or error.format_message()
    if parameter is not None:
        option = max(parameter.opts, key=len)
        name = option if option.startswith("-") else parameter.metavar or parameter.name
        if kind != "MissingParameter":
            return f"{name} {text}"
        text = f"{name} is missing"
    command = getattr(error.ctx, "command_path", "safe-envs")
    help_text = f"`{command} --help` shows the options"
    if kind == "NoSuchOption":
        given = str(error.option_name)
        options = [name for each in error.ctx.command.params for name in each.opts]
        return f"unknown option {shown(given)}; {nearest(given, options, help_text)}"
    return f"{' '.join(text.split()).rstrip('.')}; {help_text}"


def _fail(message: str) -> NoReturn:
    parts = shortened(message.strip(), _LONGEST).split("\n  ")  # a list of failures
    text = "\n  ".join(visible(part, keep="\u00a0") for part in parts)
    title, text = typer.style("Error:", fg="red", bold=True), typer.style(text, fg="red")
    typer.echo(f"{title} {text}", err=True, color=False if os.environ.get("NO_COLOR") else None)
    sys.exit(2)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], None] | None]:
    """Show a progress bar on stderr if that is a terminal.

    Yields the function that takes the part that is done; None without a bar.
    """
    if _Terminal.quiet or not sys.stderr.isatty():
        yield None
        return

    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda done: bar.update(task, completed=done)


def write_text_result(path: Path | None, text: Callable[[], str]) -> None:
    """Write a text for which an option is given, to a file or to stdout.

    Args:
        path: of the option.
        text: makes it, without an end of line.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    if path == STDOUT:
        print(text())
    elif path is not None:
        write_atomically(path, lambda part: part.write_text(f"{text()}\n", encoding="utf-8"))


def run_jobs(
    jobs: Sequence[Job],
    backend: Backend,
    out: Path,
    title: str,
    keep: Callable[[JobOutcome], None] = lambda _: None,
) -> list[JobOutcome]:
    """Compute jobs with a progress bar.

    Args:
        jobs: what to compute.
        backend: where.
        out: folder of the results, from which the same command resumes after a stop.
        title: of the progress bar.
        keep: receives each outcome as soon as it exists.

    Returns:
        The outcomes of the jobs that failed.
    """
    from safe_envs.agents.jobs.executor import run

    ended: list[JobOutcome] = []
    with progress_bar(title) as tell:

        def note(outcome: JobOutcome) -> None:
            keep(outcome)
            ended.append(outcome)
            if tell:
                tell(len(ended) / len(jobs))

        try:
            run(jobs, backend, note, lambda text: print(text, file=sys.stderr, flush=True))
        except KeyboardInterrupt:
            where = visible(str(out))
            print(f"Stopped. The same command goes on after what is in {where}.", file=sys.stderr)
            raise
    return [outcome for outcome in ended if outcome.error is not None]
