"""Values from files and callers, each of which is checked before it is used."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, InvalidInputError, shown

LARGEST = 1e100
"""Largest number in a file: a product of a few of them is still a number."""


class LearnedFileError(ConfigurationError):
    """A file is no learned model or data set of this project, damaged, or of another problem."""


def require_text(given: Any) -> str:
    """Return a text of JSON; raise TypeError where it is none."""
    if not isinstance(given, str):
        raise TypeError(f"{shown(given)} is no text")
    return given


def require_finite(given: Any) -> float:
    """Return a number of JSON as a float; raise TypeError or ValueError where it is none."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError(f"{shown(given)} is no number")
    if not math.isfinite(given):
        raise ValueError(f"{given} is not finite")
    return float(given)


def array_of(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the array of a name, as floats.

    Args:
        arrays: by name.
        name: of the array.
        shape: that it has to have.

    Raises:
        KeyError: there is none.
        ValueError: its shape is another, or a number is not finite or too large.
    """
    array = arrays[name].astype(float, copy=False)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        raise ValueError(
            f"{name} has the shape {array.shape}, not {shape}, or a number that is not finite or"
            f" above {LARGEST:g}"
        )
    return array


def numbers(name: str, given: Any) -> np.ndarray:
    """Return numbers as an array of floats, with nothing left out.

    Args:
        name: of what was given, for the message.
        given: anything.

    Raises:
        InvalidInputError: it is none, entries of it are masked, or it is complex.
    """
    parts = given if isinstance(given, list | tuple) else (given,)
    if any(np.ma.is_masked(part) for part in parts):
        raise InvalidInputError(
            f"{name} has masked entries, whose values mean nothing; drop such rows, as by"
            " numpy.ma.compress_rows"
        )
    try:
        found = np.asarray(given)
        if not np.iscomplexobj(found):
            return found.astype(float, copy=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{name} is no array of numbers ({error}); give rows of equal length"
        ) from error
    raise InvalidInputError(
        f"{name} is complex; give real numbers, the parts of a complex state as two states"
    )
