"""Figures are the same in every style that a user may have set."""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib import image

from safe_envs.agents import evaluate
from safe_envs.scripts.figures.evaluation import plot_evaluation

_TEX = {"text.usetex": True, "axes.facecolor": "black", "pdf.fonttype": 3, "savefig.dpi": 50}


def test_neither_a_dark_style_nor_tex_changes_a_figure(tmp_path):
    found = evaluate(
        "CubicSDE-v0", filters=["none"], episodes=2, options={"horizon": 0.1}, record=True
    )
    plain, styled, later = (tmp_path / f"{name}.png" for name in ("plain", "styled", "later"))
    plot_evaluation(found, plain, size="single")
    figure = plot_evaluation(found, size="single")
    backend = dict.get(mpl.rcParams, "backend")
    with mpl.rc_context():
        mpl.style.use("dark_background")
        mpl.rcParams.update(_TEX)
        plot_evaluation(found, styled, size="single")
        figure.savefig(later, metadata={"Software": None})
    # The layout may differ in its last digits, which moves the edge of a letter: most pixels agree.
    expected = image.imread(plain)
    for other in (styled, later):
        found_there = image.imread(other)
        assert found_there.shape == expected.shape
        assert np.mean(np.abs(found_there - expected)) < 0.01
    assert dict.get(mpl.rcParams, "backend") == backend
