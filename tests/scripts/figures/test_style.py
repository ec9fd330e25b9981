"""Parts of the pictures."""

from __future__ import annotations

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from safe_envs.scripts.figures.style import STYLE, add_legend


@pytest.mark.parametrize(
    ("labels", "columns"),
    [
        (["none", "scbf"], 2),
        (["none", "a", "b", "c", "d"], 4),
        (
            [
                "none: 83.0 % safe",
                "bayesian-scbf:simultaneous=0.9: 88.0 % safe",
                "bayesian-scbf:confidence=0.95: 85.0 % safe",
            ],
            # Two take 5.65 inches in print.
            1,
        ),
        ([f"ddscbf:margin=0.{i}: 88.0 % safe" for i in range(4)], 2),
        (["none: 83.0 % safe", f"bayesian-scbf:file={'long/' * 30}x.npz: 88.0 % safe"], 1),
    ],
)
def test_the_legend_is_not_cut(labels, columns):
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 6.6))
        figure.subplots()
        add_legend(figure, [Line2D([], [], label=label) for label in labels])
        figure.canvas.draw()
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    # A label that is too long has several lines, and its letters keep their size.
    assert ["".join(text.split()) for text in texts] == ["".join(text.split()) for text in labels]
    assert all(text.get_fontsize() >= 7.0 for text in legend.get_texts())
    assert legend._ncols == columns
    extent = legend.get_window_extent()
    assert extent.x0 >= -1
    assert extent.x1 <= figure.bbox.width + 1


def test_a_tall_legend_makes_the_figure_taller_and_leaves_the_panel_its_height():
    heights = []
    for count in (3, 20):
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(3.5, 3.0))
            axes = figure.subplots()
            add_legend(
                figure, [Line2D([], [], label="a long name " * 3 + f"{i}") for i in range(count)]
            )
            figure.draw_without_rendering()
        heights.append(axes.get_position().height * figure.get_figheight())
    assert heights[1] == pytest.approx(heights[0], abs=0.15)
