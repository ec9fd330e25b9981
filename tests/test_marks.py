"""Which tests the targets of the Makefile run."""

from __future__ import annotations

import re

import pytest

from tests.conftest import selection


@pytest.mark.parametrize(
    ("marks", "left_out"),
    [
        ("", "oracle cluster"),
        ("not slow", "oracle cluster"),
        ("oracle", "cluster"),
        ("cluster", "oracle"),
        ("oracle or cluster", ""),
    ],
)
def test_what_a_selection_leaves_out(marks: str, left_out: str):
    assert re.findall(r"not (oracle|cluster)", selection(marks)) == left_out.split()
    # Workers of pytest-xdist get the selection of the process that starts them.
    assert selection(selection(marks)).strip("()") == selection(marks).strip("()")
