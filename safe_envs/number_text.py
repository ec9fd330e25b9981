"""Numbers that users write: decimal, in ASCII, as JSON and C have them."""

from __future__ import annotations

import math
import re

_WHOLE = re.compile(r"[-+]?[0-9]+")


def real(text: str) -> float:
    """Read a real number, such as 2, -.5, 1e-3 or inf.

    Raises:
        ValueError: the text is none. Digits of other scripts and underscores between digits, which
            Python takes, are refused: they come from slips, and other programs read the same text
            as something else.
    """
    return float(_plain(text))


def whole_or_real(text: str) -> int | float:
    """Read a number: an int where the text has the form of one and a float can hold it, and else a
    float; errors as for `real`."""
    value = real(text)
    return int(text) if _WHOLE.fullmatch(text.strip()) and math.isfinite(value) else value


def real_or_complex(text: str) -> float | complex:
    """Read a number, which may be complex, such as -1+2j; errors as for `real`."""
    try:
        return real(text)
    except ValueError:
        return complex(_plain(text))


def _plain(text: str) -> str:
    if not text.isascii() or "_" in text:
        raise ValueError("a number has the digits 0 to 9, without underscores")
    return text
