"""From the text of options to the arguments of `gym.make`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safe_envs.errors import ConfigurationError


def numbers(option: str, text: str) -> list[float]:
    """Read "1,2.5,-3".

    Raises:
        ConfigurationError: an entry is no number.
    """
    try:
        return [float(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ConfigurationError(f"{option} {text!r} is no number or list of numbers with commas between") from error


def noise(text: str | None) -> float | list[float] | None:
    """Read --noise: one number for all channels, or one for each."""
    if text is None:
        return None
    levels = numbers("--noise", text)
    return levels[0] if len(levels) == 1 else levels


def start(text: str | None) -> str | list[float] | None:
    """Read --start: a state, or else the name of a distribution."""
    if text is None:
        return None
    try:
        return numbers("--start", text)
    except ConfigurationError:
        if "," in text:
            raise
        return text


def box(texts: Sequence[str]) -> list[float] | list[list[float]] | None:
    """Read --box LO,HI: one for all inputs, or one for each.

    Raises:
        ConfigurationError: an entry is not two numbers.
    """
    pairs = [numbers("--box", text) for text in texts]
    for text, pair in zip(texts, pairs, strict=True):
        if len(pair) != 2:
            raise ConfigurationError(f"--box {text!r} has {len(pair)} numbers; give LO,HI")
    if len(pairs) == 1:
        return pairs[0]
    return pairs or None


def parameters(option: str, texts: Sequence[str], words: bool = False) -> dict[str, Any] | None:
    """Read NAME=VALUE entries.

    Args:
        option: which is read.
        texts: the entries.
        words: whether a value may be a word.

    Raises:
        ConfigurationError: an entry has no name, comes twice, or its value is no number where it must be one.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name or not equals or not value or name in found:
            problem = "comes twice" if name in found else "is not of this form"
            raise ConfigurationError(f"{option} {text!r} {problem}; give NAME=VALUE, once for each parameter")
        found[name] = _value(option, text, value, words)
    return found or None


def _value(option: str, text: str, value: str, words: bool) -> float | str:
    try:
        return int(value) if value.lstrip("+-").isdecimal() else float(value)
    except ValueError as error:
        if words:
            return value
        raise ConfigurationError(f"{option} {text!r}: {value!r} is not a number") from error
