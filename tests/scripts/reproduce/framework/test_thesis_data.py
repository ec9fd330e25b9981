"""Data of the thesis: what a file may hold, and how its texts are filled in."""

from __future__ import annotations

import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload
from safe_envs.scripts.reproduce.framework.thesis_data import chapter, read

TEXT = """
settings: {coin: {weight: 2.5, sides: [1, 2]}}
artefacts:
  table-0.1:
    settings: coin
    title: A coin
    setting: ["thrown {count} times", ["of {weight:g} g", "sides {sides[1]}"]]
    argument: "{weight} g is too much"
    printed: {heads: 48.0}
"""


def test_texts_are_filled_in_from_the_section_and_the_module() -> None:
    found = read(TEXT, "file")
    artefact = found.artefact(
        "table-0.1", lambda _: Findings(), lambda sample: {"count": sample.size(7)}
    )
    assert artefact.setting(Workload()) == ("thrown 7 times", "of 2.5 g", "sides 2")
    assert (artefact.title, artefact.argument) == ("A coin", "2.5 g is too much")
    assert (artefact.assumptions, artefact.errata) == ((), ())
    assert found.printed("table-0.1") == {"heads": 48.0}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("title:", "titel:", "unknown fields"),
        ("title: A coin", "title: 3", "3 is not a text"),
        ("weight: 2.5", "weight: .inf", "neither a text nor a finite number"),
        ("weight: 2.5", "weight: null", "neither a text nor a finite number"),
        ("settings: coin\n", "settings: dice\n", "no section 'dice'"),
        ("settings: {coin:", "settings: {coin: {", "file: "),
        ("artefacts:", "others:", "KeyError: 'artefacts'"),
        ("weight: 2.5", "weight: !!python/object:os.system x", "ConstructorError"),
    ],
)
def test_a_file_of_another_form_is_refused(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        read(TEXT.replace(old, new), "file")


@pytest.mark.parametrize("number", [3, 4, 5, 6])
def test_every_artefact_of_a_chapter_has_a_title_a_setting_and_assumptions(number: int) -> None:
    for text in chapter(number).artefacts.values():
        assert text["title"]
        assert text["setting"]
        assert text["assumptions"]
