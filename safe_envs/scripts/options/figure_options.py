"""Options of commands that draw a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, nearest, shown

WIDTHS = {"single": 3.5, "double": 7.16}
"""Widths in inches of a figure of one column of a paper and of two.

Source: IEEE Author Center, "Resolution and size" of graphics: 3.5 in and 7.16 in.
"""

DEFAULT_SIZE = "double"

Size = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(WIDTHS),
        help="Width of the figure in columns of a paper: {single:g} or {double:g} inches;"
        " {default} by default.".format(**WIDTHS, default=DEFAULT_SIZE),
    ),
]


def size_of(size: str | None, plot: Path | None) -> str:
    """Return the size of the figure of a command.

    Args:
        size: as given; None where it is not.
        plot: file of the figure; None where none is drawn.

    Raises:
        ConfigurationError: there is no such size, or no figure.
    """
    if size is None:
        return DEFAULT_SIZE
    width_of(size)
    if plot is None:
        raise ConfigurationError(
            f"--size {size} is of a figure, and none is drawn: give --plot FILE too, or leave"
            " --size out"
        )
    return size


def width_of(size: str) -> float:
    """Return the width of a figure.

    Args:
        size: "single" or "double".

    Returns:
        Inches.

    Raises:
        ConfigurationError: there is no such size.
    """
    if size not in WIDTHS:
        raise ConfigurationError(f"size = {shown(size)}; {nearest(str(size), list(WIDTHS))}")
    return WIDTHS[size]
