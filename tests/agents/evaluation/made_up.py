"""Results of evaluations that nothing simulated, and of tables that nothing computed."""

from __future__ import annotations

from dataclasses import replace

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.rows import LearningSummary, PosteriorSummary

LONG_NAME = (
    "learned-hocbf:alpha=2.00000001,8:level=.95:file=/a/very/long/path/of/[red]models/v0.npz+cbf"
)
LONG_WORD = "a_name_without_any_joint_that_is_longer_than_what_is_left_of_the_line_of_a_terminal"


def attainable(lower, upper):
    """Return what a table of no problem in particular says."""
    nothing = {"simulated": None, "contradiction": "", "knowledge": "plant", "leaving": "safe"}
    sizes = {"coordinates": (), "cells": (), "inputs": 1, "steps": 1, "seconds": 0.0, "memory": 0}
    return AttainableSafety(lower=lower, upper=upper, specification="", **nothing, **sizes)


def nasty_evaluation():
    """Return an evaluation with all that a table can show, under names of any length."""
    options = {"horizon": 0.2, "noise": 1.5}
    filters = ["none", "scbf", "cbf"]
    answer = evaluate("Scalar-v0", filters=filters, options=options, episodes=20, bounds=False)
    names = {"none": "none", "scbf": LONG_NAME, "cbf": f"cbf:file={LONG_WORD}"}
    learning = LearningSummary([], 3, 20, [], [], [LONG_WORD], {}, [], [LONG_WORD], [0.9, 0.5, 0.8])
    bounds = {
        "held_bound": 0.5,
        "held_word": "computed",
        "held_note": f"of a table in {LONG_NAME}",
        "continuous_bound": 0.123456,
        "continuous_word": "proved",
        "outside_rate": 0.25,
        "touching": 1,
        "posterior_bound": PosteriorSummary(0.4, "it is weak", "proved", 0.1, 1.0, 0.0, 0.0),
    }
    rows = [replace(row, filter=names[row.filter]) for row in answer.rows]
    rows[1] = replace(rows[1], learning=learning, **bounds)
    rows[2] = replace(rows[2], continuous_bound=0.5, continuous_word="estimated")
    speeds = zip(answer.timing.rows, rows, strict=True)
    timing = [replace(speed, filter=row.filter, engine="compiled") for speed, row in speeds]
    return replace(
        answer,
        config={**answer.config, "title": f"safe_envs/{LONG_WORD}-v0"},
        rows=rows,
        comparisons=[
            replace(c, first=names[c.first], second=names[c.second]) for c in answer.comparisons
        ],
        timing=replace(answer.timing, rows=timing),
        best=attainable(0.9, 0.99981),
    )
