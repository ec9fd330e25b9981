"""Options of commands that compute tables of how safe a problem can be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, shown

Leaving = Annotated[
    str,
    typer.Option(
        metavar="violation|safe",
        help=(
            "How an episode counts that leaves the workspace in the safe set; evaluate counts it as"
            " safe."
        ),
    ),
]
Cells = Annotated[
    str | None,
    typer.Option(
        metavar="N|NxM|NxMxL",
        help="Cells of the grid along each coordinate; by default as many as suit the env.",
        show_default=False,
    ),
]
Inputs = Annotated[
    int | None,
    typer.Option(
        help="Inputs that are tried along each input; by default as many as suit the env.",
        show_default=False,
    ),
]
Table = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="The table: read if it is there, else written. By default it is in the cache.",
        show_default=False,
    ),
]


_MOST_DIGITS = 9


def cells_of(text: str | None, example: str = "400x100") -> tuple[int, ...] | None:
    """Return the numbers of cells of a text such as 400x100; None for none.

    Args:
        text: as given.
        example: of such a text, for messages.

    Raises:
        ConfigurationError: It is no such text.
    """
    if text is None:
        return None
    parts = text.lower().split("x")
    if not all(part.isascii() and part.isdigit() and len(part) <= _MOST_DIGITS for part in parts):
        raise ConfigurationError(
            f"--cells {shown(text)}; give a whole number for each coordinate, of at most"
            f" {_MOST_DIGITS} digits, such as {example}"
        )
    return tuple(int(part) for part in parts)
