"""Values that a file holds, each of which is checked before it is used."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, shown

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
