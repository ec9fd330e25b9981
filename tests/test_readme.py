"""The README's examples run, and print what it says."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import safe_envs
from safe_envs.scripts.cli import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_examples_run_and_print_what_is_shown():
    examples = re.findall(r"```python\n(.*?)```(?:\n\n```\n(.*?)```)?", README, re.DOTALL)
    assert sum(bool(shown) for _, shown in examples) == 3
    for code, shown in examples:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(code, {})
        assert printed.getvalue()
        assert not shown or printed.getvalue() == shown


def test_every_id_and_command_is_listed():
    for env_id in safe_envs.ENV_IDS:
        assert f"`{env_id}`" in README
    table = README.partition("## Commands")[2]
    for command in app.registered_commands:
        assert re.search(rf"`(safe-envs )?{command.name}\b", table), command.name


def test_its_picture_is_there():
    shown = re.findall(r"!\[.*?\]\((.*?)\)|(?:src|srcset)=\"(.*?)\"", README)
    assert shown
    for written, tagged in shown:
        assert (ROOT / (written or tagged)).is_file()
