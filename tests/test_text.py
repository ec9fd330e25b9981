"""Texts: numbers that are read, bounds that say no more than was proved, lines and tables."""

from __future__ import annotations

import math
import random
from fractions import Fraction

import hypothesis
import hypothesis.strategies as st
import pytest

from safe_envs.errors import ConfigurationError, nearest, require_whole, shown
from safe_envs.text import (
    SOFT_HYPHEN,
    Column,
    arranged,
    finite_number,
    folded,
    markdown_of,
    number_at_least,
    number_at_most,
    percent_at_least,
    percent_at_most,
    percents_apart,
    percents_between,
    real,
    real_or_complex,
    text_of,
    text_width,
    visible,
    whole_or_real,
    without_empty,
    wrapped,
)
from tests.conftest import problem_of


@hypothesis.given(st.floats(allow_nan=False) | st.integers(-(10**300), 10**300))
def test_numbers_are_read_as_they_are_written(number):
    assert real(repr(float(number))) == float(number)
    assert whole_or_real(str(number)) == number
    assert type(whole_or_real(str(number))) is type(number)


@pytest.mark.parametrize("text", ["1_000", "٣", "１", "0x10", "1e", "", "1 2", "--1", "1,5", "1j"])  # noqa: RUF001  (digits of other scripts)
def test_what_only_python_takes_for_a_number_is_none(text):
    for read in (real, whole_or_real):
        with pytest.raises(ValueError, match=r"number|float"):
            read(text)


def test_complex_numbers_too():
    assert real_or_complex("-1+2j") == -1 + 2j
    assert real_or_complex("-1") == -1
    for text in ("1_0j", "x"):
        with pytest.raises(ValueError, match=r"digits|complex"):
            real_or_complex(text)


def test_long_whole_numbers_are_no_python_error():
    assert whole_or_real("9" * 5000) == math.inf
    assert whole_or_real("9" * 300) == int("9" * 300)
    for value in ("1_0", "9" * 5000, 10**400, 10**5000):
        with pytest.raises(ConfigurationError) as raised:
            finite_number("dt", value)
        assert len(str(raised.value)) < 300
    with pytest.raises(ConfigurationError, match="seed = a int with too many digits"):
        require_whole("seed", -(10**5000), 0)


def test_texts_are_no_numbers_in_a_start():
    problem = problem_of("safe_envs/Scalar-v0")
    problem.configured(start=[1.0])
    for start in (["1_0"], ["٣"], [10**400]):
        with pytest.raises(ConfigurationError, match="start has 0 numbers"):
            problem.configured(start=start)


@hypothesis.given(
    st.text(max_size=5).map(lambda text: 50 * text)
    | st.integers()
    | st.lists(st.floats(), max_size=20)
)
def test_what_is_shown_is_short_and_whole_where_it_fits(given):
    assert len(shown(given)) <= 170
    if len(repr(given)) <= 120:
        assert shown(given) == repr(given)


@pytest.mark.parametrize(
    ("name", "allowed", "phrase"),
    [
        ("on", ["one"], "did you mean 'one'? (allowed: one; or 7)"),
        ("x", ["one"], "allowed: one; or 7"),
        ("name_3", [f"name_{i}" for i in (3, 50, 60)] + list("abcd"), "did you mean 'name_3'? ("),
        ("evalute", ["evaluate", *"abcdef"], "did you mean 'evaluate'? (or 7)"),
        ("x", "abcdefg", "allowed: a, b, c and 4 more; or 7"),
    ],
)
def test_what_else_helps_stands_after_the_names(name, allowed, phrase):
    assert nearest(name, allowed, "or 7").startswith(phrase)
    assert "?;" not in nearest(name, allowed, "or 7")


SHARES = st.floats(0.0, 1.0)


@pytest.mark.parametrize(
    ("bound", "least", "most"),
    [
        (0.4229, "42.2", "42.3"),
        (0.29, "29.0", "29.0"),
        (0.0924, "9.2", "9.3"),
        (0.9999, "99.9", "99.99"),
        (1.0, "100.0", "100.0"),
        (0.0, "0.0", "0.0"),
        (0.00049, "0.04", "0.05"),
        (6e-19, "0.0", "0.000000001"),
        (Fraction(1, 3), "33.3", "33.4"),
    ],
)
def test_one_bound(bound, least, most):
    assert (percent_at_least(bound), percent_at_most(bound)) == (least, most)


@hypothesis.given(SHARES)
def test_no_digit_says_more_than_a_bound(bound):
    exact = 100 * Fraction(repr(bound))
    assert Fraction(percent_at_least(bound)) <= exact <= Fraction(percent_at_most(bound))
    assert exact - Fraction(percent_at_least(bound, 2)) <= Fraction(1, 100)


@hypothesis.given(SHARES, SHARES)
def test_no_digit_says_more_than_two_bounds(one, other):
    lower, upper = sorted((one, other))
    low, high = (Fraction(text) for text in percents_between(lower, upper))
    assert low <= 100 * Fraction(repr(lower))
    assert 100 * Fraction(repr(upper)) <= high


@hypothesis.given(st.floats(-1e300, 1e300, allow_subnormal=False), st.integers(1, 15))
def test_no_digit_says_more_than_a_number(value, digits):
    low, high = number_at_least(value, digits), number_at_most(value, digits)
    assert Fraction(low) <= Fraction(repr(value)) <= Fraction(high)
    if value and abs(value) > 1e-290:
        spacing = Fraction(10) ** (math.floor(math.log10(abs(value))) + 2 - digits)
        assert Fraction(high) - Fraction(low) <= spacing


@hypothesis.given(SHARES, SHARES)
def test_bounds_that_contradict_each_other_are_told_apart(one, other):
    upper, lower = sorted((one, other))
    most, least = (Fraction(text) for text in percents_apart(upper, lower))
    assert 100 * Fraction(repr(upper)) <= most
    assert least <= 100 * Fraction(repr(lower))
    assert most < least or lower - upper < 1e-15


def test_numbers_have_as_many_digits_as_are_asked_for():
    assert (number_at_most(0.0800001), number_at_least(0.0800001)) == ("0.08001", "0.08")
    assert number_at_most(123.0) == "123"
    assert number_at_most(Fraction(2, 3), 2) == "0.67"
    assert number_at_most(math.inf) == "infinite"


COMPARED = (
    "  promise:p=0.9 - scbf: +21.0 points [15.6, 27.2], McNemar p < 1e-10 (safe with one only:"
    " promise:p=0.9 42, scbf 0)"
)
LONG = "learned-hocbf:alpha=2:level=.95:file=/some/very/long/path/to/a/model.npz+cbf:alpha=1"


@pytest.mark.parametrize("width", [24, 60, 101])
@pytest.mark.parametrize("text", [COMPARED, f"Note: with {LONG} it ends", LONG, "x" * 200, ""])
def test_no_line_is_longer_and_no_character_is_lost(text, width):
    lines = wrapped(text, width, indent=4)
    assert max(map(len, lines)) <= width
    assert "".join("".join(lines).split()) == "".join(text.split())
    assert all(line.startswith("    ") for line in lines[1:])


def test_wide_characters_take_two_places():
    assert text_width("安全") == 4
    assert text_width("e\u0301") == 1
    assert [text_width(line) for line in folded("安全安全安", 4).split("\n")] == [4, 4, 2]


def test_what_controls_a_terminal_is_written_as_python_writes_it():
    assert visible("a\x1b[31m\u202eb\udcff\x9b\t\u2028") == r"a\x1b[31m\u202eb\udcff\x9b\t\u2028"
    for whole in ("C:\\a b.json", "\u03c3 = \u96fb", "two\nlines\u00a0of\u00ad text"):
        assert visible(whole) == whole
    assert visible("two\nlines", keep="") == r"two\nlines"


NAMES = (
    "none",
    "scbf",
    "learned-hocbf:alpha=2:level=.95:file=/some/long/path/model.npz+cbf:alpha=1",
)


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


def test_text_controls_no_terminal():
    names, columns = table(["a\x1b[31mb", "\u202ecd"])
    (fitted,) = arranged([names], columns[:2], 80)
    assert "a\\x1b[31mb" in text_of(fitted)
    assert "\\u202ecd" in text_of(fitted)
    assert r"a\\x1b\[31mb" in markdown_of(fitted)
    assert not set("\x1b\u202e") & set(text_of(fitted) + markdown_of(fitted))
