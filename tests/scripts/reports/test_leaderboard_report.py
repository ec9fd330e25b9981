"""The tables of the leaderboard fit a terminal, and its Markdown has the same numbers."""

from __future__ import annotations

import json

import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.training.leaderboard import entry_of, safety_over_envs
from safe_envs.scripts.reports.leaderboard import (
    BEGIN,
    END,
    LeaderboardReport,
    leaderboard_markdown,
    leaderboard_notes,
    link_from,
    put_into,
)
from tests.agents.training.test_leaderboard import PENDULUM, SCALAR, result


def report(**changes):
    safe = {
        (env_id, variant): counts
        for env_id in (SCALAR, PENDULUM)
        for variant, counts in (
            ("nominal", [0] * 5),
            ("ppo behind filter", [50, 49, 48, 50, 50]),
            ("ppo + promise filter", [50] * 5),
        )
    }
    found = result(safe)
    found.missing[SCALAR, "ppo behind backup", None] = "no grid"  # pyright: ignore[reportIndexIssue]
    found.missing[PENDULUM, "ppo behind backup", None] = "no grid"  # pyright: ignore[reportIndexIssue]
    entries = [entry_of(found, env_id, variant) for env_id, variant in safe]
    given = {"best": {SCALAR: "too many coordinates"}}
    return LeaderboardReport(
        found,
        tuple(entry for entry in entries if entry),
        safety_over_envs(found),
        **given | changes,
    )


def test_a_variant_of_fewer_seeds_and_few_seeds_are_told():
    found = result({(SCALAR, "ppo"): [50, 49, 48, 50], (SCALAR, "nominal"): [0] * 5})
    entries = [entry_of(found, SCALAR, variant) for variant in ("ppo", "nominal")]
    few = LeaderboardReport(found, tuple(e for e in entries if e), {}, {})
    assert "| ppo, 4 seeds | " in leaderboard_markdown(few, {})
    assert "| nominal | " in leaderboard_markdown(few, {})
    assert any("91 % of the cases" in note for note in leaderboard_notes(few))


def test_what_is_missing_is_told_once_with_its_envs():
    notes = leaderboard_notes(report())
    assert "Scalar, Pendulum: ppo behind backup: no grid." in notes
    assert "Scalar: best: too many coordinates." in notes


def test_markdown_has_a_small_table_and_a_picture_for_each_env():
    found = report()
    text = leaderboard_markdown(found, {SCALAR: "../assets/Scalar.png"})
    assert text.count("### ") == 4
    assert "![Return against violations on Scalar](../assets/Scalar.png)" in text
    tables = [part.splitlines() for part in text.split("\n\n") if part.startswith("|")]
    assert [len(table) for table in tables] == [5, 5, 5]
    for table in tables:
        assert len({line.count("|") for line in table}) == 1
    assert (
        "| nominal | 0.0 % [0.0, 0.0] | 0.0 % [0.0, 1.5] | 0.000 [0.000, 0.000] | - | - |" in text
    )
    assert "- Scalar, Pendulum: ppo behind backup: no grid." in text
    json.dumps(found.document(), allow_nan=False)


def test_only_the_part_of_a_page_between_its_lines_is_replaced(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\n{BEGIN}\nold\n{END}\n\nend\n")
    put_into(page, None)
    assert "old" in page.read_text()
    for new in ("first", "second"):
        put_into(page, new)
        assert page.read_text() == f"# Title\n\n{BEGIN}\n\n{new}\n\n{END}\n\nend\n"
    assert link_from(page, tmp_path / "assets" / "a.png") == "assets/a.png"
    assert link_from(tmp_path / "docs" / "page.md", tmp_path / "a.png") == "../a.png"


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("after", ["", "{}", "{}end{}"])
def test_the_ends_of_lines_and_other_letters_are_kept(tmp_path, newline, after):
    page, rest = tmp_path / "page.md", f"{END}{after.format(newline, newline)}"
    page.write_bytes(f"é{newline}{BEGIN}{newline}{rest}".encode())
    for _ in range(2):
        put_into(page, "a\nb")
        lines = ["é", BEGIN, "", "a", "b", "", rest]
        assert page.read_bytes() == newline.join(lines).encode()


@pytest.mark.parametrize(
    "text",
    [
        f"a {BEGIN}\n{END}\n",
        f"{BEGIN}\na {END}\n",
        "",
        f"{END}\n{BEGIN}\n",
        f"{BEGIN}\n{BEGIN}\n{END}\n",
        BEGIN,
    ],
)
def test_a_page_without_its_lines_is_an_error(tmp_path, text):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ConfigurationError, match="needs the line"):
        put_into(page, "new")
    assert page.read_text() == text
    with pytest.raises(ConfigurationError, match="cannot be read"):
        put_into(tmp_path / "none.md", "new")
