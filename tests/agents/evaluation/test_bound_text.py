"""Bounds as text: rounded down, and ">=" only where one is proved."""

from __future__ import annotations

import pytest

from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.table import bound_cells, bound_text, continuous_text, held_text


def test_only_what_is_proved_or_certified_stands_after_a_sign():
    words = ("proved", "certified", "computed", "estimated")
    texts = {word: bound_text(0.5, word) for word in words}
    assert texts == {
        "proved": ">= 50.0 %",
        "certified": ">= 50.0 %",
        "computed": "50.0 % comp.",
        "estimated": "50.0 % est.",
    }
    assert [bound_text(None, word) for word in ("none", "withheld")] == ["-", "withheld"]
    assert bound_text(0.0, "proved") == "0.0 %"
    with pytest.raises(KeyError):
        bound_text(0.5, "none")


def test_cells_of_a_row_and_of_its_document_are_the_same():
    row = BoundSummary(
        held_bound=0.984, held_word="computed", continuous_bound=0.42, continuous_word="proved"
    )
    assert bound_cells(vars(row)) == (held_text(row), continuous_text(row))
    assert bound_cells({"held_bound": None, "held_word": None}) == ("-", "-")
