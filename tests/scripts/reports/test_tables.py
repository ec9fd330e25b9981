"""The look of tables."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from safe_envs.scripts.reports.tables import make_table, print_whole


def lines_of(table, width=40):
    stream = io.StringIO()
    Console(file=stream, width=width).print(table)
    return [line.rstrip() for line in stream.getvalue().splitlines()]


@pytest.mark.parametrize(
    ("look", "expected"),
    [
        ({}, ["       some", "what  title", "───────────", "x", "y         1"]),
        ({"tight": False}, ["        some", "what   title", "────────────", "x", "y          1"]),
        ({"indent": True}, ["        some", " what  title", "─────────────", " x", " y         1"]),
    ],
)
def test_texts_are_at_the_left_and_numbers_at_the_right(look, expected):
    table = make_table("pr", "what", "some\ntitle", **look)
    table.add_row("x\ny", "1")
    assert lines_of(table) == expected


def test_numbers_are_never_cut_off():
    stream = io.StringIO()
    console = Console(file=stream, width=10)
    table = make_table("pr", "name", "number")
    table.add_row("x", "1" * 60)
    print_whole(console, table)
    assert "1" * 60 in stream.getvalue()
