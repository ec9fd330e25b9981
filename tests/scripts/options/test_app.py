"""The help of a command, which the terminal wraps and not its docstring."""

from __future__ import annotations

import typer

from safe_envs.scripts.options.app import make_app


def command() -> None:
    """Say something.

    This paragraph has a line that is
    wrapped in the source.

    This one has none.
    """


def test_paragraphs_of_the_help_are_one_line_each():
    app = make_app({"say": command, "other": command})
    found = typer.main.get_command(app).commands["say"].help  # pyright: ignore[reportAttributeAccessIssue]
    assert found.split("\n\n") == [
        "Say something.",
        "This paragraph has a line that is wrapped in the source.",
        "This one has none.",
    ]
