"""The table of an evaluation in a notebook: escaped, without scripts and colors of its own."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from safe_envs.agents.evaluation.notes import evaluation_notes
from tests.agents.evaluation.made_up import LONG_NAME, nasty_evaluation

ATTACK = '<script>alert("x")</script> & <b onclick="f()">'


class Reader(HTMLParser):
    """Reads tags, their attributes, and the texts of cells."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.attributes: list[tuple[str, str | None]] = []
        self.tables: list[list[list[str]]] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += attrs
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data


@pytest.fixture(scope="module")
def read():
    answer = nasty_evaluation()
    rows = [*answer.rows[:2], replace(answer.rows[2], filter=ATTACK)]
    pairs = [replace(c, second=ATTACK) for c in answer.comparisons]
    reader = Reader()
    reader.feed(replace(answer, rows=rows, comparisons=pairs)._repr_html_())
    assert not reader.open
    return reader, rows


def test_it_has_a_row_for_each_filter_with_its_intervals_and_words(read):
    reader, rows = read
    shown = {}
    for titles, *lines in reader.tables:
        assert [line[0] for line in lines] == ["none", LONG_NAME, ATTACK]
        assert {len(line) for line in lines} == {len(titles)}
        shown |= dict(zip(titles, zip(*lines, strict=True), strict=True))
    for cell, row in zip(shown["safe [95 % interval]"], rows, strict=True):
        assert f"[{100 * row.ci_low:.1f}, {100 * row.ci_high:.1f}]" in cell
    assert shown["bound, continuous"][1:] == (">= 12.3 %", "50.0 % est.")
    assert {"violations", "infeasible", "effort", "return", "times unavoidable"} <= set(shown)
    for text in (
        "attainable by any policy: 99.99 %",
        "est. is estimated, and not proved",
        "McNemar p",
    ):
        assert text in reader.text


def test_notes_stand_below_the_tables(read):
    reader, rows = read
    notes = evaluation_notes(replace(nasty_evaluation(), rows=rows))
    assert len(notes) > 3
    places = [reader.text.rindex(f"Note: {note}") for note in notes]
    assert places == sorted(places)
    assert places[0] > reader.text.rindex("McNemar p")


def test_it_is_escaped_and_has_neither_scripts_nor_colors(read):
    reader, _ = read
    assert reader.tags == {
        *("div", "p", "b", "br", "small"),
        *("table", "thead", "tbody", "tr", "th", "td"),
    }
    assert {name for name, _ in reader.attributes} <= {"style", "scope", "class"}
    styles = " ".join(value or "" for name, value in reader.attributes if name == "style")
    assert not re.search(r"#|rgb|background|(?<!-)color:", styles)
    assert set(re.findall(r"\d+px solid (\w+)", styles)) == {"currentColor"}
