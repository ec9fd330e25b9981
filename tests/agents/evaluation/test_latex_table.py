"""The table of an evaluation in LaTeX: it is read back, and compiled where LaTeX is there."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from safe_envs.agents.evaluation.latex_table import escape, latex_table
from safe_envs.agents.evaluation.notes import evaluation_notes
from tests.agents.evaluation.made_up import nasty_evaluation

SIGNS = r"""\{}^~<>|"'`&%$#_[]*@!?-- --- a_b 50 % -1 x:-2 >= <= λ_1 ü ß Ł 中 🙂"""
TEXT = {
    r"\textbackslash{}": "\\",
    r"\textasciicircum{}": "^",
    r"\textasciitilde{}": "~",
    r"\textbar{}": "|",
    r"\char34{}": '"',
    r"\char39{}": "'",
    r"\char96{}": "`",
    r"\raggedright ": "",
    r"\newline ": "",
    r"$\geq$": ">=",
    r"$\leq$": "<=",
    r"$\lambda$": "λ",
    "$<$": "<",
    "$>$": ">",
    "$-$": "-",
    **{f"\\{sign}": sign for sign in "{}&%$#_"},
    "-{}": "-",
}


def plain(latex):
    """Return what is set, and fail at a command or a sign that is not known."""
    found, i = "", 0
    while i < len(latex):
        command = next((c for c in TEXT if latex.startswith(c, i)), None)
        assert command or latex[i] not in "\\$&#^_~%{}", latex[i:]
        found += TEXT[command] if command else latex[i]
        i += len(command or latex[i])
    return found


def rows_of(latex):
    """Return the cells of the rows of each tabular."""
    tabulars = re.findall(
        r"\\begin\{tabular\}\{@\{\}(.*?)@\{\}\}\n(.*?)\\end\{tabular\}", latex, re.S
    )
    found = []
    for kinds, body in tabulars:
        rules = re.findall(r"\\(\w+)$", body, re.MULTILINE)
        assert rules == ["toprule", "midrule", "bottomrule"]
        columns = len(re.sub(r"p\{.*?\}", "l", kinds))
        rows = []
        for line in body.splitlines():
            if line.startswith("\\"):
                continue
            assert line.endswith(r" \\")
            cells = line.removesuffix(r" \\").split(" & ")
            assert len(cells) == columns
            assert all(cell.startswith("{") and cell.endswith("}") for cell in cells)
            rows.append([plain(cell[1:-1]) for cell in cells])
        found.append(rows)
    return found


@pytest.fixture(scope="module")
def evaluated():
    answer = nasty_evaluation()
    name = "[*] " + "".join(c for c in SIGNS if c not in " Ł中🙂")
    names = {answer.rows[2].filter: name}
    return replace(
        answer,
        rows=[replace(row, filter=names.get(row.filter, row.filter)) for row in answer.rows],
        comparisons=[
            replace(c, first=names.get(c.first, c.first), second=names.get(c.second, c.second))
            for c in answer.comparisons
        ],
        config={**answer.config, "title": f"{SIGNS}-v0"},
    )


def test_all_signs_are_escaped():
    shown = SIGNS.replace("Ł", "U+0141").replace("中", "U+4E2D").replace("🙂", "U+1F642")
    assert plain(escape(SIGNS)) == shown
    assert "--" not in escape("a--b---c")
    assert escape("-0.5 [-1, -.2] a-1 -") == "$-$0.5 [$-$1, $-$.2] a-1 -"
    assert plain(escape("a\tb\x00\n")) == r"a\tb\x00 "


def test_cells_are_those_of_the_evaluation(evaluated):
    *tables, differences = rows_of(latex_table(evaluated))
    names = ["".join(row.filter.split()) for row in evaluated.rows]
    for table in tables:
        assert ["".join(cells[0].split()) for cells in table[-3:]] == names
    cells = [cell for table in tables for row in table for cell in row]
    for row in evaluated.rows:
        assert f"{row.min_h_median:.3g}" in cells
        low, high = 100 * row.ci_low, 100 * row.ci_high
        assert f"{100 * row.safety_rate:.1f} % [{low:.1f}, {high:.1f}]" in cells
    for text in (">= 12.3 %", "50.0 % est.", "50.0 % comp.", ">= 40.0 %", "infeasible"):
        assert text in cells
    (compared,) = [c for c in evaluated.comparisons if c.second != "none"]
    (shown,) = differences[2:]
    whole = f"{compared.first} - {compared.second}"
    assert "".join(shown[0].split()) == "".join(whole.split())
    assert shown[1].startswith(f"{100 * compared.difference:+.1f} [{100 * compared.ci_low:.1f}")


def test_caption_and_label_say_what_it_is(evaluated):
    latex = latex_table(evaluated)
    (caption,) = re.findall(r"^\\caption\{(.*)\}$", latex, re.MULTILINE)
    told = plain(caption)
    for text in ("20 episodes", "seed 0", "95 % interval", "est. is estimated", "99.99 %"):
        assert text in told
    (label,) = re.findall(r"^\\label\{(.*)\}$", latex, re.MULTILINE)
    assert re.fullmatch(r"tab:[a-z0-9-]+", label)
    assert latex.count(r"\begin{table}") == latex.count(r"\end{table}") == 1


def test_notes_stand_below_the_tables(evaluated):
    speeds = [replace(each, steps=each.steps // 2) for each in evaluated.timing.rows]
    evaluated = replace(evaluated, timing=replace(evaluated.timing, rows=speeds))
    notes = evaluation_notes(evaluated)
    assert any("the mean episode ends after" in note for note in notes)
    assert any(note.startswith("no bound, ") for note in notes)
    box = latex_table(evaluated).partition("\\begin{minipage}{\\linewidth}\n\\raggedright\n")[2]
    *lines, end, closed = box.splitlines()
    assert (end, closed) == ("\\end{minipage}", "\\end{table}")
    assert lines == [f"Note: {escape(note)}\\par" for note in notes]
    assert "tabular" not in box


@pytest.mark.slow
def test_it_compiles(evaluated, tmp_path):
    program = next(filter(None, map(shutil.which, ("pdflatex", "tectonic"))), None)
    if program is None:
        pytest.skip("neither pdflatex nor tectonic is installed, so that nothing can be compiled")
    if "pdflatex" in program and subprocess.run(["kpsewhich", "booktabs.sty"]).returncode:
        pytest.skip("LaTeX is installed without its package booktabs")
    document = (
        "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n"
        f"{latex_table(evaluated)}\n\\end{{document}}\n"
    )
    (tmp_path / "table.tex").write_text(document, encoding="utf-8")
    options = ["-interaction=nonstopmode", "-halt-on-error"] * ("pdflatex" in program)
    done = subprocess.run(
        [program, *options, "table.tex"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "table.pdf").stat().st_size > 1000
