"""Lines that fit a width, with every word of the text in them."""

from __future__ import annotations

import pytest

from safe_envs.text import folded, text_width, visible, wrapped

COMPARED = (
    "  promise:p=0.9 - scbf: +21.0 points [15.6, 27.2], McNemar p < 1e-10 (safe with one only:"
    " promise:p=0.9 42, scbf 0)"
)
LONG = "learned-hocbf:p=2:level=.95:file=/some/very/long/path/to/a/model.npz+cbf:alpha=1"


@pytest.mark.parametrize("width", range(24, 131, 7))
@pytest.mark.parametrize("text", [COMPARED, f"Note: with {LONG} it ends", LONG, "x" * 200, ""])
def test_no_line_is_longer_and_no_character_is_lost(text, width):
    lines = wrapped(text, width, indent=4)
    assert max(map(len, lines)) <= width
    assert "".join("".join(lines).split()) == "".join(text.split())
    assert all(line.startswith("    ") for line in lines[1:])


def test_numbers_stay_with_their_units_intervals_and_signs():
    for width in range(40, 100):
        lines = [line.strip() for line in wrapped(COMPARED, width, indent=4)]
        for together in ("+21.0 points", "[15.6, 27.2]", "p < 1e-10"):
            assert sum(together in line for line in lines) == 1
    assert wrapped("a rate of 12.3 % is", 13) == ["a rate of", "12.3 % is"]


def test_what_is_in_brackets_begins_a_line_where_it_does_not_fit():
    lines = wrapped(COMPARED, 80, indent=6)
    assert lines[1].strip() == "(safe with one only: promise:p=0.9 42, scbf 0)"
    # Nearly all of the line would be empty.
    assert wrapped("in (a b c d e f)", 14) == ["in (a b c d e", "f)"]


def test_a_text_that_fits_is_left_alone():
    assert wrapped(COMPARED, 200) == [COMPARED]
    assert wrapped("one  two", 8) == ["one  two"]


@pytest.mark.parametrize("width", [8, 12, 20, 33, 200])
def test_names_are_folded_after_the_signs_that_part_them(width):
    lines = folded(LONG, width).split("\n")
    assert max(map(len, lines)) <= width
    assert "".join(lines) == LONG
    if width > 16:
        assert all(line[-1] in ":+,;/=" for line in lines[:-1])


def test_wide_characters_take_two_places():
    assert text_width("安全") == 4
    assert text_width("e\u0301") == 1
    assert [text_width(line) for line in folded("安全安全安", 4).split("\n")] == [4, 4, 2]


def test_what_controls_a_terminal_is_written_as_python_writes_it():
    assert visible("a\x1b[31m\u202eb\udcff\x9b\t\u2028") == r"a\x1b[31m\u202eb\udcff\x9b\t\u2028"
    for whole in ("C:\\a b.json", "\u03c3 = \u96fb", "two\nlines\u00a0of\u00ad text"):
        assert visible(whole) == whole
    assert visible("two\nlines", keep="") == r"two\nlines"
