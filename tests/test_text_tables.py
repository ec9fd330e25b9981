"""Tables that fit a width, with every cell in them."""

from __future__ import annotations

import itertools
import random

import pytest

from safe_envs.text import (
    SOFT_HYPHEN,
    Column,
    arranged,
    columns_of,
    markdown_of,
    text_of,
    text_width,
    without_empty,
)

NAMES = ("none", "scbf", "learned-hocbf:p=2:level=.95:file=/some/long/path/model.npz+cbf:alpha=1")


def table(names=NAMES):
    rows = len(names)
    columns = [
        Column("bound, held\u00a0input", (">= 42.0 %",) * rows),
        Column("safe [95 % interval]", ("100.0 % [98.2, 100.0]",) * rows),
        Column(f"viola{SOFT_HYPHEN}tions", ("1,234,567",) * rows),
        *(Column(f"quantity {i}", (f"{i}.25",) * rows, part=1) for i in range(7)),
    ]
    return Column("filter", tuple(names), "l"), columns


def unfolded(fitted):
    """The cells of the first column of a table as text, without the folds."""
    return ["".join(str(cell).split()) for cell in fitted[0].cells]


@pytest.mark.parametrize("width", [40, 60, 80, 104, 250])
def test_every_cell_is_in_a_table_and_no_line_is_longer(width):
    names, columns = table()
    tables = arranged([names], columns, width)
    for fitted in tables:
        assert max(map(text_width, text_of(fitted).splitlines())) <= width
        assert unfolded(fitted) == list(NAMES)
    assert [c.column for fitted in tables for c in fitted[1:]] == columns
    text = "\n".join(map(text_of, tables))
    for column in columns:
        assert text.count(str(column.cells[0])) >= len(NAMES)


def test_what_fits_is_one_table_and_parts_stay_together():
    names, columns = table(NAMES[:2])
    assert len(arranged([names], columns, 200)) == 1
    first, second = arranged([names], columns, 80)
    assert [c.column.part for c in first[1:]] == [0, 0, 0]
    assert [c.column.part for c in second[1:]] == [1] * 7


def test_random_tables_are_whole():
    draw = random.Random(0)
    for _ in range(200):
        rows = draw.randrange(0, 4)
        words = ["x" * draw.randrange(1, 40) for _ in range(rows)]
        columns = [
            Column(
                " ".join("t" * draw.randrange(1, 9) for _ in range(draw.randrange(1, 4))),
                tuple("9" * draw.randrange(0, 22) for _ in range(rows)),
                draw.choice("rrl"),
                part=i // 3,
            )
            for i in range(draw.randrange(0, 12))
        ]
        width = draw.randrange(45, 150)
        tables = arranged([Column("name", tuple(words), "l")], columns, width)
        assert [c.column for each in tables for c in each[1:]] == columns
        for each in tables:
            assert unfolded(each) == words
            assert all(text_width(line) <= width for line in text_of(each).splitlines())


def test_many_names_become_numbers_in_further_tables():
    swept = [Column(name, ("a rather long value", "another"), "l") for name in ("x", "y", "z")]
    numbers = [Column(f"n{i}", ("1.234567",) * 2) for i in range(8)]
    first, *others = arranged(swept, numbers, 80)
    assert [c.column.title for c in first[:4]] == ["#", "x", "y", "z"]
    assert {each[0].column.title for each in others} == {"#"}
    shown = [c.column.title for each in (first, *others) for c in each[1:]]
    assert shown == ["x", "y", "z", *(f"n{i}" for i in range(8))]
    assert arranged(swept[:1], numbers[:1], 80)[0][0].column.title == "x"


def test_titles_are_broken_where_they_may_be():
    columns = columns_of(
        "lrr", ["a", f"viola{SOFT_HYPHEN}tions", "min\u00a0h 5\u00a0%"], [["b", "1", "2"]]
    )
    assert [c.title for c in arranged(columns[:1], columns[1:], 80)[0]] == [
        ("a",),
        ("viola-", "tions"),
        ("min h", "5 %"),
    ]
    wide = columns_of("lr", ["a", f"viola{SOFT_HYPHEN}tions"], [["b", "1" * 12]])
    assert arranged(wide[:1], wide[1:], 80)[0][1].title == ("violations",)


def test_texts_of_several_lines_share_what_is_left():
    why = " ".join(["because of this"] * 12)
    columns = columns_of("lprp", ["#", "what", "n", "why"], [["1", "short", "2", why]])
    (fitted,) = arranged(columns[:1], columns[1:], 60)
    assert fitted[1].width == 5
    lines = text_of(fitted).splitlines()
    assert max(map(len, lines)) <= 60
    assert " ".join(" ".join(lines[2:]).split()) == f"1 short 2 {why}"


def test_empty_columns_are_named():
    columns = [Column("a", ("-", "1")), Column(f"b{SOFT_HYPHEN}c", ("-", "-"))]
    kept, empty = without_empty(columns)
    assert (kept, empty) == (columns[:1], ["bc"])


def test_markdown_has_the_cells_with_their_signs_escaped():
    names, columns = table(["a|b", "c*d_e"])
    (fitted,) = arranged([names], columns[:2], 80)
    head, marks, *rows = markdown_of(fitted).splitlines()
    assert head == r"| filter | bound, held input | safe \[95 % interval\] |"
    assert marks == "| :--- | ---: | ---: |"
    assert rows[0] == r"| a\|b | \>= 42.0 % | 100.0 % \[98.2, 100.0\] |"
    assert rows[1].startswith(r"| c\*d\_e |")


def test_a_table_without_rows_has_titles():
    for names, width in itertools.product(([], [Column("a", (), "l")]), (20, 80)):
        (fitted,) = arranged(names, [Column("b", ())], width)
        assert text_of(fitted).splitlines()[0].split() == [*["a"] * len(names), "b"]


def test_text_controls_no_terminal():
    names, columns = table(["a\x1b[31mb", "\u202ecd"])
    (fitted,) = arranged([names], columns[:2], 80)
    assert "a\\x1b[31mb" in text_of(fitted)
    assert "\\u202ecd" in text_of(fitted)
    assert r"a\\x1b\[31mb" in markdown_of(fitted)
    assert not set("\x1b\u202e") & set(text_of(fitted) + markdown_of(fitted))
