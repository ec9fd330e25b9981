"""The tables of the leaderboard fit a terminal, and its Markdown has the same numbers."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from safe_envs import ConfigurationError
from safe_envs.agents.training.leaderboard import entry_of, safety_over_envs
from safe_envs.scripts.reports.leaderboard import (
    BEGIN,
    END,
    LeaderboardReport,
    _count,
    leaderboard_markdown,
    leaderboard_notes,
    leaderboard_tables,
    link_from,
    put_into,
)
from safe_envs.scripts.reports.tables import print_columns
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
    given = {"best": {SCALAR: "too many coordinates"}, "frontiers": {}}
    return LeaderboardReport(
        found,
        tuple(entry for entry in entries if entry),
        safety_over_envs(found),
        **given | changes,
    )


def test_tables_fit_a_terminal_of_80_columns():
    stream = io.StringIO()
    headings = []
    for heading, columns in leaderboard_tables(report()):
        headings.append(heading)
        print_columns(Console(file=stream, width=80), columns[:1], columns[1:])
    assert headings == ["Scalar, filter scbf", "Pendulum, filter scbf", "All 2 envs"]
    lines = stream.getvalue().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    first, second, *_ = [line for line in lines if line.startswith("ppo + promise")]
    cells = [*first.split()[4:], *second.split()[4:]]
    assert cells == [
        "100.0", "[100.0,", "100.0]", "100.0", "[98.5,", "100.0]",
        "500.0", "[500.0,", "500.0]", "200", "2.00",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1 / 3, "0.3"), (0.5, "0.5"), (2 / 3, "1"), (9999, "9,999"), (10_000, "10.0 k"),
     (99_940, "99.9 k"), (99_990, "100 k"), (187_961, "188 k"),
     (999_600, "1000 k"), (12_340_000, "12.3 M")],
)  # fmt: skip
def test_counts_are_short(value, text):
    assert _count(value) == text
    assert len(text) <= 6


def test_a_variant_of_fewer_seeds_and_few_seeds_are_told():
    found = result({(SCALAR, "ppo"): [50, 49, 48, 50], (SCALAR, "nominal"): [0] * 5})
    entries = [entry_of(found, SCALAR, variant) for variant in ("ppo", "nominal")]
    few = LeaderboardReport(found, tuple(e for e in entries if e), {}, {}, {})
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
