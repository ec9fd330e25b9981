"""Which tests the targets of the Makefile run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import OWN_TARGETS, selection

ROOT = Path(__file__).parents[1]
MARKED = {
    "docs": "tests/docs_site",
    "oracle": "tests/values/test_value_oracles.py",
    "cluster": "tests/agents/jobs/test_executor.py",
}
"""Tests with each of the marks."""


@pytest.mark.slow
def test_marks_with_targets_of_their_own_run_by_name_only():
    """`make check` selects by a mark of its own, and needs neither mkdocs nor a browser."""
    assert set(MARKED) == set(OWN_TARGETS)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--collect-only", "-q"]
    command += ["-m", "slow or not slow", *MARKED.values()]
    # As in the shell of a user, not as in a worker of this run.
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "test_executor.py::" in done.stdout
    assert not re.search("docs_site|oracle|test_dask|test_ray", done.stdout), done.stdout


@pytest.mark.parametrize(
    ("marks", "left_out"),
    [
        ("", "oracle cluster docs"),
        ("not slow", "oracle cluster docs"),
        ("oracle", "cluster docs"),
        ("cluster", "oracle docs"),
        ("docs", "oracle cluster"),
        ("oracle or docs", "cluster"),
    ],
)
def test_what_a_selection_leaves_out(marks: str, left_out: str):
    assert re.findall(r"not (oracle|cluster|docs)", selection(marks)) == left_out.split()
    # Workers of pytest-xdist get the selection of the process that starts them.
    assert selection(selection(marks)).strip("()") == selection(marks).strip("()")
