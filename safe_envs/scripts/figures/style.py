"""The style of all pictures: colours that the colour-blind can tell apart, and text as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# The palette of Okabe and Ito.
COLORS = ("#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
WARM = "#D55E00"
"""The seventh colour, for what is not filtered, always."""

UNSAFE = "#B9B9B9"
QUIET = "#444444"
STYLE: Any = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 11,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
_MOST_COLUMNS = 4


def add_legend(figure: Figure, handles: Sequence[Any], most: int = _MOST_COLUMNS) -> None:
    """Add a legend below the panels, in as many columns as fit.

    Args:
        figure: with the panels.
        handles: with labels; one too long for a column is written smaller.
        most: columns.
    """
    size, share = mpl.rcParams["font.size"], 1.0
    for columns in range(min(len(handles), most), 0, -1):
        legend = figure.legend(
            handles=handles, loc="outside lower center", ncols=columns, fontsize=size
        )
        share = legend.get_window_extent().width / figure.bbox.width
        if share <= 1.0:
            return
        legend.remove()
    figure.legend(handles=handles, loc="outside lower center", fontsize=size / share)
