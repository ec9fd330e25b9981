"""The README's examples run, and print what it says."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import safe_envs

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_examples_run_and_the_first_prints_what_is_shown():
    codes = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    shown = re.search(r"```python\n.*?```\n\n```\n(.*?)```", README, re.DOTALL)
    assert shown is not None
    names: dict[str, object] = {}
    for i, code in enumerate(codes):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(code, names)
        if i == 0:
            assert printed.getvalue() == shown.group(1)
        elif i == len(codes) - 1:
            assert printed.getvalue()


def test_every_id_is_listed():
    for env_id in safe_envs.ENV_IDS:
        assert f"`{env_id}`" in README
