"""Every figure in both sizes: what is written can be read, fonts are TrueType, bytes are equal."""

from __future__ import annotations

import importlib
import itertools
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest import mock

import matplotlib as mpl
import matplotlib.style
import numpy as np
import pytest
from matplotlib import image
from matplotlib.figure import Figure

from safe_envs import plot_log
from safe_envs.scripts import cli
from safe_envs.scripts.figures import style, sweep
from safe_envs.scripts.figures.style import COLORS, DASHES, MARKERS, STYLE, WARM, look
from safe_envs.scripts.options.evaluation_options import WIDTHS
from tests.readable import figure_texts, unreadable
from tests.scripts.figures import test_log_figure, test_sweep_figure
from tests.scripts.figures.colour_vision import VISIONS, ciede2000, lab

pytestmark = pytest.mark.slow

LEAST_DISTANCE = 10.0
"""In CIEDE2000, of two colours of lines; 2.3 can just be noticed."""

COMMANDS = {
    "evaluation": (
        "evaluate CubicSDEDisk-v0 --horizon 0.5 --no-bounds --filter none --filter scbf"
        " --episodes 10"
    ),
    "verification": "verify CubicSDEDisk-v0 --no-simulate",
    "best": "best Pendulum-v0 --horizon 0.1 --cells 20x16 --inputs 3 --episodes 0",
    "identification": "identify CubicSDE-v0 --method bayesian --set degree=3",
}
FURTHER = {
    "evaluation of many inputs": (
        "evaluate QuadrotorLimits-v0 --horizon 2 --filter none --filter hocbf --episodes 3"
    ),
    "verification of a line": "verify Scalar-v0 --no-simulate",
    "best over a line": "best Scalar-v0 --inputs 3 --episodes 0",
}
FUNCTIONS = {
    "evaluate": "evaluation:plot_evaluation",
    "verify": "verify:plot_verification",
    "best": "best:plot_attainable",
    "identify": "identify:plot_identification",
}


@cache
def figure_maker(kind: str) -> Callable[[str], Figure]:
    """What makes the figure of a command in a size, from what the command found."""
    words = {**COMMANDS, **FURTHER}[kind].split()
    name, function = FUNCTIONS[words[0]].split(":")
    module = importlib.import_module(f"safe_envs.scripts.figures.{name}")
    more = ["--out", "learned.npz"] if words[0] == "identify" else []
    with (
        mock.patch.object(module, function) as called,
        mock.patch.object(sys, "argv", ["safe-envs", *words, *more, "--plot", "figure.pdf"]),
        pytest.raises(SystemExit) as ended,
    ):
        cli.main()
    assert not ended.value.code
    given, settings = called.call_args
    *given, _ = given
    assert settings.pop("size") == "double"
    return lambda size: getattr(module, function)(*given, size=size, **settings)


def figure_of(kind: str, size: str) -> Figure:
    if kind == "log":
        return plot_log(test_log_figure.log_of(test_log_figure.UNSAFE), size=size)
    if kind == "sweep":
        rows = test_sweep_figure.ROWS
        layout = sweep.Layout.of(rows, test_sweep_figure.SWEPT)
        return sweep.figure_of(rows, layout, size)[0]
    return figure_maker(kind)(size)


@pytest.mark.parametrize("size", list(WIDTHS))
@pytest.mark.parametrize(
    "kind",
    [*COMMANDS, "log", "sweep", *(pytest.param(k, marks=pytest.mark.oracle) for k in FURTHER)],
)
def test_every_text_can_be_read(kind, size, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    figure = figure_of(kind, size)
    assert figure.get_figwidth() == pytest.approx(WIDTHS[size])
    texts, without = figure_texts(figure)
    assert len(texts) > 8
    assert unreadable(texts, without) == []
    assert min(text.size for text in texts) >= 7.0


@pytest.mark.oracle
def test_equal_figures_are_equal_files_with_truetype_fonts(tmp_path):
    formats = ("pdf", "ps", "eps", "svg", "png")
    script = (
        "import sys; from pathlib import Path; from matplotlib.figure import Figure\n"
        "from safe_envs.scripts.figures import style; import matplotlib\n"
        "with matplotlib.rc_context(style.STYLE):\n"
        "    figure = Figure(figsize=(3.5, 2)); axes = figure.subplots()\n"
        "    axes.plot([1, 2], [3, 4], label='a line')\n"
        "    axes.set_xlabel(style.quantity('sigma_1', 'm/s/sqrt(s)'))\n"
        "    axes.set_ylabel('\\u2212\\u00b2\\u00b7\\u221a')\n"
        "    style.add_legend(figure, axes.get_legend_handles_labels()[0])\n"
        "    for suffix in sys.argv[2:]: style.save(figure, Path(f'{sys.argv[1]}.{suffix}'))\n"
    )
    for seed, name in enumerate(("one", "another")):
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / name), *formats],
            check=True,
            env={"PYTHONHASHSEED": str(seed), "PYTHONPATH": ":".join(sys.path)},
        )
    found = {suffix: (tmp_path / f"one.{suffix}").read_bytes() for suffix in formats}
    for suffix, content in found.items():
        assert content == (tmp_path / f"another.{suffix}").read_bytes(), suffix
    assert b"/FontFile2" in found["pdf"]
    assert b"/Subtype /CIDFontType2" in found["pdf"]
    assert not re.search(rb"/Subtype\s*/Type3", found["pdf"])
    assert b"CreationDate" not in found["pdf"]
    for suffix in ("ps", "eps"):
        assert b"/FontType 42" in found[suffix]
        assert b"/FontType 3" not in found[suffix]


@pytest.mark.parametrize("kind", ["best", pytest.param("evaluation", marks=pytest.mark.oracle)])
def test_a_figure_that_is_written_twice_is_the_same_file(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    figure = figure_of(kind, "single")
    engine = figure.get_layout_engine()
    # The layout of one format must not be where that of the next begins.
    first = [written(figure, tmp_path / f"first.{suffix}") for suffix in ("png", "svg", "pdf")]
    again = [written(figure, tmp_path / f"again.{suffix}") for suffix in ("png", "svg", "pdf")]
    assert first == again
    figure.savefig(tmp_path / "own.svg")
    assert (tmp_path / "own.svg").read_bytes() == first[1]
    assert figure.get_layout_engine() is engine
    assert all(axes.get_in_layout() for axes in figure.axes)


def written(figure: Figure, path: Path) -> bytes:
    style.save(figure, path)
    return path.read_bytes()


def test_a_pdf_embeds_truetype_fonts_whoever_saves_it(tmp_path):
    figure = figure_of("log", "single")
    style.save(figure, tmp_path / "figure.pdf")
    figure.savefig(tmp_path / "later.pdf")
    for name in ("figure.pdf", "later.pdf"):
        content = (tmp_path / name).read_bytes()
        assert b"/FontFile2" in content
        assert not re.search(rb"/Subtype\s*/Type3", content)


TEX = {"text.usetex": True, "axes.facecolor": "black", "pdf.fonttype": 3, "savefig.dpi": 50}


def test_neither_a_dark_style_nor_tex_changes_a_figure(tmp_path):
    plain, styled = tmp_path / "plain.png", tmp_path / "styled.png"
    figure_of("log", "single").savefig(plain)
    backend = dict.get(mpl.rcParams, "backend")
    with mpl.rc_context():
        mpl.style.use("dark_background")
        mpl.rcParams.update(TEX)
        figure_of("log", "single").savefig(styled)
    # The layout may differ in its last digits, which moves the edge of a letter: most pixels agree.
    expected, found = image.imread(plain), image.imread(styled)
    assert found.shape == expected.shape
    assert np.mean(np.abs(found - expected)) < 0.01
    assert dict.get(mpl.rcParams, "backend") == backend


def test_the_check_finds_what_cannot_be_read():
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.5, 2.5))
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color="black")
        axes.set(xlim=(0, 1), ylim=(0, 1))
        axes.text(0.45, 0.5, "crossed")
        axes.text(0.1, 0.8, "twice")
        axes.text(0.12, 0.8, "double")
        axes.text(0.95, 0.2, "cut off at the right", in_layout=False)
        axes.text(0.2, 0.6, "pale", color="#DDDDDD")
    found = " ".join(unreadable(*figure_texts(figure)))
    assert "'crossed' is on a line" in found
    assert "'twice' overlaps 'double'" in found
    assert "'cut off at the right' is cut off" in found
    assert "'pale' is hard to tell" in found
    assert "'0.0'" not in found


def test_colours_can_be_told_apart_whatever_the_vision():
    for vision in VISIONS:
        seen = [lab(color, vision) for color in (*COLORS, WARM)]
        least = min(ciede2000(one, other) for one, other in itertools.combinations(seen, 2))
        assert least > LEAST_DISTANCE, vision


def test_lines_differ_in_more_than_their_colour():
    assert len({str(look(i)) for i in range(36)}) == 36
    assert len({str(look(i)["linestyle"]) for i in range(6)}) == len(DASHES) == len(set(MARKERS))
