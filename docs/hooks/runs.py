r"""Examples in pages, executed when the site is built and followed by what they print.

Fences that begin with ```python run are executed in order, in one namespace for each page. In
```console run every line that begins with "$ safe-envs" is a command; "\" at its end continues it.
Options: `lines=N` shows the first N lines of output only, `fails` expects the command to end with a
user's error. All examples of a page share a temporary folder, in which `examples` is that of the
repository. A line "<!-- file PATH -->" is replaced by a Python file of the repository.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

_COLUMNS = 96
"""Of code that fits the text of a page on a desktop."""
_COLOURED = ("FORCE_COLOR", "TTY_COMPATIBLE")
"""Environment variables that let Rich write as to a terminal."""

_FENCE = re.compile(r"^```(python|console) run([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_ANY_FENCE = re.compile(r"^```(python|console)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_FILE = re.compile(r"^<!-- file (\S+) -->$", re.MULTILINE)
_COMMAND = re.compile(r"^\$ (safe-envs(?:[^\n]*\\\n)*[^\n]*)$", re.MULTILINE)


Fences = Sequence[tuple[str, str, str]]
"""Of a page: kind, options and code of each."""


def with_output(
    markdown: str, cached: Callable[[Any, Callable[[], Any]], Any] | None = None
) -> str:
    """Run the examples of a page, and insert their output and the files that it shows.

    Args:
        markdown: of the page.
        cached: takes the examples and a function that runs them, and returns what it returns, or
            returned before; by default they are run.

    Raises:
        RuntimeError: A command did not end as its fence says.
    """
    markdown = _FILE.sub(lambda found: f"```python\n{(ROOT / found[1]).read_text()}```", markdown)
    markdown = _COMMAND.sub(lambda found: f"$ {_folded(found[1])}", markdown)
    fences = _FENCE.findall(markdown)
    if not fences:
        return markdown
    printed = outputs(fences) if cached is None else cached(fences, lambda: outputs(fences))
    each = iter(printed)
    return _FENCE.sub(lambda found: _shown(found[1], found[2], found[3], next(each)), markdown)


def outputs(fences: Fences) -> list[list[str]]:
    """Run the examples of a page in order, and return what each prints, a text for each command.

    Args:
        fences: of the page.

    Raises:
        RuntimeError: A command did not end as its fence says.
    """
    names: dict[str, Any] = {}
    with _folder():
        return [_printed(kind, options, code, names) for kind, options, code in fences]


def run_python(markdown: str) -> None:
    """Execute all Python of a page in order, for tests."""
    names: dict[str, Any] = {}
    with _folder(), contextlib.redirect_stdout(io.StringIO()):
        for kind, code in _ANY_FENCE.findall(markdown):
            if kind == "python":
                exec(code, names)


def commands_in(markdown: str) -> list[list[str]]:
    """Return the words of every `$ safe-envs` command of a page."""
    return [
        _words(command)
        for kind, code in _ANY_FENCE.findall(markdown)
        if kind == "console"
        for command in _COMMAND.findall(code)
    ]


def _words(command: str) -> list[str]:
    return shlex.split(command.replace("\\\n", " "))


@contextlib.contextmanager
def _folder() -> Iterator[None]:
    """Change to a temporary folder with the repository's examples in it."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "examples").symlink_to(ROOT / "examples")
        with contextlib.chdir(folder):
            yield


@contextlib.contextmanager
def _without_colours() -> Iterator[None]:
    """Print no control characters, also where the environment asks for colours in pipes."""
    before = {name: os.environ.pop(name) for name in _COLOURED if name in os.environ}
    try:
        yield
    finally:
        os.environ.update(before)


def _printed(kind: str, options: str, code: str, names: dict[str, Any]) -> list[str]:
    if kind == "console":
        fails = "fails" in _settings(options)
        return [_output(_words(command), fails) for command in _COMMAND.findall(code)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(code, names)
    return [printed.getvalue()]


def _shown(kind: str, options: str, code: str, printed: Sequence[str]) -> str:
    texts = [_first(text, _settings(options)) for text in printed]
    if kind == "python":
        return f"```python\n{code}```\n\n{_text(texts[0])}"
    # The output is a fence of its own: in a console, Pygments takes a % for a prompt.
    return "\n\n".join(
        f"```console\n$ {command}\n```\n\n{_text(text)}"
        for command, text in zip(_COMMAND.findall(code), texts, strict=True)
    )


def _text(printed: str) -> str:
    """Return a fence with output; lines that fit no page wrap, as they do in a terminal."""
    is_wide = any(len(line) > _COLUMNS for line in printed.splitlines())
    return f"```{{.text .wrapped}}\n{printed}\n```" if is_wide else f"```text\n{printed}\n```"


def _folded(command: str) -> str:
    """Return a command on lines that fit a page, broken before its options."""
    if len(command) <= _COLUMNS or "\n" in command:
        return command
    first, *options = re.split(r" (?=--\w)", command)
    lines = [first]
    for option in options:
        if len(lines[-1]) + len(f" {option} \\") > _COLUMNS:
            lines.append(f"    {option}")
        else:
            lines[-1] += f" {option}"
    return " \\\n".join(lines)


def _settings(options: str) -> dict[str, str]:
    return {name: value for name, _, value in (each.partition("=") for each in options.split())}


def _first(text: str, settings: dict[str, str]) -> str:
    lines = [line.rstrip() for line in text.strip("\n").splitlines()]
    shown = lines[: int(settings.get("lines", len(lines)))]
    return "\n".join([*shown, *["..."] * (len(shown) < len(lines))])


def _output(words: Sequence[str], fails: bool) -> str:
    """Return what a command prints.

    It is run in this process: importing everything again takes longer than most commands.
    """
    import typer

    from safe_envs.scripts.cli import app
    from safe_envs.scripts.options.console import run
    from safe_envs.scripts.options.terminal import as_on_a_terminal

    command, out, err, status = typer.main.get_command(app), io.StringIO(), io.StringIO(), 0
    redirected = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with redirected[0], redirected[1], as_on_a_terminal(), _without_colours():
        try:
            run(lambda: command.main(list(words[1:]), prog_name="safe-envs", standalone_mode=False))
        except SystemExit as end:
            status = int(end.code or 0)
    if (status != 0) != fails:
        raise RuntimeError(f"{' '.join(words)} ended with status {status}: {err.getvalue()}")
    return out.getvalue() + (err.getvalue() if fails else "")
