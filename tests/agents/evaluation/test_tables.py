"""The result of an evaluation as text, columns, frames, Markdown, HTML and LaTeX."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.attainable import TimesUnavoidable
from safe_envs.agents.evaluation.latex_table import escape
from safe_envs.agents.evaluation.notes import evaluation_notes
from safe_envs.agents.evaluation.rows import LearningSummary
from safe_envs.agents.evaluation.spec import RunSettings
from safe_envs.agents.evaluation.table import (
    attainable_text,
    bound_text,
    ends_text,
    evaluation_table,
    times_text,
)
from safe_envs.scripts.reports.evaluation import heading, print_evaluation
from tests.agents.evaluation.made_up import LONG_NAME, attainable, nasty_evaluation

LEARNING = LearningSummary([], 1, 20, [], [], [], {}, [], [], rates=[0.9])
OFTEN = replace(LEARNING, repeats=3, rates=[0.9, 0.5, 0.8])


@pytest.fixture(scope="module")
def nasty():
    return nasty_evaluation()


@pytest.fixture(scope="module")
def found():
    given = {"options": {"horizon": 0.5, "noise": 0.8}, "episodes": 20, "bounds": False}
    return evaluate("Scalar-v0", "random", ["none", "cbf:alpha=2"], **given)


def test_text_is_a_short_table_that_keeps_what_makes_it_honest(found, nasty):
    heading, setting, *_ = str(found).splitlines()
    assert heading == f"{found.title} | policy random | 20 episodes | seed 0"
    assert setting.startswith("noise sigma = 0.8, model = plant")
    assert max(map(len, str(found).splitlines())) <= 80
    assert repr(found) == str(found)
    assert "20 episodes x 3 identifications" in str(nasty)
    shown = {column.plain_title for column in evaluation_table(nasty).short().columns}
    assert {"bound, held input", "safe [95 % interval]", "bound, posterior", "infeasible"} <= shown
    assert found.row("none") is found.rows[0]
    with pytest.raises(KeyError):
        found.row("scbf")


def test_all_forms_tell_the_setting_and_what_makes_intervals_meaningless():
    given = {"options": {"horizon": 0.1}, "episodes": 3, "bounds": False}
    plain = evaluate("DubinsDisk-v0", filters=["none", "hocbf"], **given)
    fixed = replace(
        plain,
        config={**plain.config, "monitoring": "continuous"},
        is_deterministic=True,
        best=replace(attainable(0.9, 1.0), lower=None, upper=None, contradiction="it is"),
    )
    for text in (str(fixed), fixed.to_markdown(), fixed._repr_html_(), fixed.to_latex()):
        words = " ".join(text.split())
        assert "v = 0.8 (model 0.5)" in words
        assert "monitored continuously" in words
        assert "the interval has no meaning" in words
        assert "est attainable safety: withheld" in words


def test_frames_have_a_row_for_each_filter_or_episode_and_columns_of_one_type(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda data: data))
    columns = found.to_frame()
    assert columns["filter"].tolist() == ["none", "cbf:alpha=2"]
    assert columns["safety_rate"].tolist() == [row.safety_rate for row in found.rows]
    assert len(found.to_frame(episodes=True)["return"]) == 40
    # Also where no filter has a number, the column is one of numbers.
    bare = replace(found, rows=[replace(row, effort_mean=None) for row in found.rows])
    for kind, names in (
        ("i", ("violations", "episodes", "touching", "learned_from")),
        ("OU", ("title", "filter", "policy", "held_word", "continuous_note", "withheld")),
        ("f", ("ci_low", "held_bound", "attainable_high", "steps_per_second", "effort_mean")),
    ):
        for name in names:
            assert bare.to_frame()[name].dtype.kind in kind, name
    assert np.isnan(columns["held_bound"]).all()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigurationError, match="pandas"):
        found.to_frame()


def test_episodes_are_kept_up_to_a_million_unless_it_is_said():
    assert [RunSettings().keeps(n) for n in (1_000_000, 1_000_001)] == [True, False]
    assert RunSettings(keep_episodes=True).keeps(1_000_001)
    assert not RunSettings(keep_episodes=False).keeps(1)


@pytest.mark.parametrize(
    ("lower", "upper", "text"),
    [
        (0.9895, 0.9989, "98.9..99.9 %"),
        (0.98999, 0.99501, "98.9..99.6 %"),
        (0.9, 0.9, "90.0 %"),
        (0.9, 0.99951, "90.00..99.96 %"),
        (0.9, 0.99999, "90.000..99.999 %"),
        (0.99999, 1.0, "99.9..100.0 %"),
        (1.0, 1.0, "100.0 %"),
        (0.0, 0.5, "0.0..50.0 %"),
        (None, None, "-"),
    ],
)
def test_ends_are_rounded_outwards(lower, upper, text):
    assert ends_text(lower, upper) == text


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (1.0, 1.6001, "1..1.7"),
        (2.57, 15.2, "2.5..16"),
        (13.9, None, ">= 13"),
        (1.0, 1.0, "1"),
        (141.7, 1000.2, "141..1001"),
    ],
)
def test_times_are_rounded_outwards(low, high, text):
    assert times_text(TimesUnavoidable(low, high)) == text


def test_only_what_is_proved_or_certified_stands_after_a_sign():
    texts = {
        ("proved", 0.5): ">= 50.0 %",
        ("certified", 0.5): ">= 50.0 %",
        ("computed", 0.5): "50.0 % comp.",
        ("estimated", 0.5): "50.0 % est.",
        ("none", None): "-",
        ("withheld", None): "withheld",
        ("proved", 0.0): "0.0 %",
    }
    assert {key: bound_text(key[1], key[0]) for key in texts} == texts
    best = attainable(0.9, 0.99981)
    certified = replace(best, check=SimpleNamespace(lower=1e-6, upper=1e-6))
    of_lower = replace(best, check=SimpleNamespace(lower=1e-6, upper=None))
    shown = [attainable_text(each) for each in (None, best, of_lower, certified)]
    assert shown == [[], ["99.99 %"], ["99.99 %"], ["<= 99.99 %"]]
    assert attainable_text(replace(best, upper=None)) == []
    high = ends_text(0.0, 1.0 - 1e-9).split("..")[1]
    assert high.removesuffix(" %") < "99.99999995"


def test_texts_of_the_user_are_no_markup_in_the_terminal(found):
    learned = replace(found.rows[1], filter="scbf:file=[red]x.npz", learning=OFTEN)
    console = Console(width=200, file=io.StringIO())
    changed = replace(found, rows=[found.rows[0], learned])
    print_evaluation(console, changed)
    assert "\nscbf:file=[red]x.npz" in console.file.getvalue()
    assert "20 episodes x 3 identifications" in heading(changed).plain


def test_markdown_has_every_cell(nasty):
    markdown = nasty.to_markdown()
    for column in evaluation_table(nasty).columns:
        for cell in column.cells:
            assert cell.replace("[", "\\[").replace("]", "\\]").replace(">", "\\>") in markdown
    tables = [part for part in markdown.split("\n\n") if part.startswith("| filter")]
    assert {part.count("\n") for part in tables} == {4}


ATTACK = '<script>alert("x")</script> & <b onclick="f()">'


class Reader(HTMLParser):
    """Reads tags, their attributes, and the texts of cells."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes, self.tables, self.text = [], set(), [], [], ""

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


def test_html_has_all_rows_and_notes_and_is_escaped_without_scripts_and_colors(nasty):
    rows = [*nasty.rows[:2], replace(nasty.rows[2], filter=ATTACK)]
    pairs = [replace(c, second=ATTACK) for c in nasty.comparisons]
    changed, reader, shown = replace(nasty, rows=rows, comparisons=pairs), Reader(), {}
    reader.feed(changed._repr_html_())
    assert not reader.open
    for titles, *lines in reader.tables:
        assert [line[0] for line in lines] == ["none", LONG_NAME, ATTACK]
        assert {len(line) for line in lines} == {len(titles)}
        shown |= dict(zip(titles, zip(*lines, strict=True), strict=True))
    for cell, row in zip(shown["safe [95 % interval]"], rows, strict=True):
        assert f"[{100 * row.ci_low:.1f}, {100 * row.ci_high:.1f}]" in cell
    assert shown["bound, continuous"][1:] == (">= 12.3 %", "50.0 % est.")
    assert {"violations", "infeasible", "effort", "return", "times unavoidable"} <= set(shown)
    notes = evaluation_notes(changed)
    assert len(notes) > 3
    for text in ("any policy: 99.99 %", "McNemar p", *(f"Note: {note}" for note in notes)):
        assert text in reader.text
    tags = "div p b br small table thead tbody tr th td"
    assert " ".join(sorted(reader.tags)) == " ".join(sorted(tags.split()))
    assert {name for name, _ in reader.attributes} <= {"style", "scope", "class"}
    styles = " ".join(value or "" for name, value in reader.attributes if name == "style")
    assert not re.search(r"#|rgb|background|(?<!-)color:", styles)
    assert set(re.findall(r"\d+px solid (\w+)", styles)) == {"currentColor"}


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
    result, i = "", 0
    while i < len(latex):
        command = next((c for c in TEXT if latex.startswith(c, i)), None)
        assert command or latex[i] not in "\\$&#^_~%{}", latex[i:]
        result += TEXT[command] if command else latex[i]
        i += len(command or latex[i])
    return result


@pytest.fixture(scope="module")
def signs(nasty):
    """The evaluation with names of all signs, of which half of the steps were simulated."""
    name = "[*] " + "".join(c for c in SIGNS if c not in " Ł中🙂")
    names = {nasty.rows[2].filter: name}
    speeds = [replace(each, steps=each.steps // 2) for each in nasty.timing.rows]
    return replace(
        nasty,
        rows=[replace(row, filter=names.get(row.filter, row.filter)) for row in nasty.rows],
        comparisons=[
            replace(c, first=names.get(c.first, c.first), second=names.get(c.second, c.second))
            for c in nasty.comparisons
        ],
        config={**nasty.config, "title": f"{SIGNS}-v0"},
        timing=replace(nasty.timing, rows=speeds),
    )


def test_latex_has_the_cells_the_setting_and_the_notes_with_all_signs_escaped(signs):
    shown = SIGNS.replace("Ł", "U+0141").replace("中", "U+4E2D").replace("🙂", "U+1F642")
    assert plain(escape(SIGNS)) == shown
    assert "--" not in escape("a--b---c")
    assert escape("-0.5 [-1, -.2] a-1 -") == "$-$0.5 [$-$1, $-$.2] a-1 -"
    assert plain(escape("a\tb\x00\n")) == r"a\tb\x00 "
    latex = signs.to_latex()
    bodies = re.findall(r"\\begin\{tabular\}.*?\n(.*?)\\end\{tabular\}", latex, re.S)
    assert len(bodies) > 1
    for body in bodies:
        lines = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert len({len(re.findall(r"(?<!\\)&", line)) for line in lines}) == 1
    whole = "".join(latex.replace(r"\newline ", "").split())
    texts = [">= 12.3 %", "50.0 % est.", "50.0 % comp.", ">= 40.0 %", "infeasible"]
    for row in signs.rows:
        low, high = 100 * row.ci_low, 100 * row.ci_high
        rate = f"{100 * row.safety_rate:.1f} % [{low:.1f}, {high:.1f}]"
        texts += [row.filter, f"{row.min_h_median:.3g}", rate]
    (compared,) = [c for c in signs.comparisons if c.second != "none"]
    texts += [f"{100 * compared.difference:+.1f} [{100 * compared.ci_low:.1f}"]
    for text in texts:
        assert "".join(escape(text).split()) in whole, text
    (caption,) = re.findall(r"^\\caption\{(.*)\}$", latex, re.MULTILINE)
    for text in ("20 episodes", "seed 0", "95 % interval", "est. is estimated", "99.99 %"):
        assert text in plain(caption)
    assert len(re.findall(r"^\\label\{tab:[a-z0-9-]+\}$", latex, re.MULTILINE)) == 1
    notes = evaluation_notes(signs)
    assert any("the mean episode ends after" in note for note in notes)
    assert any(note.startswith("no bound, ") for note in notes)
    assert re.findall(r"^Note: (.*)\\par$", latex, re.MULTILINE) == list(map(escape, notes))


@pytest.mark.oracle
def test_latex_compiles(signs, tmp_path):
    program = next(filter(None, map(shutil.which, ("pdflatex", "tectonic"))), None)
    if program is None:
        pytest.skip("neither pdflatex nor tectonic is installed, so that nothing can be compiled")
    if "pdflatex" in program and subprocess.run(["kpsewhich", "booktabs.sty"]).returncode:
        pytest.skip("LaTeX is installed without its package booktabs")
    document = (
        "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n"
        f"{signs.to_latex()}\n\\end{{document}}\n"
    )
    (tmp_path / "table.tex").write_text(document, encoding="utf-8")
    options = ["-interaction=nonstopmode", "-halt-on-error"] * ("pdflatex" in program)
    done = subprocess.run(
        [program, *options, "table.tex"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:]
