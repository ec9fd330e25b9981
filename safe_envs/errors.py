"""Errors of this project: each says what was given, what is allowed and what to do."""

from __future__ import annotations

import difflib
import numbers
from collections.abc import Iterable
from typing import Any


class SafeEnvsError(Exception):
    """Base of every error that this project raises on purpose."""


class SystemDefinitionError(SafeEnvsError, ValueError):
    """A system, barrier or problem contradicts itself."""


class SystemDefinitionWarning(UserWarning):
    """A system, barrier or problem may not be what its author means."""


class RelativeDegreeError(SystemDefinitionError):
    """The input never appears in the derivatives of a barrier, or not where a condition needs it."""


class ConfigurationError(SafeEnvsError, ValueError):
    """An argument names something unknown or has a value outside its range."""


class InvalidInputError(SafeEnvsError, ValueError):
    """A state or an action has the wrong shape or is not finite."""


class NumericalError(SafeEnvsError, ArithmeticError):
    """A formula has no finite value at a state."""


class WorkersLostError(SafeEnvsError, RuntimeError):
    """Processes end before they have computed what they were given."""


def shown(given: Any) -> str:
    """Return what was given as a message shows it, texts in quotes: without its middle where that
    is long.
    """
    try:
        return shortened(repr(given))
    except ValueError:  # Python writes no whole number of more than 4300 digits.
        return f"a {type(given).__name__} with too many digits"


def shortened(given: Any, most: int = 120) -> str:
    """Return a text, a path or an error as text, without its middle where it is longer than about
    so many characters.
    """
    text = str(given)
    if len(text) <= most:
        return text
    half = most // 2
    return f"{text[:half]}...({len(text) - 2 * half} more characters)...{text[-half:]}"


def nearest(name: str, allowed: Iterable[str]) -> str:
    """Return a phrase that lists the allowed names, the nearest one to `name` first."""
    names = list(allowed)
    close = difflib.get_close_matches(shortened(name), names, n=1, cutoff=0.4)
    listing = ", ".join(names) if names else "none"
    return f"did you mean {close[0]!r}? (allowed: {listing})" if close else f"allowed: {listing}"


def require_whole(name: str, value: Any, least: int) -> None:
    """Raise ConfigurationError unless a value is a whole number from `least`; NumPy's integers are
    such, truth values are not.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or int(value) < least:
        raise ConfigurationError(f"{name} = {shown(value)}; give a whole number from {least}")
