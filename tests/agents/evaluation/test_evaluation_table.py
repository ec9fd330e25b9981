"""The columns of an evaluation, and what is the same in all rows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safe_envs.agents.evaluation.table import evaluation_table, p_text, thousands
from tests.agents.evaluation.made_up import nasty_evaluation


@pytest.fixture(scope="module")
def evaluated():
    return nasty_evaluation()


def test_columns_that_are_the_same_in_all_rows_are_lines(evaluated):
    table = evaluation_table(evaluated)
    assert table.facts == ["attainable by any policy: 99.99 %"]
    bare = replace(evaluated, rows=evaluated.rows[:1], best=None)
    claims = ("bound, held input", "bound, continuous")
    assert not bare.spec.bounds
    assert evaluation_table(bare).facts == [f"{claim}: not computed" for claim in claims]
    looked = replace(bare, spec=replace(bare.spec, bounds=True))
    assert evaluation_table(looked).facts == [f"{claim}: none of these has one" for claim in claims]
    titles = [column.plain_title for column in evaluation_table(bare).columns]
    assert titles[:2] == ["safe [95 % interval]", "violations"]


def test_times_are_a_part_of_their_own_at_the_end(evaluated):
    without, timed = evaluation_table(evaluated).columns, evaluation_table(evaluated, True).columns
    assert timed[: len(without)] == without
    assert [column.title for column in timed[len(without) :]] == ["steps/s"]
    learned = replace(evaluated.timing.rows[1], learning_seconds=1.5)
    rows = [evaluated.timing.rows[0], learned, evaluated.timing.rows[2]]
    again = evaluation_table(replace(evaluated, timing=replace(evaluated.timing, rows=rows)), True)
    assert again.columns[-2].cells == ("-", "1.50 s", "-")


def test_the_worst_identification_is_that_of_several(evaluated):
    columns = {c.plain_title: c.cells for c in evaluation_table(evaluated).columns}
    assert columns["worst ident."] == ("-", "50.0 %", "-")
    assert columns["bound, posterior"] == ("-", ">= 40.0 %", "-")
    once = replace(evaluated.rows[1].learning, repeats=1, rates=[0.9])
    rows = [evaluated.rows[0], replace(evaluated.rows[1], learning=once)]
    titles = [c.plain_title for c in evaluation_table(replace(evaluated, rows=rows)).columns]
    assert "worst ident." not in titles


def test_the_short_table_keeps_what_makes_it_honest(evaluated):
    titles = [column.plain_title for column in evaluation_table(evaluated).short().columns]
    assert titles == [
        "bound, held input",
        "safe [95 % interval]",
        "violations",
        "bound, continuous",
        "worst ident.",
        "bound, posterior",
        "intervened",
        "infeasible",
        "return",
    ]


def test_markdown_has_every_cell(evaluated):
    markdown = evaluated.to_markdown()
    for column in evaluation_table(evaluated).columns:
        for cell in column.cells:
            assert cell.replace("[", "\\[").replace("]", "\\]").replace(">", "\\>") in markdown
    assert "attainable by any policy: 99.99 %" in markdown
    tables = [part for part in markdown.split("\n\n") if part.startswith("| filter")]
    assert len(tables) == 4
    assert {part.count("\n") for part in tables} == {4}


def test_numbers_as_texts():
    assert [p_text(p) for p in (0.5, 1e-11, 0.00049)] == ["= 0.5", "< 1e-10", "= 0.00049"]
    assert [thousands(x) for x in (1.5e6, 999.0, 36_400.0)] == ["1.50 M", "1 k", "36 k"]
