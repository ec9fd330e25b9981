"""Numbers that users write: decimal, in ASCII, as in JSON and C."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from safe_envs.errors import ConfigurationError, shown

_WHOLE = re.compile(r"[-+]?[0-9]+")


def real(text: str) -> float:
    """Read a real number, such as 2, -.5, 1e-3 or inf.

    Raises:
        ValueError: the text is none. Digits of other scripts and underscores between digits, which
            Python takes, are refused: they come from slips, and other software reads the same text
            as something else.
    """
    return float(_plain(text))


def whole_or_real(text: str) -> int | float:
    """Read a number; errors as for `real`.

    It is an int where the text has the form of one and a float can hold it, and else a float.
    """
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


def finite_number(name: str, value: Any) -> float:
    """Return a value as a float.

    Args:
        name: of the argument, for errors.
        value: a number, or the text of one.

    Raises:
        ConfigurationError: The value is not a number, or not finite.
    """
    try:
        number = real(value) if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigurationError(f"{name} = {shown(value)} is not a number") from error
    if not math.isfinite(number):
        raise ConfigurationError(f"{name} = {number} is not finite")
    return number


def numbers(name: str, text: str) -> list[float]:
    """Read "1,2.5,-3".

    Args:
        name: of the option, for errors.
        text: numbers with commas between.

    Raises:
        ConfigurationError: An entry is not a number.
    """
    try:
        return [real(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ConfigurationError(
            f"{name} {shown(text)} is no number or list of numbers with commas between"
        ) from error


def named_values(option: str, texts: Sequence[str], words: bool = False) -> dict[str, Any]:
    """Read NAME=VALUE entries.

    Args:
        option: name of the option, for errors.
        texts: the entries.
        words: whether a value may be a word.

    Raises:
        ConfigurationError: An entry has no name, comes twice, or its value is no number where it
            must be one.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not name or not value or name in found:
            problem = "comes twice" if name in found else "is not of this form"
            raise ConfigurationError(
                f"{option} {shown(text)} {problem}; give NAME=VALUE, once for each parameter"
            )
        try:
            found[name] = whole_or_real(value)
        except ValueError as error:
            if not words:
                raise ConfigurationError(
                    f"{option} {shown(text)}: {shown(value)} is not a number"
                ) from error
            found[name] = value
    return found
