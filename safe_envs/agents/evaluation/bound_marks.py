"""What the marks in the cells of bounds mean."""

from __future__ import annotations

from collections.abc import Iterable

from safe_envs.text_tables import Column

_MARKS = {
    ">=": ">= is proved or certified",
    "comp.": "comp. is computed in floating point, and not proved",
    "est.": "est. is estimated, and not proved",
}


def marks_in(columns: Iterable[Column]) -> list[str]:
    """Return what the marks mean that the cells of bounds have.

    Args:
        columns: of a table; those whose titles begin with "bound" are looked at.
    """
    bounds = [column for column in columns if column.title.startswith("bound")]
    words = {word for column in bounds for cell in column.cells for word in str(cell).split()}
    return [text for mark, text in _MARKS.items() if mark in words]
