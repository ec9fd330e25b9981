"""The worst cells of a sweep, with their bounds where some have one."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from safe_envs.scripts.reports.sweep import print_cells

CELL = {
    "filter": "scbf",
    "error": None,
    "safety_rate": 0.9,
    "ci_low": 0.8,
    "ci_high": 0.95,
    "min_h_p05": 0.1,
    "violations": 3,
    "intervention_rate": 0.5,
    "infeasible_rate": 0.0,
    "return_mean": 2.0,
    "best_lower": None,
    "best_upper": None,
    "held_bound": None,
    "held_word": "none",
    "continuous_bound": None,
    "continuous_word": "none",
}


@pytest.mark.parametrize(
    ("changes", "titles", "cells"),
    [
        ({}, "filter safe [95 % interval] violations min h 5 %", "scbf 90.0 % [80.0, 95.0] 3 0.1"),
        (
            {"continuous_bound": 0.42, "continuous_word": "proved"},
            "filter safe [95 % interval] continuous violations min h 5 %",
            "scbf 90.0 % [80.0, 95.0] >= 42.0 % 3 0.1",
        ),
        (
            {"held_bound": 0.42, "held_word": "computed", "best_lower": 0.9, "best_upper": 0.99},
            "filter held input safe [95 % interval] best times unavoidable violations min h 5 %",
            "scbf 42.0 % comp. 90.0 % [80.0, 95.0] 90.0..99.0 % 1..20 3 0.1",
        ),
    ],
)
def test_bounds_stand_on_both_sides_of_the_rate(changes, titles, cells):
    console = Console(width=200, file=io.StringIO())
    print_cells(console, {"cells": ["a"], "swept": ["filter"]}, [{**CELL, **changes}], 1)
    table = console.file.getvalue().partition("worst:\n")[2]
    lines = [" ".join(line.split()) for line in table.splitlines()]
    # A title may take two lines, above each other.
    head = table.partition("─")[0].replace("-\n", " \n").split()
    assert sorted("".join(head).replace("-", "")) == sorted(
        f"{titles} intervened infeasible return".replace(" ", "")
    )
    assert any(line.startswith(cells) for line in lines)
