"""The style of all figures: column widths, letters, and colours that the colour-blind can tell."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import matplotlib as mpl
import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, NullLocator
from matplotlib.transforms import Bbox

from safe_envs.errors import ConfigurationError, shortened
from safe_envs.files import write_atomically
from safe_envs.filters.decision_log import path_of, printable

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

_LEAST_SHARE = 1e-4
"""Smaller shares of violations lie next to 0."""

_MARGIN = 0.1
"""In inches, at both sides of the titles and legends together."""


def look(i: int) -> dict[str, Any]:
    """Return colour and dashes of the i-th line; no two of the first 36 are alike."""
    turn, place = divmod(i, len(COLORS))
    return {"color": COLORS[place], "linestyle": DASHES[(place + turn) % len(DASHES)]}


def mark_of(i: int) -> str:
    """Return the mark of the i-th line or point, another one where its colour comes again."""
    return MARKERS[(i + i // len(COLORS)) % len(MARKERS)]


def scale_violations(axes: Axes, shares: Sequence[float]) -> None:
    """Show shares of episodes with a violation across: of all sizes, and 0.

    Args:
        axes: of the panel.
        shares: that are drawn, from 0 to 1.
    """
    least = min((share for share in shares if share > _LEAST_SHARE), default=0.1)
    threshold = 10.0 ** min(math.floor(math.log10(least)), -1)
    axes.set_xscale("symlog", linthresh=threshold)
    axes.set_xlim(-0.15 * threshold, 1.6)
    axes.set_xticks([0.0, *(10.0**k for k in range(round(math.log10(threshold)), 1))])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("episodes with a violation")
    axes.grid(alpha=0.25, linewidth=0.6)


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


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the one after the last place of each run of True."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return list(zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True))


_UNDATED: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
    "png": {"Software": None},
}
"""Metadata by format."""

_DATE = "SOURCE_DATE_EPOCH"

_DIGITS = 9
"""Of the places of panels, as shares of a figure."""

_BEGINNINGS: WeakKeyDictionary[Axes, Bbox] = WeakKeyDictionary()
"""Where panels outside of a grid were before the first layout."""

_SCREEN_DPI = 150
"""Of a notebook."""


class StyledFigure(Figure):
    """A figure that a notebook shows, with or without pyplot, and that keeps its style."""

    def savefig(self, fname: Any, **kwargs: Any) -> None:
        """Write the figure in its style and without a date; see `matplotlib.figure.Figure.savefig`.

        Args:
            fname: as there.
            **kwargs: as there.
        """
        kind = kwargs.get("format") or Path(str(fname)).suffix.removeprefix(".")
        undated = _UNDATED.get(kind.lower())
        if undated is not None:  # of the other formats some refuse any metadata
            kwargs["metadata"] = {**undated, **(kwargs.get("metadata") or {})}
        # The formats of fonts are read when a figure is written.
        with mpl.rc_context(STYLE), _laid_out(self):
            super().savefig(fname, **kwargs)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=_SCREEN_DPI)
        return buffer.getvalue()


def finished(figure: StyledFigure, out: Path | str | None) -> StyledFigure:
    """Return a figure, and write it if it has a file.

    Args:
        figure: to write.
        out: file of the picture; its suffix is the format. None writes nothing.

    Raises:
        ConfigurationError: `out` is no path, or its suffix is no format of a picture.
    """
    if out is None:
        return figure
    path = path_of(out, "FILE.png, FILE.pdf or FILE.svg")
    if path.suffix.lower().removeprefix(".") not in figure.canvas.get_supported_filetypes():
        raise ConfigurationError(
            f"{shortened(path)} names no format of a picture; give FILE.png, FILE.pdf or FILE.svg"
        )
    save(figure, path)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure without a date.

    Args:
        figure: to write.
        path: of the file; its suffix is the format.
    """
    kind = path.suffix.removeprefix(".").lower()
    # The formats of fonts are read when a figure is written.
    with mpl.rc_context(STYLE), _dated(), _laid_out(figure):
        write_atomically(path, lambda part: _write(figure, part, kind))


def _write(figure: Figure, part: Path, kind: str) -> None:
    # Given a path, PostScript would have its name in it.
    with part.open("wb") as file:
        figure.savefig(file, format=kind, metadata=_UNDATED.get(kind))


@contextmanager
def _laid_out(figure: Figure) -> Iterator[None]:
    """Let a figure have one layout in all formats, however often it is written."""
    # That of Matplotlib begins where the last one ended, with the letters of the format.
    engine = figure.get_layout_engine()
    if not isinstance(engine, ConstrainedLayoutEngine):
        yield
        return
    for axes in figure.axes:
        place = axes.get_subplotspec()
        if place is None:  # of a colour bar
            _place(axes, _BEGINNINGS.setdefault(axes, axes.get_position(original=True)))
        else:
            axes.set_subplotspec(place)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        # The last digits depend on where in memory the solver's variables are, and an SVG has names
        # that are made of them.
        box = axes.get_position(original=True)
        _place(axes, Bbox(np.round(box.get_points(), _DIGITS)))
    try:
        yield
    finally:
        figure.set_layout_engine(engine)


def _place(axes: Axes, box: Bbox) -> None:
    """Put a panel somewhere, and leave it to the layout all the same."""
    stays = axes.get_in_layout()
    axes.set_position(box)
    axes.set_in_layout(stays)


@contextmanager
def _dated() -> Iterator[None]:
    """Give the formats that must have a date a fixed one, unless the user has chosen another."""
    if _DATE in os.environ:
        yield
        return
    os.environ[_DATE] = "0"
    try:
        yield
    finally:
        del os.environ[_DATE]


_GREEK = frozenset(
    re.findall(
        r"\w+",
        "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau"
        " upsilon phi chi psi omega Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega",
    )
)
_ACCENTS = ("ddot", "dot", "hat", "bar", "tilde")
_NAME = re.compile(r"([A-Za-z]+?)(\d*)((?:_[A-Za-z0-9]+)*)")
_ASSIGNED = re.compile(r"\b[A-Za-z]\w*(?= = )")
_MEASURED = re.compile(r"(?<=\d) (?=[A-Za-z%]\b)")
_FACTOR = re.compile(r"(?:√|sqrt)\(?([A-Za-z]+)\)?|([A-Za-z]+|1)(?:\^(-?\d+)|([²³]))?")
_RAISED = {"²": "2", "³": "3"}


def plain(text: str, most: int = 40) -> str:
    """Return a text without what would be read as mathematics; it may come from a file.

    Args:
        text: a name, say.
        most: characters, about.
    """
    return shortened(printable(text), most).replace("$", r"\$")


def symbol(name: str) -> str:
    r"""Return the name of a quantity as mathematics, or as upright text where it is a word.

    Args:
        name: such as x, sigma_1, thetadot, rotor_1 or speed; other texts are written as they are.

    Returns:
        Mathtext, such as "$\sigma_{1}$" and "$\dot{\theta}$"; "speed" for a word.
    """
    match = _NAME.fullmatch(name)
    if match is None or len(name) > 40:
        return plain(name)
    base, digits, indices = match.groups()
    letter = _letter(base)
    parts = [part for part in (digits, *indices.split("_")) if part]
    if letter is None:
        # A word keeps its index, and further words are written after it.
        if not parts or any(not part.isdigit() for part in parts):
            return plain(name.replace("_", " "))
        letter = rf"\mathrm{{{base}}}"
    below = ",".join(
        f"\\{part}" if part in _GREEK else part if len(part) == 1 else rf"\mathrm{{{part}}}"
        for part in parts
    )
    return f"${letter}_{{{below}}}$" if below else f"${letter}$"


def _letter(base: str) -> str | None:
    """Return a Latin or Greek letter with its accent; None for a word."""
    for accent in _ACCENTS:
        inner = base.removesuffix(accent)
        if inner != base and (found := _letter(inner)):
            return f"\\{accent}{{{found}}}"
    if base in _GREEK:
        return f"\\{base}"
    return base if len(base) == 1 else None


def unit_text(unit: str) -> str:
    """Return a unit, upright, with its powers raised.

    Args:
        unit: such as m/s^2, N m, rad^2/s^2, m/s/sqrt(s); another text is written as it is.

    Returns:
        Mathtext. What several strokes divide by is in parentheses, as ISO 80000-1 asks for.
    """
    groups = [
        [_factor(factor) for factor in part.replace("·", " ").split()] for part in unit.split("/")
    ]
    if not all(groups) or any(factor is None for group in groups for factor in group):
        return plain(unit)
    above, *below = ([str(factor) for factor in group] for group in groups)
    divisors = [factor for group in below for factor in group]
    text = r"\,".join(above)
    if divisors:
        under = r"\,".join(divisors)
        text += f"/({under})" if len(divisors) > 1 else f"/{under}"
    return f"${text}$"


def _factor(text: str) -> str | None:
    match = _FACTOR.fullmatch(text)
    if match is None:
        return None
    rooted, name, power, raised = match.groups()
    if rooted:
        return rf"\sqrt{{\mathrm{{{rooted}}}}}"
    exponent = power or _RAISED.get(raised)
    return rf"\mathrm{{{name}}}" + (f"^{{{exponent}}}" if exponent else "")


def labelled(text: str, unit: str = "") -> str:
    """Return a text with a unit, as every axis has it.

    Args:
        text: of the quantity, which may hold mathematics.
        unit: of the quantity; empty for none, "%" for shares.

    Returns:
        Such as "time [s]".
    """
    if not unit:
        return text
    return f"{text} [{unit if unit == '%' else unit_text(unit)}]"


def quantity(name: str, unit: str = "") -> str:
    r"""Return the label of a state, an input or a parameter.

    Args:
        name: as in the problem.
        unit: as in the problem.

    Returns:
        Such as "$\theta$ [$\mathrm{rad}$]".
    """
    return labelled(symbol(name), unit)


def expression(text: str, units: Mapping[str, str]) -> str:
    """Return the label of an expression of states, such as a coordinate.

    Args:
        text: as SymPy prints it.
        units: of the states, by name.
    """
    if text in units:
        return quantity(text, units[text])
    states = {name: sp.Symbol(name, real=True) for name in units}
    parsed = sp.parse_expr(text, local_dict=dict(states))
    names = {state: symbol(name).strip("$") for name, state in states.items()}
    return f"${sp.latex(parsed, symbol_names=names)}$"


def mathematics(text: str) -> str:
    """Return a text in which names that are given values are mathematics, and units stay at them.

    Args:
        text: such as "sigma_1 = 0.1, dt = 0.05 s".

    Returns:
        The text, with mathtext.
    """
    joined = _MEASURED.sub("\u00a0", text.replace("$", r"\$"))
    return _ASSIGNED.sub(lambda match: symbol(match.group()), joined)


_APART = 2.0
_ROOM = 3.0
"""In pixels, between points of what is drawn, and around a value."""

_TRIED = 80
_FORM = "%.3g"


def write_levels(figure: Figure, axes: Axes, lines: ContourSet) -> None:
    """Write the value of each contour line into it, where nothing else is drawn.

    Args:
        figure: complete, since the places depend on its layout.
        axes: of the contour lines.
        lines: the contour lines; one without room for its value gets none.
    """
    figure.draw_without_rendering()
    curves = [_pixels(axes, segments) for segments in lines.allsegs]
    others = [_drawn(axes, lines)]
    places = []
    for i, (level, own) in enumerate(zip(lines.levels, curves, strict=True)):
        rest = [*others, *(curve for k, curve in enumerate(curves) if k != i)]
        found = _free_place(axes, own, np.concatenate(rest), _extent(axes, _FORM % level))
        if found is not None:
            place, corners = found
            places.append(axes.transData.inverted().transform(place))
            others.append(corners)
    if places:
        style: Any = {"fontsize": SMALL, "fmt": _FORM, "colors": "black", "inline_spacing": 4}
        axes.clabel(lines, manual=places, **style)


def _pixels(axes: Axes, segments: Sequence[Any]) -> np.ndarray:
    """Return points close to each other along curves, shape (k, 2)."""
    parts = [np.empty((0, 2))]
    for segment in segments:
        if len(segment) < 2:
            continue
        points = axes.transData.transform(segment)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        stops = np.arange(0.0, along[-1], _APART)
        parts.append(np.stack([np.interp(stops, along, column) for column in points.T], axis=1))
    return np.concatenate(parts)


def _drawn(axes: Axes, lines: ContourSet) -> np.ndarray:
    """Return points of all lines, marks and edges of areas but those of contour lines."""
    segments = [np.column_stack(line.get_data(orig=False)) for line in axes.lines]
    marks = [axes.transData.transform(np.asarray(each, dtype=float)) for each in segments]
    for collection in axes.collections:
        if collection is not lines and isinstance(collection, Collection):
            for path in collection.get_paths():
                segments += path.to_polygons(closed_only=False)
    return np.concatenate([*marks, _pixels(axes, segments)])


def _extent(axes: Axes, text: str) -> np.ndarray:
    """Return half of the width and height of a value with the room around it."""
    probe = axes.text(0.0, 0.0, text, fontsize=SMALL)
    box = probe.get_window_extent()
    probe.remove()
    return 0.5 * np.array([box.width, box.height]) + _ROOM


def _free_place(
    axes: Axes, own: np.ndarray, others: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the place on a contour line that is furthest from what is drawn."""
    best, margin = None, 1.0
    inside = axes.bbox.padded(-float(half.max()))
    for k in range(3, len(own) - 3, max(1, len(own) // _TRIED)):
        if not inside.contains(*own[k]):
            continue
        along = own[k + 3] - own[k - 3]
        length = float(np.hypot(*along))
        if length < 3.0 * _APART:
            continue
        turn = np.array([[along[0], along[1]], [-along[1], along[0]]]) / length
        away = np.abs((others - own[k]) @ turn.T) / half
        room = float(away.max(axis=1).min(initial=np.inf))
        if room > margin:
            grid = np.stack(np.meshgrid(*(np.linspace(-h, h, 9) for h in half)), axis=-1)
            best, margin = (own[k], own[k] + grid.reshape(-1, 2) @ turn), room
    return best
