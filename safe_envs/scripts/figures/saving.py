"""Files of figures: whole or not at all, and without a date."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox

from safe_envs.atomic_io import write_atomically
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.scripts.figures.style import STYLE
from safe_envs.wrappers.decision_log.files import path_of

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
    """Let a figure have one layout in all formats, however often it is written.

    That of Matplotlib begins where the last one ended, with the letters of the format.
    """
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
