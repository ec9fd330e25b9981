"""Files of figures: whole or not at all, and the same bytes for the same figure."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from safe_envs.atomic_io import write_atomically
from safe_envs.scripts.figures.style import STYLE

_UNDATED: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
    "png": {"Software": None},
}
"""Metadata by format."""

_DATE = "SOURCE_DATE_EPOCH"


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
