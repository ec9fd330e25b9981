"""Arrays from outside: converted in one place, or refused by an error of this project."""

from __future__ import annotations

import numbers
from typing import Any

import numpy as np

from safe_envs.errors import InvalidInputError, shown


def real_array(what: str, given: Any) -> np.ndarray:
    """Return a state, an action or a batch of them as an array of floats.

    Arrays of float32 and float64 are returned unchanged.

    Args:
        what: name of the argument, for the error.
        given: an array, a number, or nested sequences of numbers.

    Raises:
        InvalidInputError: it is no array of real numbers: text, None, complex, masked, ragged, or
            beyond the range of floats.
    """
    if type(given) is np.ndarray and given.dtype.char in "fd":
        return given
    try:
        if np.ma.is_masked(given):
            raise ValueError("some entries are masked")
        array = np.asarray(given)
        if array.dtype.kind == "O" and all(isinstance(entry, numbers.Real) for entry in array.flat):
            return array.astype(np.float64)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"its entries are of the type {array.dtype}")
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InvalidInputError(
            f"the {what} is {shown(given)}: {error}; give an array of real numbers, such as"
            " np.zeros(2)"
        ) from error


def numbers_in(given: Any) -> np.ndarray:
    """Return numbers as an array of at least one axis; empty if there are none."""
    try:
        found = np.asarray(given)
        # NumPy would read numbers out of texts, times and what is masked, and drop imaginary parts.
        no_numbers = found.dtype.kind in "USMmc" or np.ma.is_masked(given)
        return np.empty(0) if no_numbers else np.atleast_1d(found.astype(float))
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)
