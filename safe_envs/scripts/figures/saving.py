"""Files of figures: whole or not at all, and without a date."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

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


_SCREEN_DPI = 150
"""Of a notebook."""


class StyledFigure(Figure):
    """A figure that a notebook shows, with or without pyplot, and that keeps its style."""

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Write the figure in its style; see `matplotlib.figure.Figure.savefig`.

        Args:
            *args: as there.
            **kwargs: as there.
        """
        # The formats of fonts are read when a figure is written.
        with mpl.rc_context(STYLE):
            super().savefig(*args, **kwargs)

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
    with mpl.rc_context(STYLE), _dated():
        write_atomically(path, lambda part: _write(figure, part, kind))


def _write(figure: Figure, part: Path, kind: str) -> None:
    # Given a path, PostScript would have its name in it.
    with part.open("wb") as file:
        figure.savefig(file, format=kind, metadata=_UNDATED.get(kind))


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
