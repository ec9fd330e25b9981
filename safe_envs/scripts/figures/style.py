"""The style of all figures: column widths, letters, and colours that the colour-blind can tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

# The palette of Okabe and Ito: no two of the seven are closer than 10 in CIEDE2000, also under
# protanopia, deuteranopia and tritanopia.
COLORS = ("#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
WARM = "#D55E00"
"""The seventh colour, for what is not filtered, always."""

DASHES: tuple[Any, ...] = (
    "solid",
    (0, (5, 1.5)),
    (0, (6, 1.5, 1.2, 1.5)),
    (0, (1.4, 1.1)),
    (0, (8, 1.2, 1.2, 1.2, 1.2, 1.2)),
    (0, (2.5, 2.5)),
)
MARKERS = ("o", "s", "^", "D", "v", "P")
UNFILTERED_DASHES = (0, (2.5, 1.0))

UNSAFE = "#B9B9B9"
QUIET = "#444444"
_OF_MACHINE = ("backend", "backend_fallback", "interactive", "toolbar", "timezone", "date.epoch")
STYLE: Any = {
    # The user's own style, a dark one or one of TeX, would make lines and labels unreadable.
    **{name: each for name, each in mpl.rcParamsDefault.items() if name not in _OF_MACHINE},
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    # Hinted letters are up to 8 % narrower or wider at a screen's resolution, at which texts are
    # measured, than in print.
    "text.hinting": "no_hinting",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "figure.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7.5,
    "legend.handlelength": 2.6,
    "legend.columnspacing": 1.4,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.2,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.05,
    # TrueType, which publishers accept, in place of Type 3.
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    # Outlines: as text an SVG looks different where DejaVu Sans is missing, as on phones.
    "svg.fonttype": "path",
    "svg.hashsalt": "safe-envs",
    "savefig.dpi": 300,
}
SCREEN: Any = {
    **STYLE,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "figure.titlesize": 11,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "legend.fontsize": 10,
    "axes.linewidth": 0.8,
}
"""Of pictures of pages, 10 inches wide, which a screen shows smaller."""

HALO = [withStroke(linewidth=2.0, foreground="white")]
"""Of a text in a panel, which lines may cross."""

SMALL = 7.0
"""Size of the smallest letters, in points."""

_MOST_COLUMNS = 4
_LEGEND_HEIGHT = 0.6
"""In inches, of a legend with three lines: the figure grows by what a taller one needs."""

_MARGIN = 0.1
"""In inches, at both sides of the titles and legends together."""


def look(i: int) -> dict[str, Any]:
    """Return colour and dashes of the i-th line; no two of the first 36 are alike."""
    turn, place = divmod(i, len(COLORS))
    return {"color": COLORS[place], "linestyle": DASHES[(place + turn) % len(DASHES)]}


def mark_of(i: int, marks: Sequence[str] = MARKERS) -> str:
    """Return the mark of the i-th line or point, another one where its colour comes again.

    Args:
        i: place among the lines or points.
        marks: to choose from.
    """
    return marks[(i + i // len(COLORS)) % len(marks)]


def wrapped(figure: Figure, text: str, size: float, room: float | None = None) -> str:
    """Return a text in lines that fit, measured in its letters.

    Args:
        figure: that it is to be written in.
        text: which may have several lines.
        size: of the letters, in points.
        room: width in inches; by default that of the figure.
    """
    most = (figure.get_figwidth() - _MARGIN if room is None else room) * figure.dpi
    probe = figure.text(0.0, 0.0, "", fontsize=size)

    def fits(line: str) -> bool:
        probe.set_text(line)
        return probe.get_window_extent().width <= most

    lines = [part for line in text.split("\n") for part in _broken(line, fits)]
    probe.remove()
    return "\n".join(lines)


def _broken(line: str, fits: Callable[[str], bool]) -> list[str]:
    """Return a line broken at spaces, and a word that is too long at any letter."""
    if fits(line):
        return [line]
    lines, current = [], ""
    for word in line.split(" "):
        if not current or fits(f"{current} {word}"):
            current = f"{current} {word}" if current else word
        else:
            lines.append(current)
            current = word
        # Mathematics cannot be cut.
        while "$" not in current and len(current) > 1 and not fits(current):
            end = next(k for k in range(len(current) - 1, 0, -1) if k == 1 or fits(current[:k]))
            lines.append(current[:end])
            current = current[end:]
    return [*lines, current]


def add_title(figure: Figure, text: str) -> None:
    """Add the title of a figure, in as many lines as it takes.

    Args:
        figure: to write in.
        text: may have several lines.
    """
    figure.suptitle(wrapped(figure, text, mpl.rcParams["figure.titlesize"]))


def add_legend(figure: Figure, handles: Sequence[Any], most: int = _MOST_COLUMNS) -> None:
    """Add a legend below the panels, in as many columns as fit; a tall one makes the figure taller.

    Args:
        figure: with the panels.
        handles: with labels; one that is too long for the figure gets several lines.
        most: columns.
    """
    size = mpl.rcParams["legend.fontsize"]
    for columns in range(min(len(handles), most), 0, -1):
        legend = _legend(figure, handles, columns)
        if legend.get_window_extent().width <= figure.bbox.width - _MARGIN * figure.dpi:
            break
        legend.remove()
    else:
        # The handle and the borders take room, too.
        room = figure.get_figwidth() - (mpl.rcParams["legend.handlelength"] + 4.0) * size / 72.0
        for handle in handles:
            handle.set_label(wrapped(figure, handle.get_label(), size, room))
        legend = _legend(figure, handles, 1)
    more = legend.get_window_extent().height / figure.dpi - _LEGEND_HEIGHT
    figure.set_figheight(figure.get_figheight() + max(more, 0.0))


def _legend(figure: Figure, handles: Sequence[Any], columns: int) -> Any:
    return figure.legend(handles=list(handles), loc="outside lower center", ncols=columns)


def drawable(h: np.ndarray) -> np.ndarray:
    """Return values of barriers that can be drawn: -inf is twice as deep as all else is large.

    Args:
        h: values, -inf where there is none, NaN where nothing is to be drawn.
    """
    known = np.abs(h[np.isfinite(h)])
    return np.maximum(h, -2.0 * known.max(initial=1.0))
