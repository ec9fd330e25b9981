"""No report is wider than the terminal, and nothing that is to be told is missing in it."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from safe_envs.scripts.options import console, wrapping
from safe_envs.scripts.reports import tables
from safe_envs.scripts.reports.evaluation import print_evaluation
from safe_envs.scripts.reports.sweep import print_cells, print_evaluations
from safe_envs.text import text_width
from tests.agents.evaluation.made_up import LONG_NAME, LONG_WORD, nasty_evaluation
from tests.scripts.reports.test_sweep_cells import CELL
from tests.filters.certificates.examples import disk
from tests.proofs.verified import hurry

SCALAR = ("Scalar-v0", "--horizon", 0.2)
OWN = "a_folder_with_a_long_name/a_file_with_a_long_name.py:AConditionWithALongName"
CONDITION = """
from safe_envs.wrappers import CBF
class AConditionWithALongName(CBF):
    pass
"""


def lines_in(fitted):
    """Return the lines of the cells and titles of a column, after a check that they are whole."""
    title = "".join(fitted.title).replace("-", "")
    assert "".join(title.split()) == "".join(fitted.column.plain_title.replace("-", "").split())
    for cell, given in zip(fitted.cells, fitted.column.cells, strict=True):
        assert "".join(str(cell).split()) == "".join(str(given).split())
    if fitted.column.kind == "p":
        # Words that are longer than the column are folded.
        words = (word for cell in fitted.cells for word in str(cell).split())
        return [*fitted.title, *(word[: fitted.width] for word in words)]
    return [*fitted.title, *(line for cell in fitted.cells for line in str(cell).splitlines())]


@pytest.fixture(params=[80, 60])
def told(request, monkeypatch):
    """Collects what is to be told; calling it with the output checks that all of it is there."""
    parts: list[str] = []
    lines: list[str] = []
    width, arranged, wrapped = request.param, tables.arranged, wrapping.wrapped_for

    def spied(names, columns, given):
        found = arranged(names, columns, given)
        shown = [c for table in found for c in table]
        assert {c.plain_title for c in columns} <= {c.column.plain_title for c in shown}
        parts.extend(line for c in shown for line in lines_in(c))
        return found

    def said(console, text):
        lines.append(str(text))
        return wrapped(console, text)

    monkeypatch.setattr(tables, "arranged", spied)
    monkeypatch.setattr(wrapping, "wrapped_for", said)
    monkeypatch.setattr(console, "_PIPE_WIDTH", width)

    def check(out):
        assert parts
        for line in out.splitlines():
            # A command stays as it is, so that it can be copied.
            assert text_width(line.rstrip()) <= width or "safe-envs " in line, line
        squeezed = "".join(out.split())
        for line in lines:
            assert "".join(line.split()) in squeezed
        for part in parts:
            assert part in out
        return out

    with wrapping.as_on_a_terminal():
        check.width = width  # pyright: ignore[reportFunctionMemberAccess]
        yield check


@pytest.fixture(scope="module")
def evaluated():
    return nasty_evaluation()


def test_evaluate(told, evaluated):
    stream = io.StringIO()
    print_evaluation(Console(file=stream, width=told.width), evaluated, timing=True)
    out = told(stream.getvalue())
    for text in (
        "attainable by any policy: 99.99 %",
        "50.0 % comp.",
        ">= 12.3 %",
        "50.0 % est.",
        ">= 40.0 %",
        "steps/s",
        "avoidable",
        "McNemar",
        "proved",
    ):
        assert text in out


def test_without_a_terminal_each_note_is_one_line(evaluated):
    def printed(width):
        stream = io.StringIO()
        print_evaluation(Console(file=stream, width=width), evaluated)
        return stream.getvalue()

    notes = {
        width: [line for line in printed(width).splitlines() if line.startswith(("Note:", "  "))]
        for width in (60, 80)
    }
    assert len(notes[80]) > 8
    assert {line for line in notes[80] if "Note:" in line} <= set(notes[60])
    assert printed(80) == printed(80)


def test_times_are_shown_only_where_they_are_asked_for(evaluated):
    stream = io.StringIO()
    print_evaluation(Console(file=stream, width=80), evaluated)
    assert "steps/s" not in stream.getvalue()
    assert "learned in" not in stream.getvalue()


@pytest.mark.parametrize("count", [1, 4])
def test_sweep_report(told, count):
    swept = ["filter", *(f"setting_{i}" for i in range(count))]
    cell = {**CELL, "best_lower": 0.9, "best_upper": 0.99, "held_bound": 0.42}
    cell |= {"held_word": "computed", "filter": LONG_NAME} | dict.fromkeys(
        swept[1:], LONG_WORD[:30]
    )
    failed = {**cell, "error": f"{LONG_NAME} cannot be read; name another file"}
    console = Console(file=io.StringIO(), width=told.width)
    print_cells(console, {"cells": "abc", "swept": swept}, [cell, cell, failed], 5)
    out = told(console.file.getvalue())
    assert "90.0 % [80.0, 95.0]" in out
    assert "42.0 % comp." in out


def test_train(told):
    row = {"safety_rate": 0.9, "ci_low": 0.8, "ci_high": 0.95, "return_mean": -1234567.0}
    row |= {"timesteps": 10_000_000, "training": {"violations": 1e9}, "episodes": 100}
    judgement = {"kind": "violation_limit", "limit": 0.01, "episodes": 100, "mean": 0.2}
    judgement |= {"low": 0.1, "high": 0.3, "multiplier": 100.0, "saturated": True}
    judgement |= {"met": False, "evaluation_met": False}
    console = Console(file=io.StringIO(), width=told.width)
    print_evaluations(console, LONG_NAME, [row, row | {"constraint": judgement}])
    assert "NOT MET" in told(console.file.getvalue())


COMMANDS = {
    "rare": ("evaluate", *SCALAR, "--rare", "--particles", 50, "--repetitions", 10, "--timing"),
    "refined": ("evaluate", *SCALAR, "--refine", "--episodes", 5, "--filter", OWN),
    "best": ("best", *SCALAR, "--cells", 50, "--inputs", 5, "--episodes", 20),
    "frontier": (
        *("frontier", *SCALAR, "--cells", 51, "--episodes", 10, "--attained", 10),
        *("--filter", OWN),
    ),
    "verify": ("verify", *SCALAR, "--filter", OWN, "--episodes", 20, "--dt", 0.05),
    "certify": ("certify", *SCALAR, "--degree", 4, "--rate", 0, "--out", f"{LONG_WORD}.json"),
    "held": ("certify", *SCALAR, "--held", "--degree", 4),
    "identify": (
        *("identify", "CubicSDEDisk-v0", "--method", "bayesian", "--set", "degree=2"),
        *("--set", "starts=10", "--set", "steps=20", "--set", "repetitions=10"),
        *("--out", f"{LONG_WORD}.npz"),
    ),
    "list": ("list",),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_commands(told, name, safe_envs_command, monkeypatch):
    hurry(monkeypatch)
    path = Path(OWN.partition(":")[0])
    path.parent.mkdir()
    path.write_text(CONDITION)
    status, out, err = safe_envs_command(*COMMANDS[name])
    assert (status, err) == (0, "")
    told(out)


def test_check(told, safe_envs_command, tmp_path):
    from safe_envs.filters.certificates.files import save_certificate

    save_certificate(disk(), tmp_path / "psi.json")
    status, out, _ = safe_envs_command("check", "psi.json", "--state=0,0", "--state=-.1,.7")
    assert status == 0
    assert ">= 91.99 %" in told(out)
